"""The twist as robot_localization takes it: its frame, its order, its signs, its covariance."""

from pathlib import Path

from depth_deblur_ros.core.data import CameraIntrinsics, DeblurResult, Motion, Outcome
from depth_deblur_ros.core.geometry import rotation_matrix
from depth_deblur_ros.messages import header_fields
from depth_deblur_ros.results import MOTION_WITH_COVARIANCE, result_messages
import numpy as np
import pytest
from scene import Pose
from shake import motion_between
import yaml

ROOT = Path(__file__).resolve().parents[1]
CAMERA = CameraIntrinsics(500, 500, 31.5, 23.5, 64, 48)
HEADER = header_fields(1_305_031_231_096_775_000, 'camera_rgb_optical_frame')
OPTICAL = np.array([[0.0, 0, 1], [-1, 0, 0], [0, -1, 0]])  # its axes in those of the robot
PLACE = np.array([0.3, 0.1, 0.5])  # m, of the camera on the robot
SPEED, YAW = np.array([0.6, 0.0, 0.0]), np.array([0.0, 0.0, 0.4])  # m/s, rad/s of the robot
T = 0.02  # s


def camera_at(time):
    """Give the camera's pose in the world while the robot drives along a circle."""
    turn = rotation_matrix(time * YAW)
    radius = SPEED[0] / YAW[2]
    robot = radius * np.array([np.sin(time * YAW[2]), 1 - np.cos(time * YAW[2]), 0])
    return Pose(turn @ OPTICAL, robot + turn @ PLACE)


def sent(sign=True, outcome=Outcome.SOLVED):
    motion = motion_between(*(camera_at(t) for t in (-T / 2, 0, T / 2)))
    spread = np.diag([1e-8, 2e-8, 3e-8, 4e-6, 5e-6, 6e-6])
    result = DeblurResult(
        np.zeros((48, 64, 3), np.float32),
        np.ones((48, 64), np.float32),
        *(Motion(motion.theta, motion.v, spread), outcome, sign, 1.0, 5.0, 0.1),
    )
    return dict(result_messages(result, CAMERA, T, HEADER, doubt=0.05))[MOTION_WITH_COVARIANCE]


def on_the_robot(message):
    """Turn linear and angular velocity (3,) each and the covariance as its prepareTwist does."""
    twist = message['twist']['twist']
    linear, angular = (
        np.array([twist[part][axis] for axis in 'xyz']) for part in ('linear', 'angular')
    )
    both = np.kron(np.eye(2), OPTICAL)
    covariance = both @ np.reshape(message['twist']['covariance'], (6, 6)) @ both.T
    return OPTICAL @ linear + np.cross(PLACE, YAW), OPTICAL @ angular, covariance


def test_the_robots_own_velocity_comes_out():
    linear, angular, covariance = on_the_robot(sent())
    np.testing.assert_allclose(linear, SPEED, atol=1e-3)
    np.testing.assert_allclose(angular, YAW, atol=1e-3)
    # forward is z of the camera, up is -y: v_z and theta_y of the motion, over T squared
    assert covariance[0, 0] == pytest.approx(6e-6 / T**2, rel=0.2)
    assert covariance[5, 5] == pytest.approx(2e-8 / T**2 + (0.05 * 0.4) ** 2, rel=0.01)


@pytest.mark.parametrize('sign', [True, False])
@pytest.mark.parametrize('outcome', list(Outcome))
def test_the_covariance_is_one_and_nothing_is_certain(sign, outcome):
    message = sent(sign, outcome)
    covariance = np.reshape(message['twist']['covariance'], (6, 6))
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.isfinite(covariance).all()
    assert np.linalg.eigvalsh(covariance).min() > 1e-9  # below, it is taken for a mistake
    assert message['header']['frame_id'] == 'camera_rgb_optical_frame'


def test_the_example_for_its_filter_takes_all_six_velocities():
    told = yaml.safe_load((ROOT / 'config/robot_localization.yaml').read_text())
    parameters = told['ekf_filter_node']['ros__parameters']
    assert parameters['twist0'] == MOTION_WITH_COVARIANCE
    assert parameters['twist0_config'] == [False] * 6 + [True] * 6 + [False] * 3
