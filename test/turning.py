"""A camera that turns before a painted wall: its frames, and a solver that knows the blur."""

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, DeblurResult, Motion, Outcome, RgbdFrame
from depth_deblur_ros.core.geometry import blur_length, rotation_matrix
import numpy as np

CAMERA = CameraIntrinsics(160.0, 160.0, 95.5, 71.5, 192, 144)
K = np.array([[160.0, 0, 95.5], [0, 160.0, 71.5], [0, 0, 1]])
STEP_NS = 33_000_000
START_NS = 1_700_000_000_000_000_000
EXPOSURE = 0.015
SHOTS = 7  # of one exposure
RNG = np.random.default_rng(5)
WALL = cv2.GaussianBlur(RNG.random((500, 900), np.float32), (0, 0), 2.5)
WALL = np.clip((WALL - WALL.mean()) / (6 * WALL.std()) + 0.5, 0, 1)
DEPTH = np.broadcast_to(np.linspace(1.5, 3, 192, dtype=np.float32), (144, 192)).copy()


def angle(seconds):
    """Give the rotation vector of the scene against the start."""
    return np.array([0.09 * np.sin(5 * seconds), 0.36 * np.sin(6 * seconds), 0.15 * seconds])


def rate(seconds):
    return (angle(seconds + 1e-4) - angle(seconds - 1e-4)) / 2e-4


def picture(seconds):
    """Give what the camera sees: the wall is far away, so that only the turn counts."""
    middle = np.array([[160.0, 0, 449.5], [0, 160.0, 249.5], [0, 0, 1]])
    turn = K @ rotation_matrix(angle(seconds)) @ np.linalg.inv(middle)
    grey = cv2.warpPerspective(WALL, turn, (192, 144), flags=cv2.INTER_CUBIC)
    return np.repeat(np.clip(grey, 0, 1)[..., None], 3, 2)


def blurred(seconds, exposure):
    """Give what the camera sees during an exposure around that time."""
    times = seconds + exposure * (np.arange(SHOTS) - (SHOTS - 1) / 2) / SHOTS
    return np.mean([picture(time) for time in times], axis=0, dtype=np.float32)


def frame(number, seconds=None, exposure=None, image=None, open_for=EXPOSURE):
    """Give the frame of that number: its stamp, and what is seen at that time on the path."""
    seconds = number * STEP_NS / 1e9 if seconds is None else seconds
    return RgbdFrame(
        blurred(seconds, open_for) if image is None else image,
        DEPTH,
        CAMERA,
        exposure,
        START_NS + number * STEP_NS,
    )


class Knowing:
    """A solver that knows the motion, but never its sign; it remembers where it was started."""

    def __init__(self, exposure=EXPOSURE, time=lambda stamp: (stamp - START_NS) / 1e9):
        self.exposure, self.time = exposure, time
        self.starts, self.rng = [], np.random.default_rng(1)

    def __call__(self, frame, params, *, start=None):
        self.starts.append(start)
        plain = frame.image.std() < 0.01
        seconds = self.time(frame.stamp_ns)
        p = np.concatenate([self.exposure * rate(seconds), np.zeros(3)])
        p *= self.rng.choice([-1, 1]) * self.rng.normal(1, 0.03)
        blur_px = blur_length(p, DEPTH, CAMERA)
        outcome = Outcome.FAILED if plain else Outcome.SOLVED if blur_px > 1 else Outcome.SHARP
        if outcome is not Outcome.SOLVED:
            p, blur_px = np.zeros(6), 0.0
        covariance = np.diag([1e-3] * 3 + [3e-3] * 3) ** 2
        motion = Motion.from_vector(p, covariance)
        return DeblurResult(frame.image, DEPTH, motion, outcome, False, 1.0, blur_px, 0.0)
