"""What pages say of the energy, against the slow twins of the image step."""

from dataclasses import replace

from depth_deblur_ros.core.blur import blur_operator
from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    DeblurResult,
    Motion,
    Outcome,
    RgbdFrame,
)
from depth_deblur_ros.core.latent import noise_sigma, SIGMA_FLOOR, SPACING
from depth_deblur_ros.core.light import light_from_stored, light_slope
from depth_deblur_ros.core.quadratic import EPSILON, EXPONENT
from depth_deblur_ros.core.solver import restore_known
from depth_deblur_ros.misfit import energies_of
import numpy as np
import oracle
import pytest

CAMERA = CameraIntrinsics(80.0, 80.0, 47.5, 35.5, 96, 72)
MOTION = Motion([0, 0.06, 0.02], [0.01, 0, 0])


def frame_of(transfer='srgb'):
    """Give boxes of grey, blurred as MOTION says, and the sharp ones."""
    rng, sharp = np.random.default_rng(0), np.full((72, 96, 3), 0.5, np.float32)
    for x, y in rng.integers(0, [90, 66], (40, 2)):
        sharp[y : y + 9, x : x + 9] = rng.uniform(0.1, 0.9, 3)
    camera, depth = replace(CAMERA, transfer=transfer), np.full((72, 96), 2, np.float32)
    blur = blur_operator(MOTION, depth, camera, SPACING)
    light = blur.apply(blur.widen(light_from_stored(sharp, transfer)))
    taken = np.where(transfer == 'srgb', light ** (1 / 2.2), light).astype(np.float32)
    return RgbdFrame(np.clip(taken, 0, 1), depth, camera, 0.02), sharp


@pytest.mark.parametrize('transfer', ['srgb', 'linear'])
def test_the_terms_are_those_of_the_slow_twins(transfer):
    frame, _ = frame_of(transfer)
    result = restore_known(frame, MOTION)
    blur = blur_operator(MOTION, frame.depth, frame.camera, SPACING)
    wide = blur.widen(light_from_stored(result.image, transfer))
    seen = oracle.through(oracle.blur_matrix(blur), wide, frame.image.shape)
    missing = light_from_stored(frame.image, transfer) - seen
    m = blur.margin
    misfit = np.square(missing / light_slope(frame.image, transfer))[m:-m, m:-m].mean() / 2
    weight = 2.7 * max(noise_sigma(frame.image), SIGMA_FLOOR[transfer]) ** 2
    rough = oracle.sparse_energy(result.image.astype(np.float64), weight, EPSILON, EXPONENT)
    after = energies_of(frame, result, 2.7)[-1]
    assert (after.level, after.step) == (1, 'after')
    assert after.terms['misfit'] == pytest.approx(255**2 * misfit, rel=1e-3)
    assert after.terms['prior'] == pytest.approx(255**2 * rough / result.image.size, rel=1e-5)


def test_the_right_motion_lowers_the_misfit_at_both_sizes():
    frame, _ = frame_of()
    steps = energies_of(frame, restore_known(frame, MOTION), 2.7)
    assert [(e.level, e.step) for e in steps] == [
        (level, step) for level in (0, 1) for step in ('before', 'after')
    ]
    for before, after in zip(steps[::2], steps[1::2], strict=True):
        assert after.terms['misfit'] < 0.3 * before.terms['misfit']
        assert sum(after.terms.values()) < sum(before.terms.values())


def test_small_and_unchanged_images_have_no_coarse_level_and_no_energy():
    frame, _ = frame_of()
    result = restore_known(frame, MOTION)
    assert energies_of(frame, replace(result, outcome=Outcome.FAILED), 2.7) == ()
    rounded = np.rint(255 * frame.image).astype(np.float32) / 255  # as a bag keeps it
    assert energies_of(frame, replace(result, image=rounded), 2.7) == ()
    part = slice(0, 40), slice(0, 40)
    small = replace(
        frame,
        image=frame.image[part],
        depth=frame.depth[part],
        camera=replace(CAMERA, width=40, height=40),
    )
    cut = DeblurResult(1 - small.image, small.depth, MOTION, Outcome.SOLVED, False, 1.0, 5.0, 0.1)
    assert [e.level for e in energies_of(small, cut, 2.7)] == [1, 1]


def test_grey_images_have_the_energy_of_three_equal_channels():
    frame, _ = frame_of()
    grey = replace(frame, image=np.ascontiguousarray(frame.image[..., 0]))
    three = replace(frame, image=np.repeat(grey.image[..., None], 3, 2))
    result = restore_known(grey, MOTION)
    same = replace(result, image=np.repeat(result.image[..., None], 3, 2))
    for one, other in zip(
        energies_of(grey, result, 2.7), energies_of(three, same, 2.7), strict=True
    ):
        assert one.terms == pytest.approx(other.terms, rel=1e-5)
