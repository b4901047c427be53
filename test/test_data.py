"""Records: what they refuse, and with which words; what they keep."""

from dataclasses import FrozenInstanceError, replace
import math

from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    check_exposure,
    InputError,
    MAX_PIXELS,
    MIN_SIDE,
    Motion,
    Outcome,
    RgbdFrame,
)
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

CAMERA = CameraIntrinsics(60.0, 61.0, 31.5, 23.5, 64, 48)
IMAGE = np.full((48, 64, 3), 0.5, np.float32)
DEPTH = np.full((48, 64), 2, np.float32)
HOLES = np.full((48, 64), np.nan, np.float32)
# A pyramid rounds width and height, so a level's pixels are not quite square.
sizes = st.tuples(st.integers(44, 2000), st.integers(-1, 1)).map(
    lambda pair: (pair[0], round(pair[0] * 0.75) + pair[1])
)


def with_value(array, value):
    changed = array.copy()
    changed[3, 4] = value
    return changed


@pytest.mark.parametrize(
    ('change', 'text'),
    [
        ({'fx': 0.0}, 'fx must lie in [6.4, 1280] px for a 64 px wide image, got 0.0'),
        ({'fy': -60.0}, 'fy must lie in [6.4, 1280] px'),
        ({'fx': 1e5}, 'got 100000.0'),
        ({'fx': math.nan}, 'got nan'),
        ({'fy': math.inf}, 'got inf'),
        ({'fx': '60'}, 'fx must lie in'),
        ({'fx': True}, 'fx must lie in'),
        ({'cx': -1281.0}, 'cx must lie in [-1280, 1280] px, got -1281.0'),
        ({'cx': math.nan}, 'cx must lie in'),
        ({'cy': 961.0}, 'cy must lie in [-960, 960] px, got 961.0'),
        ({'width': MIN_SIDE - 1}, f'width must be a whole number >= {MIN_SIDE} px, got 31'),
        ({'height': 0}, 'height must be a whole number'),
        ({'height': 48.0}, 'height must be a whole number'),
        ({'width': True}, 'width must be a whole number'),
        (
            {'width': 64_000, 'height': 64_000},
            f'64000x64000 is more than the limit of {MAX_PIXELS}',
        ),
        ({'distortion': (0.1, 0.2, 0.3)}, 'finite numbers k1 k2 p1 p2'),
        ({'distortion': (0.1, 0.2, 0.3, math.nan)}, 'got (0.1, 0.2, 0.3, nan)'),
        ({'transfer': 'gamma'}, "transfer must be one of ('srgb', 'linear'), got 'gamma'"),
        ({'transfer': None}, 'transfer must be one of'),
    ],
)
def test_a_camera_that_cannot_be_is_refused(change, text):
    with pytest.raises(InputError) as error:
        replace(CAMERA, **change)
    assert text in str(error.value)
    assert '\n' not in str(error.value)


@pytest.mark.parametrize(
    ('change', 'text'),
    [
        ({'image': IMAGE.astype(np.float64)}, 'image must be a float32 array, got float64'),
        ({'image': np.uint8(IMAGE)}, 'image must be a float32 array, got uint8'),
        ({'image': IMAGE.tolist()}, 'image must be a float32 array, got list'),
        ({'image': None}, 'image must be a float32 array, got NoneType'),
        ({'image': IMAGE[..., :2]}, 'shape (H, W, 3) or (H, W), got (48, 64, 2)'),
        ({'image': IMAGE[None]}, 'shape (H, W, 3) or (H, W), got (1, 48, 64, 3)'),
        ({'image': with_value(IMAGE, np.nan)}, 'image must be finite'),
        ({'image': with_value(IMAGE, -np.inf)}, 'image must be finite'),
        ({'image': with_value(IMAGE, 1.5)}, 'image must lie in [0, 1], it spans [0.5, 1.5]'),
        ({'image': with_value(IMAGE, -0.25)}, 'it spans [-0.25, 0.5]'),
        ({'image': IMAGE[:40]}, 'image is 64x40 but its camera is 64x48'),
        ({'image': IMAGE[:0]}, 'image is 64x0 but its camera is 64x48'),
        ({'depth': DEPTH[:, :32]}, 'depth is 32x48 but the image is 64x48: register'),
        ({'depth': DEPTH.astype(np.float64)}, 'depth must be a float32 array in metres'),
        ({'depth': np.uint16(1000 * DEPTH)}, 'in metres, got uint16'),
        ({'depth': DEPTH[..., None]}, 'depth must have shape (H, W), got (48, 64, 1)'),
        ({'exposure': 0.0}, 'exposure must lie in (0, 60] s, got 0.0'),
        ({'exposure': -0.02}, 'got -0.02'),
        ({'exposure': math.nan}, 'got nan'),
        ({'exposure': 61.0}, 'got 61.0'),
        ({'exposure': '0.02'}, 'exposure must lie in'),
    ],
)
def test_a_frame_that_cannot_work_is_refused(change, text):
    with pytest.raises(InputError) as error:
        replace(RgbdFrame(IMAGE, DEPTH, CAMERA, exposure=0.02), **change)
    assert text in str(error.value)
    assert '\n' not in str(error.value)


