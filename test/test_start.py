"""The blind start on straight blurs of a texture: found, not invented, the same each time."""

from types import SimpleNamespace

import cv2
from depth_deblur_ros.core import start
from depth_deblur_ros.core.blur import blur_operator
from depth_deblur_ros.core.data import CameraIntrinsics, Motion, Outcome
from depth_deblur_ros.core.evidence import motion_axes
from depth_deblur_ros.core.geometry import blur_length, flow
from depth_deblur_ros.core.trust import edges_of
import numpy as np
from pictures import swept, texture
import pytest
from speed_frames import blurred_frame

CAMERA = CameraIntrinsics(262.0, 262.0, 159.5, 119.5, 320, 240)
DEPTH = np.full((240, 320), 2, np.float32)
AXES = motion_axes(DEPTH, CAMERA)[:6, :6]


def blind_start(grey, *told):
    """Give the start of a grey picture."""
    return start.blind_start(edges_of(grey), *told)


def sideways(length, angle):
    """Give the motion that blurs along one straight line [px, rad] all over the picture."""
    metres_per_px = 2 / 262
    v = length * metres_per_px * np.array([np.cos(angle), np.sin(angle), 0])
    return Motion(np.zeros(3), v)


def flow_error(result, true):
    """Give the mean distance [px] of two flows but for the sign."""
    found = flow(result.motion.vector, DEPTH, CAMERA)
    known = flow(true.vector, DEPTH, CAMERA)
    return min(float(np.linalg.norm(found - s * known, axis=-1).mean()) for s in (1, -1))


def in_px(covariance):
    """Give the covariance of q, where p = G q."""
    return np.linalg.solve(AXES, np.linalg.solve(AXES, covariance).T)


@pytest.mark.parametrize('length', [5, 8, 12, 20, 30])
@pytest.mark.parametrize('angle', [0.0, 0.7, 2.3])
def test_a_straight_blur_is_found_whatever_its_direction(length, angle):
    result = blind_start(swept(texture(1), length, angle, 0.005), DEPTH, CAMERA)
    assert result.outcome is Outcome.SOLVED
    assert flow_error(result, sideways(length, angle)) < 1
    assert 0.5 < result.quality <= 1


@pytest.mark.parametrize('length', [2, 3, 4])
@pytest.mark.parametrize('angle', [0.4, 1.9])
def test_a_short_blur_is_found_close_up(length, angle):
    result = blind_start(swept(texture(1), length, angle, 0.005), DEPTH, CAMERA)
    assert result.outcome is Outcome.SOLVED
    assert flow_error(result, sideways(length, angle)) < 0.5


@pytest.mark.parametrize('length', [3, 6, 14])
@pytest.mark.parametrize('angle', [0.4, 1.9])
def test_a_motion_is_found_near_a_guess(length, angle):
    guess = sideways(1.3 * length, angle + 0.2)
    result = blind_start(swept(texture(1), length, angle, 0.005), DEPTH, CAMERA, guess)
    assert result.outcome is Outcome.SOLVED
    assert flow_error(result, sideways(length, angle)) < 0.5


def test_a_wrong_guess_does_no_harm():
    grey, guess = swept(texture(1), 12, 0.4, 0.005), sideways(25, 2.0)
    result = blind_start(grey, DEPTH, CAMERA, guess)
    assert result.outcome is Outcome.SOLVED
    assert flow_error(result, sideways(12, 0.4)) < 0.5


@pytest.mark.parametrize(('said', 'times'), [(start.CLOSE_HINT / 2, 0), (start.CLOSE_HINT * 2, 1)])
def test_what_shows_nothing_close_up_is_not_searched_there(monkeypatch, said, times):
    camera = CameraIntrinsics(262.0, 262.0, 319.5, 239.5, 640, 480)  # of more than one scale
    grey, depth = np.tile(swept(texture(1), 7, 0.4), (2, 2)), np.tile(DEPTH, (2, 2))
    search, searched = start.find_short, []
    monkeypatch.setattr(start, 'seen_at', lambda *_: said)
    monkeypatch.setattr(start, 'find_short', lambda *told: searched.append(0) or search(*told))
    result = blind_start(grey, depth, camera, sideways(7, 0.4))
    assert len(searched) == times
    assert result.outcome is Outcome.SOLVED


@pytest.mark.parametrize('radius', [4, 7])
def test_a_lens_out_of_focus_is_no_motion(radius):
    y, x = np.mgrid[-radius : radius + 1, -radius : radius + 1]
    disc = (x * x + y * y <= radius * radius).astype(np.float32)
    result = blind_start(cv2.filter2D(texture(0), -1, disc / disc.sum()), DEPTH, CAMERA)
    assert result.outcome is Outcome.FAILED


