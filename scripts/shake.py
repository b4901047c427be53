"""
A hand-held camera in a scene: its path, its blurred pictures, and the motion that made them.

The picture is the mean of exact views in linear light: it shares nothing with the solver's blur.
"""

from __future__ import annotations

from dataclasses import dataclass, field
import math

from depth_deblur_ros.core.data import CameraIntrinsics, Motion
from depth_deblur_ros.core.geometry import flow, rotation_matrix
import numpy as np
from raycast import Array, Light
from scene import Pose, Scene
from scipy.spatial.transform import Rotation

MIN_VIEWS = 33
FREQUENCIES = np.array([0.9, 2.1, 4.3, 7.7])  # Hz; sway of the arm to tremor of the hand
SHARES = np.array([0.6, 0.65, 0.4, 0.15])  # of the speed; squares add up to about 1
AXES = np.array([1.0, 1.0, 0.7, 1.0, 1.0, 0.8])  # a hand rolls and pushes less than it nods


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Swings about a pose at rest: the offset at time t is the sum of a sin(2 pi f t + phase)."""

    rest: Array  # (3, 3), the camera's rotation without the swings
    amplitude: Array  # (K, 6): rotation vector [rad], then centre [m]
    phase: Array  # (K, 6)
    frequency: Array = field(default_factory=lambda: FREQUENCIES)  # (K,), Hz

    def pose(self, t: float) -> Pose:
        """Give the camera's pose at time t [s]."""
        angle = 2 * math.pi * self.frequency[:, None] * t + self.phase
        offset = (self.amplitude * np.sin(angle)).sum(axis=0)
        return Pose(self.rest @ rotation_matrix(offset[:3]), offset[3:])


def hand_held(seed: int, turn: float, speed: float, nod: float = -0.14) -> Trajectory:
    """
    Make a hand-held path with that root mean square turn rate [rad/s] and speed [m/s].

    nod: rotation about x of the camera at rest [rad], negative looks down.
    """
    rng = np.random.default_rng(seed)
    rate = np.repeat([turn, speed], 3) * AXES / np.linalg.norm(AXES[:3])
    amplitude = SHARES[:, None] * rate * math.sqrt(2) / (2 * math.pi * FREQUENCIES[:, None])
    phase = rng.uniform(0, 2 * math.pi, (len(FREQUENCIES), 6))
    return Trajectory(rotation_matrix([nod, 0, 0]), amplitude, phase)


def driven(seed: int, turn: float, speed: float) -> Trajectory:
    """
    Make a robot's path: slow turns and drives of these greatest rates [rad/s, m/s], vibrations.

    It turns about the vertical and drives to and fro and sideways, as far as the room allows.
    """
    rng = np.random.default_rng(seed)
    frequency = np.array([0.25, 0.6, 9.0])
    rates = np.array(
        [
            [0.02, turn, 0.01, 0.3 * speed, 0.0, speed],
            [0.05, 0.5 * turn, 0.03, 0.3 * speed, 0.02, 0.4 * speed],
            [0.08, 0.03, 0.05, 0.01, 0.03, 0.01],
        ]
    )
    amplitude = rates / (2 * math.pi * frequency[:, None])
    phase = rng.uniform(0, 2 * math.pi, amplitude.shape)
    return Trajectory(rotation_matrix([-0.1, 0, 0]), amplitude, phase, frequency)


def motion_between(first: Pose, middle: Pose, last: Pose) -> Motion:
    """
    Give the motion over an exposure from the poses at its start, middle and end.

    A point X of the middle camera is at R_k X + v_k in camera k, where R_k is rotation_k'
    rotation_middle and v_k is rotation_k' (centre_middle - centre_k). theta is the rotation from
    first to last, v is v_last - v_first.
    """
    turned = last.rotation.T @ first.rotation
    theta = Rotation.from_matrix(turned).as_rotvec()
    v_first = first.rotation.T @ (middle.centre - first.centre)
    v_last = last.rotation.T @ (middle.centre - last.centre)
    return Motion(theta, v_last - v_first)


def true_motion(path: Trajectory, middle: float, exposure: float) -> Motion:
    """Give the motion over the exposure around the time middle [s]."""
    return motion_between(*(path.pose(middle + t * exposure) for t in (-0.5, 0.0, 0.5)))


def blur_lengths(motion: Motion, depth: Array, camera: CameraIntrinsics) -> Array:
    """Give the length (H, W) [px] of each pixel's path over the exposure."""
    paths = flow(motion.vector, depth, camera)
    return np.hypot(paths[..., 0], paths[..., 1], dtype=np.float64)


def render_blurred(
    scene: Scene,
    camera: CameraIntrinsics,
    path: Trajectory,
    middle: float,
    exposure: float,
    *,
    least: int = MIN_VIEWS,
) -> Light:
    """
    Render the linear light (H, W, 3) that comes in during the exposure around the time middle [s].

    The mean over views at the mid-points of equal shares of the exposure, one for each pixel of
    the longest blur and at least this many.
    """
    depth = scene.depth(camera, path.pose(middle)).depth
    longest = blur_lengths(true_motion(path, middle, exposure), depth, camera).max()
    views = max(least, math.ceil(longest))
    total = np.zeros((camera.height, camera.width, 3))
    for k in range(views):
        total += scene.light(camera, path.pose(middle + ((k + 0.5) / views - 0.5) * exposure))
    return np.asarray(total / views, np.float32)
