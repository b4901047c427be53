"""The paper's start: one kernel for the whole image, on pictures whose kernel is known."""

import math

from depth_deblur_ros.core.data import CameraIntrinsics
from depth_deblur_ros.core.geometry import flow
from depth_deblur_ros.core.uniform import motions_of_flow, streak, uniform_kernel
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
from pictures import swept, texture
import pytest

CAMERA = CameraIntrinsics(200.0, 210.0, 79.0, 61.0, 160, 120)


def off(found, true):
    """Give the distance of two flows, up to their sign."""
    return min(math.dist(found, true), math.dist(found, -true))


def line(length, angle, size=25, width=0.0):
    """Give the kernel of a straight blur, by many points that share their weight bilinearly."""
    k = np.zeros((size, size))
    across = np.random.default_rng(0).uniform(-width / 2, width / 2, 4000)
    for t, n in zip((np.arange(4000) + 0.5) / 4000 - 0.5, across, strict=True):
        x = size // 2 + t * length * math.cos(angle) - n * math.sin(angle)
        y = size // 2 + t * length * math.sin(angle) + n * math.cos(angle)
        u, v = x % 1, y % 1
        k[int(y), int(x)] += (1 - u) * (1 - v)
        k[int(y), int(x) + 1] += u * (1 - v)
        k[int(y) + 1, int(x)] += (1 - u) * v
        k[int(y) + 1, int(x) + 1] += u * v
    return k / k.sum()


@given(st.floats(4, 20), st.floats(0, math.pi))
def test_the_streak_of_a_straight_kernel_is_its_flow(length, angle):
    u = length * np.array([math.cos(angle), math.sin(angle)])
    # Bilinear weights widen a line of 4 px by at most 0.24 px.
    assert off(streak(line(length, angle)), u) < 0.3


def test_a_point_has_no_streak():
    k = np.zeros((9, 9))
    k[4, 4] = 1
    assert not streak(k).any()


def test_a_streak_does_not_ask_where_in_the_kernel_it_lies():
    k = line(8.0, 0.4)
    np.testing.assert_allclose(streak(np.roll(k, (3, -4), (0, 1))), streak(k), atol=1e-9)


@pytest.mark.parametrize(('length', 'angle'), [(7.0, 0.3), (11.0, 1.2), (13.0, 2.5)])
def test_the_kernel_of_a_swept_picture_is_found(length, angle):
    blurred = swept(texture(3, (200, 260)), length, angle, sigma=0.002)
    kernel = uniform_kernel(blurred, 25)
    assert kernel.sum() == pytest.approx(1)
    assert kernel.min() >= 0
    u = length * np.array([math.cos(angle), math.sin(angle)])
    assert off(streak(kernel), u) < 0.25 * length


def test_an_even_picture_gives_a_kernel_all_the_same():
    kernel = uniform_kernel(np.full((64, 80), 0.5, np.float32), 15)
    assert np.isfinite(kernel).all()
    assert kernel.sum() == pytest.approx(1)


def test_the_kernel_is_the_same_each_time():
    blurred = swept(texture(1, (80, 100)), 5.0)
    assert (uniform_kernel(blurred, 11) == uniform_kernel(blurred, 11)).all()


def test_the_motion_of_a_flow_gives_that_flow_back():
    u, depth = np.array([6.0, -4.0]), np.full((120, 160), 2.0, np.float32)
    turn, shift = (flow(p, depth, CAMERA) for p in motions_of_flow(u, depth, CAMERA))
    np.testing.assert_allclose(shift, np.broadcast_to(u, shift.shape), atol=1e-4)
    # A rotation bends the flow towards the corners, by tan^2 of 22 degrees at most.
    np.testing.assert_allclose(turn.mean((0, 1)), u, rtol=0.02)
    assert np.hypot(*(turn - u).transpose(2, 0, 1)).max() < 0.2 * math.hypot(*u)


def test_a_turn_and_a_shift_are_proposed():
    turn, shift = motions_of_flow(np.array([3.0, 1.0]), np.ones((120, 160), np.float32), CAMERA)
    assert turn[:3].any() and not turn[3:].any()
    assert shift[3:].any() and not shift[:3].any()