@pytest.mark.parametrize('exposure', [None, 1e-6, 0.02, 60, np.float32(0.5)])
def test_an_exposure_may_be_any_time_or_unknown(exposure):
    check_exposure(exposure)


@pytest.mark.parametrize('depth', [HOLES, np.zeros_like(DEPTH), -DEPTH, np.inf * DEPTH])
def test_holes_of_every_kind_are_no_error_of_the_record(depth):
    assert RgbdFrame(IMAGE, depth, CAMERA).depth is depth


def test_a_frame_keeps_what_it_was_given():
    grey = IMAGE[..., 0].copy()
    frame = RgbdFrame(grey, DEPTH, CAMERA, stamp_ns=7)
    assert frame.image is grey
    assert (frame.exposure, frame.stamp_ns) == (None, 7)
    with pytest.raises(FrozenInstanceError):
        frame.stamp_ns = 8


@pytest.mark.parametrize(
    ('values', 'text'),
    [
        (((0, 0), (0, 0, 0)), 'theta must have shape (3,), got (2,)'),
        (((0, 0, 0), (0, math.nan, 0)), 'v must be finite, got [0.0, nan, 0.0]'),
        (((math.inf, 0, 0), (0, 0, 0)), 'theta must be finite'),
        (((0, 0, 0), (0, 0, 0), np.eye(3)), 'covariance must have shape (6, 6), got (3, 3)'),
        ((('a', 0, 0), (0, 0, 0)), 'theta must be numbers of shape (3,)'),
        (((0, 0, [1]), (0, 0, 0)), 'theta must be numbers of shape (3,)'),
    ],
)
def test_a_motion_that_is_none_is_refused(values, text):
    with pytest.raises(InputError) as error:
        Motion(*values)
    assert text in str(error.value)


def test_a_motion_is_theta_then_v_and_cannot_change():
    p = np.arange(6.0)
    motion = Motion.from_vector(p)
    p[0] = 99
    np.testing.assert_array_equal(motion.vector, np.arange(6))
    np.testing.assert_array_equal(motion.v, [3, 4, 5])
    assert not motion.covariance.any()
    for array in (motion.theta, motion.v, motion.covariance):
        assert array.dtype == np.float64
        with pytest.raises(ValueError, match='read-only'):
            array[0] = 1
    with pytest.raises(InputError, match=r'p must have shape \(6,\) or \(9,\), got \(5,\)'):
        Motion.from_vector(np.zeros(5))


def test_an_outcome_is_its_word():
    assert [str(outcome.value) for outcome in Outcome] == ['sharp', 'solved', 'failed']
    assert Outcome('solved') == 'solved'


@given(size=sizes, x=st.floats(-0.5, 63.5), y=st.floats(-0.5, 47.5))
def test_a_scaled_camera_sees_the_same_rays(size, x, y):
    width, height = size
    small = CAMERA.scaled(width, height)
    sx, sy = width / CAMERA.width, height / CAMERA.height
    ray = (
        (sx * (x + 0.5) - 0.5 - small.cx) / small.fx,
        (sy * (y + 0.5) - 0.5 - small.cy) / small.fy,
    )
    assert ray == pytest.approx(
        ((x - CAMERA.cx) / CAMERA.fx, (y - CAMERA.cy) / CAMERA.fy), abs=1e-9
    )
    assert (small.width, small.height) == (width, height)


@given(size=sizes)
def test_scaling_there_and_back_gives_the_camera(size):
    back = CAMERA.scaled(*size).scaled(CAMERA.width, CAMERA.height)
    numbers = [(c.fx, c.fy, c.cx, c.cy) for c in (back, CAMERA)]
    assert numbers[0] == pytest.approx(numbers[1], abs=1e-9)
