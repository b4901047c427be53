"""A gyro counts for as much as it has proved to be worth."""

from types import SimpleNamespace

from depth_deblur_ros.core.data import InputError
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.gyro import Gyro, rotation
from depth_deblur_ros.messages import filled
from depth_deblur_ros.tracking import Tracker
import numpy as np
import pytest
from turning import EXPOSURE, frame, Knowing, rate, START_NS, STEP_NS

MOTION = SolverParams(mode='motion')
BIAS = np.array([0.02, -0.01, 0.015])


def imu(stamp, turn):
    made = SimpleNamespace(
        header=SimpleNamespace(stamp=SimpleNamespace(sec=0, nanosec=0), frame_id=''),
        angular_velocity=SimpleNamespace(x=0.0, y=0.0, z=0.0),
    )
    header = {'stamp': {'sec': stamp // 10**9, 'nanosec': stamp % 10**9}, 'frame_id': 'imu'}
    return filled(
        made,
        {
            'header': header,
            'angular_velocity': dict(zip('xyz', turn.tolist(), strict=True)),
        },
    )


def fed(gyro, wrong=lambda turn: turn, lag=0.0):
    """Let a gyro feel a turning camera at 200 Hz: its own turn is that of the scene, reversed."""
    rng = np.random.default_rng(0)
    for i in range(-5, 180):
        t = i / 200
        turn = wrong(-rate(t - lag)) + BIAS + rng.normal(0, 0.003, 3)
        gyro.take(imu(START_NS + round(1e9 * t), turn))


def errors(frames=14, plain=False, exposure=None, **gyro):
    tracker, found = Tracker(Knowing()), []
    if gyro is not None and gyro.pop('use', True):
        fed(tracker.gyro, **gyro)
    for i in range(frames):
        image = np.zeros((144, 192, 3), np.float32) if plain else None
        tracked = tracker.follow(frame(i, exposure=exposure, image=image), MOTION)
        truth, seconds = rate(i * STEP_NS / 1e9), tracked.exposure
        known = seconds and tracked.result.sign_resolved
        got = tracked.result.motion.theta / seconds.seconds if known else np.zeros(3)
        found.append(np.linalg.norm(got - truth))
    return np.array(found), tracker


def test_a_good_gyro_helps():
    without, with_ = errors(use=False)[0], errors()[0]
    assert np.square(with_[7:]).mean() < 0.8 * np.square(without[7:]).mean()


@pytest.mark.parametrize(
    'gyro',
    [
        {'wrong': lambda turn: -turn},
        {'wrong': lambda turn: turn[[1, 2, 0]]},
        {'lag': 0.05},
        {'wrong': lambda turn: turn + 0.2},
        {'wrong': lambda turn: 0 * turn},
    ],
    ids=['reversed', 'swapped', 'late', 'offset', 'silent'],
)
def test_a_wrong_gyro_does_no_harm(gyro):
    without, with_ = errors(use=False)[0], errors(**gyro)[0]
    assert np.square(with_).mean() <= 1.1**2 * np.square(without).mean()


def test_the_bias_is_found():
    _, tracker = errors()
    assert np.linalg.norm(tracker.gyro.trial.bias - BIAS) < 0.04
    assert tracker.gyro.trial.passed


@pytest.mark.parametrize('lag', [0.005, -0.008, 0.02])
def test_a_lag_is_found(lag):
    _, tracker = errors(frames=24, lag=lag)
    assert tracker.gyro.trial.lag == pytest.approx(lag, abs=0.003)
    assert tracker.gyro.trial.passed


def test_frames_without_texture_take_their_turn_from_the_gyro():
    found, _ = errors(plain=True, exposure=EXPOSURE)
    truth = [np.linalg.norm(rate(i * STEP_NS / 1e9)) for i in range(14)]
    moving = np.array(truth) > 1
    moving[:6] = False
    assert np.median(found[moving] / np.array(truth)[moving]) < 0.1


def test_the_delay_and_the_axes_can_be_told():
    gyro = Gyro()
    quarter = rotation('0 0 0.70710678 0.70710678')
    for i in range(20):
        gyro.take(imu(START_NS + i * 5_000_000, quarter.T @ np.array([0.0, 0.01 * i, 0.0])))
    told = SolverParams(gyro_rotation='0 0 0.70710678 0.70710678', gyro_delay_s=-0.01)
    turn = gyro.turn(START_NS + 40_000_000, 0.021, told)
    np.testing.assert_allclose(turn, [0, -0.1, 0], atol=1e-7)
    assert gyro.turn(START_NS + 10**9, 0.02, told) is None


def test_readings_that_are_no_numbers_are_left_out():
    gyro = Gyro()
    gyro.take(imu(START_NS, np.array([np.nan, 0, 0])))
    assert gyro.turn(START_NS, 0.02, MOTION) is None


@pytest.mark.parametrize('text', ['', '0 0 1', '0 0 0 2', 'a b c d', '0 0 0 nan'])
def test_a_rotation_that_is_none_is_refused(text):
    with pytest.raises(InputError, match='gyro_rotation'):
        rotation(text)
