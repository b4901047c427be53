"""The paper's pyramid: image, depth and camera stay together."""

from depth_deblur_ros.core.data import CameraIntrinsics
from depth_deblur_ros.core.geometry import flow
from depth_deblur_ros.core.pyramid import build_pyramid, Level, scaled_level, SHORTEST_SIDE
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

CAMERA = CameraIntrinsics(210.0, 205.0, 101.3, 77.8, 203, 157)


def level(camera=CAMERA):
    y, x = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    image = np.stack([x / camera.width, y / camera.height, 0 * x], -1)
    return Level(image, 1 + x / camera.width, camera)


def test_eleven_levels_of_nine_tenths_end_at_the_frame_itself():
    finest = level(CameraIntrinsics(640.0, 640.0, 319.5, 239.5, 640, 480))
    found = build_pyramid(finest, 11, 0.9)
    assert len(found) == 11
    assert found[-1] is finest
    assert [one.camera.width for one in found] == [round(640 * 0.9**k) for k in range(10, -1, -1)]


def test_levels_too_small_to_show_blur_are_left_out():
    found = build_pyramid(level(), 30, 0.8)
    assert all(min(one.depth.shape) >= SHORTEST_SIDE for one in found)
    assert len(found) == 6


def test_a_level_keeps_its_arrays_and_camera_in_step():
    for one in build_pyramid(level(), 5, 0.9):
        shape = (one.camera.height, one.camera.width)
        assert one.image.shape[:2] == one.depth.shape == shape
        assert one.image.dtype == one.depth.dtype == np.float32


def test_depth_is_never_mixed_across_an_edge():
    frame = level()
    depth = np.where(np.arange(203) < 90, 1, 4).astype(np.float32) * np.ones((157, 1), np.float32)
    small = scaled_level(Level(frame.image, depth, CAMERA), 150, 116)
    assert set(np.unique(small.depth)) == {1, 4}


@given(st.integers(60, 203), st.integers(50, 157))
def test_a_motion_moves_a_level_as_it_moves_the_frame(width, height):
    p = np.array([0.01, -0.02, 0.03, 0.02, -0.01, 0.04])
    small = CAMERA.scaled(width, height)
    whole, part = (flow(p, np.full((c.height, c.width), 2.0), c) for c in (CAMERA, small))
    share = np.array([width / CAMERA.width, height / CAMERA.height])
    # The mean flow samples other pixel centres of a flow that bends by less than this.
    np.testing.assert_allclose(part.mean((0, 1)), whole.mean((0, 1)) * share, atol=0.01)


def test_the_middle_of_a_picture_stays_in_the_middle():
    small = scaled_level(level(), 101, 78)
    assert small.image[..., 0].mean() == pytest.approx(level().image[..., 0].mean(), abs=1e-3)
    assert (small.camera.cx + 0.5) / 101 == pytest.approx((CAMERA.cx + 0.5) / 203)
