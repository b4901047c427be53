"""The motion between two frames, against pictures that were moved by a known one."""

from dataclasses import replace

import cv2
from depth_deblur_ros.between import motion_between, view_of
from depth_deblur_ros.core.data import CameraIntrinsics, RgbdFrame
from depth_deblur_ros.core.geometry import flow
import numpy as np
import pytest

CAMERA = CameraIntrinsics(260.0, 260.0, 159.5, 119.5, 320, 240)
RNG = np.random.default_rng(3)
GREY = cv2.GaussianBlur(RNG.random((240, 320), np.float32), (0, 0), 2.0)
GREY = np.clip((GREY - GREY.mean()) / (6 * GREY.std()) + 0.5, 0, 1)
Y, X = np.mgrid[:240, :320].astype(np.float32)
DEPTH = 1.5 + (X / 200) + 0.5 * (Y > 120)
P = np.array([0.01, -0.03, 0.02, 0.02, -0.01, 0.03])


def moved(p):
    """Give the picture after a motion: each pixel looks where it came from."""
    back = flow(p, DEPTH, CAMERA)
    for _ in range(5):  # the flow at where it came from, not at where it is
        back = cv2.remap(flow(p, DEPTH, CAMERA), X - back[..., 0], Y - back[..., 1], 1)
    return cv2.remap(GREY, X - back[..., 0], Y - back[..., 1], cv2.INTER_CUBIC)


def frame(grey, depth=DEPTH, camera=CAMERA):
    return RgbdFrame(np.clip(grey, 0, 1), depth.astype(np.float32), camera)


def between(first, second):
    return motion_between(view_of(first), view_of(second))


def test_the_motion_is_found_and_its_covariance_covers_the_error():
    p = P / 2  # what is made here is exact for small motions only
    found = between(frame(GREY), frame(moved(p)))
    np.testing.assert_allclose(found.motion[:3], p[:3], atol=0.004)
    np.testing.assert_allclose(found.motion[3:], p[3:], atol=0.01)
    miss = found.motion - p
    assert miss @ np.linalg.solve(found.covariance[:6, :6], miss) < 40


def test_brightness_may_change():
    found = between(frame(GREY), frame(0.1 + 0.6 * moved(P)))
    np.testing.assert_allclose(found.motion[:3], P[:3], atol=0.004)


@pytest.mark.parametrize('readout', [0.0, 0.6])
def test_a_way_through_a_rolling_shutter_is_what_its_look_says(readout):
    start, gain = P, np.array([0.02, -0.03, 0.01, 0, 0, 0])  # over an interval, each

    def seen(x, y):
        """Give how far points get: their rows are read at other times, at other speeds."""
        now = readout * (y - CAMERA.cy) / 240
        way, away = (flow(p, DEPTH, CAMERA) for p in (start, gain))
        until = now + 1 + readout * way[..., 1] / 240
        return (until - now)[..., None] * way + ((until**2 - now**2) / 2)[..., None] * away

    back = seen(X, Y)
    for _ in range(5):
        back = cv2.remap(seen(X, Y), X - back[..., 0], Y - back[..., 1], 1)
    second = cv2.remap(GREY, X - back[..., 0], Y - back[..., 1], cv2.INTER_CUBIC)
    found = between(frame(GREY), frame(second))
    way = found.way(1.0, readout, 0.0)
    truth = np.concatenate([start + gain / 2, gain])
    miss = way.motion - way.look @ truth
    np.testing.assert_allclose(miss[:3], 0, atol=0.005)
    np.testing.assert_allclose(miss[6:], 0, atol=0.003)
    assert np.abs(way.motion[6:] - readout * gain[:3]).max() < 0.003


def test_holes_are_left_out():
    depth = np.where(RNG.random(DEPTH.shape) < 0.3, np.nan, DEPTH)
    found = between(frame(GREY, depth), frame(moved(P), depth))
    np.testing.assert_allclose(found.motion[:3], P[:3], atol=0.006)


def test_no_motion_is_found_as_none():
    found = between(frame(GREY), frame(GREY))
    np.testing.assert_allclose(found.motion, 0, atol=1e-3)


def test_wide_pictures_are_tracked_small():
    large = cv2.resize(GREY, (1280, 960))
    view = view_of(frame(large, cv2.resize(DEPTH, (1280, 960)), CAMERA.scaled(1280, 960)))
    assert view.grey.shape == (240, 320) and view.camera == CAMERA


@pytest.mark.parametrize(
    'second',
    [
        frame(np.zeros_like(GREY)),
        frame(np.random.default_rng(9).random(GREY.shape, np.float32)),
        frame(GREY, np.full_like(DEPTH, np.nan)),
        frame(GREY, camera=replace(CAMERA, fx=300.0)),
    ],
    ids=['black', 'noise', 'no depth', 'another camera'],
)
def test_what_cannot_be_tracked_gives_nothing(second):
    first = second if np.isnan(second.depth).all() else frame(GREY)
    assert between(first, second) is None
