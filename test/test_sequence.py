"""The sharp frames of one exposure: where things stand at each instant."""

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, InputError, Motion
from depth_deblur_ros.core.sequence import sharp_sequence
from depth_deblur_ros.folders import write_video
import numpy as np
import pytest

CAMERA = CameraIntrinsics(100.0, 100.0, 63.5, 47.5, 128, 96)
DEPTH = np.full((96, 128), 2.0, np.float32)
RIGHTWARDS = Motion([0, 0, 0], [0.2, 0, 0])  # 10 px at 2 m


def dot(x):
    image = np.zeros((96, 128, 3), np.float32)
    cv2.circle(image, (x, 48), 5, (1, 1, 1), -1)
    return image


def middle(image):
    return float((image[..., 0] * np.arange(128)).sum() / image[..., 0].sum())


def test_a_point_moves_as_the_convention_says():
    views = sharp_sequence(dot(60), DEPTH, RIGHTWARDS, CAMERA, 5)
    places = [middle(view) for view in views]
    np.testing.assert_allclose(places, [56, 58, 60, 62, 64], atol=0.05)


def test_a_still_camera_sees_the_same_all_the_time():
    image = dot(60)
    for view in sharp_sequence(image, DEPTH, Motion([0, 0, 0], [0, 0, 0]), CAMERA, 3):
        np.testing.assert_allclose(view, image, atol=1e-6)


def test_a_near_thing_passes_before_a_far_one():
    """The near dot (1 m) moves by 20 px, across a bright bar at 4 m that moves by 5."""
    image, depth = np.zeros((96, 128), np.float32), np.full((96, 128), 4.0, np.float32)
    image[:, 70:74] = 1
    depth[40:56, 50:66] = 1.0
    image[40:56, 50:66] = 0.5
    last = sharp_sequence(image, depth, RIGHTWARDS, CAMERA, 21)[-1]
    assert np.abs(last[44:52, 62:73] - 0.5).max() < 0.01
    assert last[10, 70:78].max() > 0.9


def test_the_mean_of_the_views_is_the_blurred_image():
    image = cv2.GaussianBlur(dot(60), (0, 0), 2)
    views = sharp_sequence(image, DEPTH, RIGHTWARDS, CAMERA, 20)
    box = np.full((1, 20), 1 / 20, np.float32)
    expected = cv2.filter2D(cv2.resize(image, None, fx=2, fy=1), -1, box)
    assert middle(np.mean(views, 0)) == pytest.approx(60, abs=0.05)
    assert np.mean(views, 0)[48].max() == pytest.approx(expected[48].max(), abs=0.02)


@pytest.mark.parametrize('frames', [0, 1001])
def test_the_number_of_frames_has_bounds(frames):
    with pytest.raises(InputError, match=rf'frames must lie in .*, got {frames}'):
        sharp_sequence(dot(60), DEPTH, RIGHTWARDS, CAMERA, frames)


def test_the_video_has_every_frame(tmp_path):
    write_video(tmp_path / 'sequence.mp4', sharp_sequence(dot(60), DEPTH, RIGHTWARDS, CAMERA, 7))
    video = cv2.VideoCapture(str(tmp_path / 'sequence.mp4'))
    shown = [video.read()[0] for _ in range(8)]
    assert shown == [True] * 7 + [False]
    assert [p.name for p in tmp_path.iterdir()] == ['sequence.mp4']
