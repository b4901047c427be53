"""Stored values and light: exact cases, there and back, slope."""

from depth_deblur_ros.core.light import (
    light_ease,
    light_from_stored,
    light_slope,
    SLOPE_FLOOR,
    stored_and_ease,
    stored_from_light,
)
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
import numpy as np
import pytest

EVERY_8_BIT = np.arange(256, dtype=np.float32) / np.float32(255)
FINE = np.linspace(0, 1, 20001, dtype=np.float32)
transfers = pytest.mark.parametrize('transfer', ['srgb', 'linear'])
values = hnp.arrays(np.float32, (4, 5, 3), elements=st.floats(0, 1, width=32))


def srgb_curve(v):
    """Give [sRGB] in float64."""
    v = np.asarray(v, np.float64)
    return np.where(v <= 0.04045, v / 12.92, ((v + 0.055) / 1.055) ** 2.4)


@transfers
def test_black_and_white_stay(transfer):
    ends = np.array([0, 1], np.float32)
    np.testing.assert_array_equal(light_from_stored(ends, transfer), ends)
    np.testing.assert_array_equal(stored_from_light(ends, transfer), ends)


def test_the_curve_is_that_of_the_standard():
    np.testing.assert_allclose(light_from_stored(FINE, 'srgb'), srgb_curve(FINE), atol=2e-7)
    assert light_from_stored(np.float32([0.5]), 'srgb')[0] == pytest.approx(0.2140, abs=1e-4)


@given(stored=values)
@transfers
def test_there_and_back_gives_the_stored_values(transfer, stored):
    light = light_from_stored(stored, transfer)
    assert light.dtype == np.float32
    assert light.shape == stored.shape
    np.testing.assert_allclose(stored_from_light(light, transfer), stored, atol=1e-6)


@transfers
def test_every_8_bit_value_survives(transfer):
    back = stored_from_light(light_from_stored(EVERY_8_BIT, transfer), transfer)
    np.testing.assert_array_equal(np.rint(255 * back), np.arange(256))


@transfers
def test_more_is_more(transfer):
    assert (np.diff(light_from_stored(FINE, transfer)) > 0).all()
    assert (np.diff(stored_from_light(FINE, transfer)) > 0).all()
    assert (np.diff(light_slope(FINE, transfer)) >= 0).all()


@transfers
def test_light_beyond_black_and_white_is_clipped(transfer):
    light = np.array([-3, -1e-6, 1 + 1e-6, 40], np.float32)
    np.testing.assert_array_equal(stored_from_light(light, transfer), [0, 0, 1, 1])


def test_the_slope_is_the_derivative_down_to_its_floor():
    step = 1e-5
    stored = np.linspace(0.001, 0.999, 500)
    slope = (srgb_curve(stored + step) - srgb_curve(stored - step)) / (2 * step)
    found = light_slope(stored.astype(np.float32), 'srgb')
    np.testing.assert_allclose(found, np.maximum(slope, SLOPE_FLOOR), rtol=1e-5)
    assert found[0] == np.float32(SLOPE_FLOOR)
    np.testing.assert_array_equal(light_slope(FINE, 'linear'), 1)


@transfers
def test_ease_is_one_over_the_squared_slope(transfer):
    slope = light_slope(FINE, transfer)
    np.testing.assert_allclose(light_ease(FINE, transfer), 1 / slope**2, rtol=1e-3)


@transfers
def test_stored_values_and_ease_come_as_one_by_one(transfer):
    light = np.linspace(-0.1, 1.5, 3000, dtype=np.float32).reshape(3, 20, 50)[:, ::2]
    stored, ease = stored_and_ease(light, transfer)
    np.testing.assert_allclose(stored, stored_from_light(light, transfer), atol=1e-6)
    np.testing.assert_allclose(ease, light_ease(stored, transfer), rtol=1e-3)
