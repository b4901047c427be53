"""Flow and warp of a motion: against each other, numbers and another library."""

from depth_deblur_ros.core.data import CameraIntrinsics
from depth_deblur_ros.core.geometry import (
    blur_length,
    flow,
    interaction_matrix,
    normalised_grid,
    rotation_matrix,
    rows_matrix,
    warp,
)
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

CAMERA = CameraIntrinsics(60.0, 64.0, 30.25, 24.5, 64, 48)
COARSE = CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480).scaled(48, 36)
seeds = st.integers(0, 2**32 - 1)
angles = st.lists(st.floats(-3, 3), min_size=3, max_size=3)


def rough_depth(seed, camera=CAMERA):
    return np.random.default_rng(seed).uniform(0.5, 6, (camera.height, camera.width))


def exact_flow(p, depth, camera):
    return warp(p, 0.5, depth, camera) - warp(p, -0.5, depth, camera)


@given(theta=angles)
def test_a_rotation_vector_means_what_scipy_says(theta):
    expected = Rotation.from_rotvec(theta).as_matrix()
    np.testing.assert_allclose(rotation_matrix(theta), expected, atol=1e-12)


@pytest.mark.parametrize('size', [0.0, 1e-300, 1e-9, 0.99e-8, 1.01e-8, 1e-7])
def test_a_tiny_rotation_is_a_rotation(size):
    r = rotation_matrix([size, -size, size])
    np.testing.assert_allclose(r @ r.T, np.eye(3), atol=1e-15)
    assert r[1, 0] == pytest.approx(size, rel=1e-6)


def test_no_motion_moves_nothing():
    depth = rough_depth(0)
    y, x = np.indices(depth.shape)
    np.testing.assert_allclose(warp(np.zeros(6), 0.5, depth, CAMERA)[..., 0], x, atol=1e-12)
    np.testing.assert_allclose(warp(np.ones(6), 0.0, depth, CAMERA)[..., 1], y, atol=1e-12)
    assert not flow(np.zeros(6), depth, CAMERA).any()


def test_a_sideways_shift_moves_by_focal_length_over_depth():
    depth = rough_depth(1)
    f = flow([0, 0, 0, 0.3, -0.2, 0], depth, CAMERA)
    np.testing.assert_allclose(f[..., 0], 60 * 0.3 / depth, rtol=1e-6)
    np.testing.assert_allclose(f[..., 1], 64 * -0.2 / depth, rtol=1e-6)
    constant = np.full_like(depth, 2.0)
    assert blur_length([0, 0, 0, 0.3, 0, 0], constant, CAMERA) == pytest.approx(9, rel=1e-6)


def test_a_point_that_comes_nearer_leaves_the_middle():
    middle = np.array([CAMERA.cx, CAMERA.cy])
    f = flow([0, 0, 0, 0, 0, -0.1], np.full((48, 64), 2.0), CAMERA)
    y, x = np.indices((48, 64))
    outwards = (np.stack([x, y], -1) - middle) * f
    assert (outwards >= 0).all()


@given(seed=seeds)
def test_the_interaction_matrix_is_the_derivative_of_the_warp(seed):
    depth = rough_depth(seed)
    y, x = np.indices(depth.shape).astype(float)
    found = interaction_matrix(x, y, depth, CAMERA)
    step = 1e-5
    for k, e in enumerate(np.eye(6)):
        ends = (warp(sign * step * e, 1.0, depth, CAMERA) for sign in (1, -1))
        slope = np.subtract(*ends) / (2 * step)
        np.testing.assert_allclose(found[..., k], slope, rtol=1e-6, atol=1e-6)


@given(seed=seeds)
def test_the_flow_is_the_interaction_matrix_times_the_motion(seed):
    depth, p = rough_depth(seed), np.random.default_rng(seed).normal(0, 0.1, 9)
    y, x = np.indices(depth.shape).astype(float)
    j = interaction_matrix(x, y, depth, CAMERA)
    found = flow(p[:6], depth, CAMERA)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, j @ p[:6], rtol=1e-6, atol=1e-5)
    by_rows = flow(p, depth, CAMERA)
    np.testing.assert_allclose(by_rows, rows_matrix(j, y, CAMERA) @ p, rtol=1e-6, atol=1e-5)
    for row in (0, depth.shape[0] - 1):  # each row as if all turned as it does
        theta = p[:3] + (row - CAMERA.cy) / CAMERA.fy * p[6:]
        own = flow(np.concatenate([theta, p[3:6]]), depth, CAMERA)
        np.testing.assert_allclose(by_rows[row], own[row], rtol=1e-5, atol=1e-4)


@given(seed=seeds)
def test_the_flow_is_the_warp_but_for_the_third_order(seed):
    """The even orders cancel between both ends: half the motion leaves an eighth of the error."""
    depth, p = rough_depth(seed), np.random.default_rng(seed).normal(0, 0.02, 6)
    y, x = np.indices(depth.shape).astype(float)
    j = interaction_matrix(x, y, depth, CAMERA)
    whole, half = (np.abs(exact_flow(s * p, depth, CAMERA) - s * j @ p).max() for s in (1, 0.5))
    assert half < whole / 6


@given(seed=seeds)
def test_the_flow_is_true_to_a_tenth_of_a_pixel_up_to_forty(seed):
    rng = np.random.default_rng(seed)
    depth = rng.uniform(1, 6, (COARSE.height, COARSE.width))
    p, to_vga = rng.normal(0, 1, 6), 640 / COARSE.width
    parts = (flow(p * half, depth, COARSE) for half in ((1, 1, 1, 0, 0, 0), (0, 0, 0, 1, 1, 1)))
    length = to_vga * sum(np.linalg.norm(part, axis=-1) for part in parts)
    p = p * 40 / length.max()
    miss = to_vga * np.abs(exact_flow(p, depth, COARSE) - flow(p, depth, COARSE))
    assert miss.max() < 0.1


def test_the_grid_is_the_rays_of_the_pixel_centres():
    xn, yn = normalised_grid(CAMERA)
    assert (xn.shape, yn.shape) == ((1, 64), (48, 1))
    assert xn[0, 30] == pytest.approx(-0.25 / 60)
    assert yn[24, 0] == pytest.approx(-0.5 / 64)