@pytest.mark.parametrize('seed', range(3))
def test_a_sharp_picture_is_sharp(seed):
    result = blind_start(texture(seed), DEPTH, CAMERA)
    assert result.outcome is Outcome.SHARP
    assert not result.motion.vector.any()
    assert result.quality == 1


def test_a_picture_that_is_sharp_somewhere_is_not_sharp_where_bands_are_seen():
    def sharp(along, evenly, seen, alone=False):
        edges = SimpleNamespace(along=along, evenly=evenly)
        return start._without_motion(edges, seen, alone=alone) is Outcome.SHARP

    assert sharp(1.1, 1.1, 0.2)
    assert not sharp(1.05, 1.1, 0.1)
    assert not sharp(1.1, 1.0, 0.2)
    assert not sharp(1.1, 1.1, 0.3)  # no sharp picture leaves so deep bands
    assert sharp(1.1, 1.0, 0.1)
    assert not sharp(1.1, 1.0, 0.1, alone=True)  # one scale misses long blurs
    assert sharp(1.2, 1.0, 0.1, alone=True)


def test_a_still_camera_is_still_to_within_the_shortest_blur():
    still = blind_start(texture(0), DEPTH, CAMERA)
    expected = (start.SHORTEST / 2) ** 2 * np.eye(6)
    np.testing.assert_allclose(in_px(still.motion.covariance), expected, atol=1e-6)


def test_a_motion_that_is_not_found_may_be_anything():
    out_of_focus = cv2.GaussianBlur(texture(0), (0, 0), 2.5)
    failed = blind_start(out_of_focus, DEPTH, CAMERA)
    assert failed.outcome is Outcome.FAILED
    assert not failed.motion.vector.any()
    assert failed.quality == 0
    expected = start.PRIOR_PX**2 * np.eye(6)
    np.testing.assert_allclose(in_px(failed.motion.covariance), expected, atol=1e-3)


def test_the_start_does_the_same_each_time():
    grey = swept(texture(1), 12, 0.3)
    first, second = (blind_start(grey, DEPTH, CAMERA) for _ in range(2))
    np.testing.assert_array_equal(first.motion.vector, second.motion.vector)
    np.testing.assert_array_equal(first.motion.covariance, second.motion.covariance)


@pytest.mark.parametrize('factor', [1.0, -1.0, 3.0, 0.0, 1e6])
def test_a_guess_good_or_bad_does_no_harm(factor):
    guess = Motion.from_vector(factor * sideways(12, 0.3).vector)
    result = blind_start(swept(texture(1), 12, 0.3), DEPTH, CAMERA, guess)
    assert result.outcome is Outcome.SOLVED
    assert flow_error(result, sideways(12, 0.3)) < 1


@pytest.mark.parametrize(('near', 'searched'), [(0.8, False), (-1.1, False), (3.0, True)])
def test_all_is_searched_only_where_the_guess_does_not_hold(near, searched, monkeypatch):
    grey, true = swept(texture(1), 12, 0.3), sideways(12, 0.3)
    calls, find = [], start.find
    monkeypatch.setattr(start, 'find', lambda *args: calls.append(args) or find(*args))
    result = blind_start(grey, DEPTH, CAMERA, Motion.from_vector(near * true.vector))
    assert bool(calls) == searched
    assert flow_error(result, true) < 1
    cold = blind_start(grey, DEPTH, CAMERA)
    assert flow_error(result, cold.motion) < 0.2
    assert result.quality == pytest.approx(cold.quality, abs=0.01)


def test_the_covariance_is_symmetric_positive_and_covers_the_error():
    far = []
    for k, length in enumerate((5, 7, 10, 14, 18)):
        true = sideways(length, 0.5 * k)
        motion = blind_start(swept(texture(k), length, 0.5 * k, 0.005), DEPTH, CAMERA).motion
        covariance = in_px(motion.covariance)
        np.testing.assert_allclose(covariance, covariance.T, rtol=1e-6, atol=1e-9)
        assert np.linalg.eigvalsh(covariance).min() > 0
        misses = [np.linalg.solve(AXES, motion.vector - s * true.vector) for s in (1, -1)]
        far.append(min(m @ np.linalg.solve(covariance, m) for m in misses))
    assert np.median(far) < 12.6  # nineteen in twenty of chi squared, 6 degrees of freedom


@pytest.mark.parametrize('rolling', [(0, 0.015, 0), (0.015, 0, 0)])
def test_rows_that_see_different_turns_do_not_bend_the_motion(rolling):
    """A camera that speeds up while its rows are read: a pan is no roll, a tilt no zoom."""
    true = Motion([0.004, 0.045, 0.01], np.zeros(3), rolling=np.array(rolling))
    blur = blur_operator(true, DEPTH, CAMERA)
    sharp = np.repeat(texture(2, blur.latent_shape[:2])[..., None], 3, 2)
    noise = 0.005 * np.random.default_rng(0).standard_normal(DEPTH.shape)
    found = blind_start(np.float32(blur.apply(sharp)[..., 0] + noise), DEPTH, CAMERA)
    assert found.outcome is Outcome.SOLVED
    misses = [flow(found.motion.by_rows - s * true.by_rows, DEPTH, CAMERA) for s in (1, -1)]
    assert min(np.linalg.norm(miss, axis=-1).mean() for miss in misses) < 0.6
    assert flow_error(found, true) < 0.6


