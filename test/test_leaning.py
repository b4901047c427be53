"""How a blurred image changes with the motion, against its slow twin."""

from dataclasses import replace

from depth_deblur_ros.core.blur import blur_operator
from depth_deblur_ros.core.data import CameraIntrinsics, Motion
from depth_deblur_ros.core.leaning import lean
from depth_deblur_ros.core.motion import blur_and_slope
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
import oracle
from pictures import texture

CAMERA = CameraIntrinsics(50.0, 48.0, 20.5, 16.5, 44, 36)
FAR = 2.0  # m


def operator(rng, turn):
    """Give A of a random motion before a step in depth, of blurs up to 10 px."""
    depth = np.full((36, 44), FAR, np.float32)
    depth[rng.integers(36) :, rng.integers(44) :] = rng.uniform(0.7, 2)
    p = rng.normal(0, 1, 9) * (*[0.05] * 2, turn, *[0.03] * 3, *[0.03] * 3)
    return blur_operator(Motion.from_vector(p), depth, CAMERA)


@given(seed=st.integers(0, 2**32 - 1), turn=st.sampled_from([0.05, 1.5]))
@settings(max_examples=25)
def test_it_leans_as_its_slow_twin_does(seed, turn):
    """A large turn lets blocks read in many cells, and each pixel by itself."""
    rng = np.random.default_rng(seed)
    blur = operator(rng, turn)
    # A read farther off than the frame is large is brought nearer, and stays there.
    assume(np.abs(oracle.displacements(blur)).max() <= blur.margin - 1)
    high, wide, _ = blur.latent_shape
    image = np.stack([texture(int(k), (high, wide)) for k in rng.integers(9, size=3)], 2)
    image = image.astype(np.float32)
    planes = np.zeros(blur.sweep.latent_shape, np.float32)
    blur.latent_part(planes)[:] = np.moveaxis(image, 2, 0)
    data, weight = rng.random((2, *blur.sweep.blurred_shape), np.float32)
    weight[:, :, CAMERA.width :] = 0
    own, force = lean(blur, blur.sweep, planes, data, weight)
    value, slope = blur_and_slope(blur.motion[:6].astype(np.float64), image, blur)
    # Where rounding moves a read into the next cell, slopes are other ones.
    size = np.abs(slope[:, :, 0]).max((0, 1))
    off = np.abs(np.moveaxis(own, 0, 2)[:, : CAMERA.width] - slope[:, :, 0]) / size
    assert np.quantile(off, 0.99) < 1e-3
    data, weight = (np.moveaxis(a, 0, 2)[:, : CAMERA.width] for a in (data, weight))
    pushes = (weight * (value - data))[..., None] * slope
    expected, room = pushes.sum((1, 2)), np.abs(pushes).sum((1, 2))
    assert np.quantile(np.abs(force - expected) / room, 0.95) < 5e-3


def test_thinned_it_leans_as_with_so_few_instants():
    """Before a wall, where all blocks are blurred alike and so have as many."""
    rng, shift = np.random.default_rng(0), Motion(np.zeros(3), np.array([0.43, 0.21, 0]))
    blur = blur_operator(shift, np.full((CAMERA.height, CAMERA.width), 2, np.float32), CAMERA)
    thinned = blur.thinned(3)
    (count,) = np.unique(np.rint(1 / thinned.layout.shares).astype(int))
    assert count < blur.inverse_depth.shape[2]
    few = replace(blur, inverse_depth=blur.inverse_depth[..., :count])
    planes = rng.random(thinned.latent_shape, np.float32)
    data, weight = rng.random((2, *thinned.blurred_shape), np.float32)
    for told, expected in zip(
        lean(blur, thinned, planes, data, weight),
        lean(few, few.sweep, planes, data, weight),
        strict=True,
    ):
        np.testing.assert_allclose(told, expected, rtol=1e-4, atol=1e-4 * np.abs(expected).max())
