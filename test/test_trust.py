"""Whether there is blur at all, and how much a motion is worth."""

import cv2
from depth_deblur_ros.core.data import Motion
from depth_deblur_ros.core.trust import (
    calibrated,
    covariance_from_curvature,
    edges_of,
    LEAST_ERROR,
    sharpness,
)
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from pictures import swept, texture
import pytest

PRIOR = 40.0


def test_sharpness_falls_with_the_blur():
    grey = texture(0)
    blurred = [grey, *(swept(grey, length) for length in (3, 6, 12, 24))]
    found = [sharpness(image)[0] for image in blurred]
    assert (np.diff(found) < 0).all()
    assert found[0] > 1.15
    assert found[-1] == pytest.approx(1, abs=0.02)


@pytest.mark.parametrize('angle', np.linspace(0, np.pi, 6, endpoint=False))
def test_blur_along_any_direction_is_seen(angle):
    least, most = sharpness(swept(texture(2), 10, angle))
    assert least < 1.06
    assert most > 1.07


def test_what_is_blurred_somewhere_is_not_evenly_sharp():
    grey = texture(0)
    height, width = grey.shape
    partly, plain = grey.copy(), grey.copy()
    partly[: height // 2, : width // 2] = swept(grey, 24)[: height // 2, : width // 2]
    plain[: height // 2, : width // 2] = 0.5
    assert edges_of(grey).evenly > 1.1
    assert edges_of(partly).along > 1.1
    assert edges_of(partly).evenly < 1.045
    assert edges_of(plain).evenly > 1.1  # a quarter without edges tells nothing


def test_noise_is_sharp():
    assert sharpness(np.random.default_rng(0).random((120, 160), np.float32))[0] > 1.5


def test_sharpness_is_blind_to_brightness_and_contrast():
    grey = texture(3)
    assert sharpness(np.float32(0.2) + np.float32(0.1) * grey) == pytest.approx(
        sharpness(grey), rel=1e-3
    )


def test_a_plain_picture_gives_a_number():
    assert np.isfinite(sharpness(np.full((100, 100), 0.5, np.float32))).all()


def test_a_picture_out_of_focus_is_not_sharp():
    assert sharpness(cv2.GaussianBlur(texture(0), (0, 0), 4))[1] < 1.07


@given(seed=st.integers(0, 2**32 - 1), size=st.floats(-6, 3))
def test_any_curvature_gives_a_covariance(seed, size):
    """Symmetric, positive, and never wider than the prior, however the score bends."""
    bend = 10**size * np.random.default_rng(seed).standard_normal((6, 6))
    covariance = covariance_from_curvature(bend, 400.0, PRIOR)
    np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9, atol=1e-12)
    values = np.linalg.eigvalsh(covariance)
    assert values[0] > 0
    assert values[-1] <= PRIOR**2 * (1 + 1e-9)


def test_a_sharp_optimum_is_worth_its_curvature():
    covariance = covariance_from_curvature(np.diag([4.0, 1, 1, 1, 1, 0]), 100.0, PRIOR)
    np.testing.assert_allclose(np.diag(covariance)[[0, 1, 5]], [1 / 400, 1 / 100, 1600], rtol=1e-4)


def test_a_calibrated_covariance_is_a_share_of_the_old_and_the_least_error():
    axes = np.diag([1.0, 2, 3, 4, 5, 6])
    motion = Motion.from_vector(np.arange(6.0), np.eye(6))
    found = calibrated(motion, axes, 0.25, 0.0)
    np.testing.assert_array_equal(found.vector, motion.vector)
    expected = np.diag(0.25 + np.square(np.diag(axes) * LEAST_ERROR))
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-12)
    sure = calibrated(Motion.from_vector(motion.vector), axes, 0.25, 0.0)
    deviations = np.sqrt(np.diag(sure.covariance)) / np.diag(axes)
    np.testing.assert_allclose(deviations, LEAST_ERROR)


def test_parallaxes_of_long_blurs_are_less_certain():
    """Depth errs by a share, and so does what is told by it."""
    motion = Motion.from_vector(np.zeros(6))
    short, long = (np.diag(calibrated(motion, np.eye(6), 1.0, px).covariance) for px in (0, 50))
    np.testing.assert_array_equal(short[:4], long[:4])
    assert (np.sqrt(long[4:]) > [0.35, 0.15]).all()