def test_bands_explain_what_is_near_and_nothing_else():
    true = sideways(12, 0.4)
    found = blind_start(swept(texture(1), 12, 0.4, 0.005), DEPTH, CAMERA)
    assert found.explains(found.motion)
    assert found.explains(true)
    for other in (sideways(12, 1.2), sideways(18, 0.4), sideways(6, 0.4)):
        assert not found.explains(other)


class Said:
    """A scale whose score of any motion is given."""

    def __init__(self, factor, score):
        self.factor, self.evidence = factor, score


@pytest.fixture
def said(monkeypatch):
    monkeypatch.setattr(start, 'scores', lambda qs, score: np.full(len(qs), score))
    monkeypatch.setattr(
        start, 'common_score', lambda qs, scales: np.full(len(qs), sum(s.evidence for s in scales))
    )
    return lambda *scores: [Said(2**k, score) for k, score in enumerate(scores)]


def test_a_single_scale_must_say_more_of_a_blur_below_16_px(said):
    q, soft = np.zeros(6), SimpleNamespace(along=1.0, coarse=1.0)
    assert start._trusted(q, 20.0, said(-0.16), soft)
    assert not start._trusted(q, 12.0, said(-0.16), soft)
    assert start._trusted(q, 12.0, said(-0.18), soft)
    assert start._trusted(q, 12.0, said(-0.16, -0.1), soft)  # two scales do not need it


def test_what_is_sharp_at_half_the_size_must_say_more_of_a_long_blur(said):
    q, told = np.zeros(6), said(-0.15, -0.15)
    assert not start._trusted(q, 35.0, told, SimpleNamespace(along=1.0, coarse=1.07))
    assert start._trusted(q, 35.0, told, SimpleNamespace(along=1.1, coarse=1.05))  # noise


def test_a_long_blur_is_found_in_noise():
    true = sideways(36, 0.4)
    result = blind_start(swept(texture(1), 36, 0.4, 0.02), DEPTH, CAMERA)
    assert result.outcome is Outcome.SOLVED
    assert flow_error(result, true) < 2


def test_a_short_blur_must_show_close_up_and_from_5_px_on_at_full_scale_too(said):
    q = np.zeros(6)
    assert start._short_trusted(q, 3.0, said(-0.05, -0.25))
    assert not start._short_trusted(q, 7.0, said(-0.13, -0.13))
    assert start._short_trusted(q, 7.0, said(-0.2, -0.13))
    assert not start._short_trusted(q, 4.0, said(-0.25, -0.06))  # all said by one


@pytest.mark.parametrize('length', [2.5, 3, 4])
def test_a_short_blur_is_as_long_as_it_is(length):
    found = []
    for k in range(4):
        motion = blind_start(swept(texture(k), length, 0.8 * k, 0.005), DEPTH, CAMERA).motion
        found.append(np.linalg.norm(flow(motion.vector, DEPTH, CAMERA), axis=-1).mean())
    assert np.mean(found) == pytest.approx(length, rel=0.06)


@pytest.mark.parametrize('length', [60, 70])
def test_a_blur_beyond_the_full_scale_is_not_taken_for_half_of_it(length):
    frame, true = blurred_frame(640, 480, length)
    result = blind_start(frame.image.mean(2), frame.depth, frame.camera)
    assert result.outcome is Outcome.SOLVED
    apart = [
        blur_length(result.motion.vector - s * true.vector, frame.depth, frame.camera)
        for s in (1, -1)
    ]
    assert min(apart) < 0.05 * length


@pytest.mark.parametrize('length', [50, 60])
def test_a_blur_too_long_for_a_small_picture_is_not_told_as_a_shorter_one(length):
    frame, _ = blurred_frame(320, 240, length)
    grey = frame.image.mean(2)
    assert blind_start(grey, frame.depth, frame.camera).outcome is Outcome.FAILED


def test_a_motion_that_one_more_scale_sees_otherwise_is_not_told(monkeypatch):
    picture = swept(texture(1), 20, 0.7, 0.005)
    assert blind_start(picture, DEPTH, CAMERA).outcome is Outcome.SOLVED
    monkeypatch.setattr(start, '_refuted', lambda *_: True)
    assert blind_start(picture, DEPTH, CAMERA).outcome is Outcome.FAILED
    near = sideways(20.5, 0.7)
    assert blind_start(picture, DEPTH, CAMERA, near).outcome is Outcome.SOLVED  # known before
