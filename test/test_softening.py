"""The exposure that neighbours have in common, from how their sharpness differs."""

from depth_deblur_ros.between import View
from depth_deblur_ros.core.data import CameraIntrinsics
from depth_deblur_ros.shutter import Exposure
from depth_deblur_ros.softening import exposure_from_softness
import numpy as np
import pytest

CAMERA = CameraIntrinsics(200.0, 200.0, 127.5, 95.5, 256, 192)
DEPTH = np.full((192, 256), 2.0, np.float32)
INTERVAL, T = 1 / 30, 0.02  # s
RNG = np.random.default_rng(3)
FX, FY = np.fft.fftfreq(256), np.fft.fftfreq(192)[:, None]
SCENE = np.fft.fft2(RNG.normal(size=(192, 256))) / (0.03 + np.hypot(FX, FY))


def view(place, speed, exposure=T, noise=0.5):
    """Give the scene moved by place and blurred by speed [px/s] along x, exactly."""
    spectrum = SCENE * np.exp(-2j * np.pi * FX * place) * np.sinc(FX * speed * exposure)
    picture = np.fft.ifft2(spectrum).real
    grey = 110 + 40 * picture / np.fft.ifft2(SCENE).real.std() + RNG.normal(0, noise, DEPTH.shape)
    return View(np.clip(np.rint(grey), 0, 255).astype(np.uint8), DEPTH, CAMERA)


def motion(pixels):
    """Give the motion (6,) that moves the wall by so many pixels along x."""
    return np.array([0, 0, 0, pixels * 2.0 / 200, 0, 0])


def asked(views, velocities, way, known=None):
    first, second = zip(views, velocities, strict=True)
    return exposure_from_softness(first, second, motion(way), known=known, longest=INTERVAL)


def found(speeds, exposures=(T, T), known=None, noise=0.5):
    way = sum(speeds) / 2 * INTERVAL
    views = [
        view(k * way, s, e, noise) for k, (s, e) in enumerate(zip(speeds, exposures, strict=True))
    ]
    velocities = [motion(speed) for speed in speeds]
    return asked(views, velocities, way, known)


@pytest.mark.parametrize('speeds', [(20, 60), (90, 30), (-30, 75), (10, -100)])
def test_blurs_of_two_pixels_and_less_tell_the_exposure(speeds):
    exposure = found(speeds)
    assert exposure.seconds == pytest.approx(T, rel=0.12)
    assert 0.1 < exposure.doubt < 0.4


def test_steady_motion_tells_nothing():
    assert found((60, 60)) is None
    assert found((0, 0)) is None


def test_noise_is_foreseen():
    guesses = [found((15, 30), known=Exposure(T, 0.1), noise=4) for _ in range(8)]
    for guess in guesses:
        assert guess is None or abs(np.log(guess.seconds / T)) < 3 * guess.doubt


def test_another_scene_is_not_believed():
    other = View(np.roll(view(0, 60).grey, 97, axis=1), DEPTH, CAMERA)
    velocities = (motion(20), motion(60))
    wrong = asked((view(0, 20), other), velocities, 1.3)
    assert wrong is None or wrong.doubt > 0.3


def test_without_depth_or_overlap_there_is_no_answer():
    hole = View(view(0, 20).grey, np.full_like(DEPTH, np.nan), CAMERA)
    velocities = (motion(20), motion(60))
    for first, way in ((hole, 1.3), (view(0, 20), 250)):
        views = (first, view(1.3, 60))
        assert asked(views, velocities, way) is None
    flat = View(np.full(DEPTH.shape, 90, np.uint8), DEPTH, CAMERA)
    assert asked((flat, flat), velocities, 1) is None


def test_no_exposure_is_longer_than_it_can_be():
    views = [view(0, 30), view(1.5, 90)]
    slow = [motion(0.3), motion(0.9)]  # as a camera that starts again looks at first
    assert asked(views, slow, 1.5) is None
