"""
The camera's motion from one frame to the next, from points that are tracked between them.

Points are followed by pyramidal Lucas-Kanade both ways, and the motion is fitted to their flow at
the depth midway, docs/method.md (40) to (42). Blur does no harm as long as both frames have much
the same: what is tracked is the middle of the exposure.
[B00] Bouguet, Pyramidal implementation of the Lucas Kanade feature tracker, Intel, 2000.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, RgbdFrame, Vector
from depth_deblur_ros.core.geometry import interaction_matrix
from depth_deblur_ros.glide import Way
import numpy as np
import numpy.typing as npt

WIDTH = 400  # px; wider images are halved until they are no wider
CORNERS, QUALITY, APART = 400, 0.005, 6  # of goodFeaturesToTrack; the last in px
WINDOW, LEVELS = (15, 15), 4
THERE_AND_BACK = 0.7  # px; a track that does not come back is none
SAME_SURFACE = 0.15  # relative depth between both ends of a track
ROUNDS = 12
FINEST = 0.2  # px; no track is better than this
ROLL_RIDGE = 40.0  # px^2/rad^2; keeps what nothing tells of a rolling shutter near zero
CUT = 3.0  # standard deviations; what is farther off does not count
FEWEST, LEAST_SHARE = 20, 0.4  # of the tracks must agree
OPTIMISM = 2.0  # times variance: errors of tracks are alike, the more so the larger they are


@dataclass(frozen=True, eq=False)
class View:
    """One frame as it is tracked: grey (H, W) 8 bit, depth (H, W) [m] with NaN, its camera."""

    grey: npt.NDArray[np.uint8]
    depth: FloatImage
    camera: CameraIntrinsics


@dataclass(frozen=True, eq=False)
class Between:
    """
    The motion (6,) over the time between two frames, as Motion tells it, with what else was seen.

    found (9,): that motion, and by how much the turn of the last row differs from that of the
    first, as a rolling shutter makes it; covariance (9, 9). stretch (9, 6), skew (9, 6): what a
    shutter that reads all rows within one interval makes of the motion, and of its change, (46).
    """

    found: Vector
    covariance: Vector
    stretch: Vector
    skew: Vector

    @property
    def motion(self) -> Vector:
        """Give the motion (6,) alone."""
        return self.found[:6]

    def way(self, seconds: float, readout: float | Vector, doubt: float) -> Way:
        """Give it as a way of some time [s], uncertain by a share; readout (...) of all rows."""
        rolled = np.asarray(readout)[..., None, None]
        plain = np.eye(9, 12)
        plain[6:] = 0
        parts = [self.stretch / seconds, self.skew * seconds]
        look = plain + rolled * np.concatenate(parts, 1)
        covariance = self.covariance.copy()
        covariance[:6, :6] += doubt**2 * np.outer(self.motion, self.motion)
        return Way(self.found, covariance, look)


def view_of(frame: RgbdFrame) -> View:
    """Give a frame as it is tracked, small, at even brightness and contrast."""
    factor = 1
    while frame.camera.width // factor > WIDTH:
        factor *= 2
    width, height = frame.camera.width // factor, frame.camera.height // factor
    small = cv2.resize(frame.image, (width, height), interpolation=cv2.INTER_AREA)
    if small.ndim == 3:
        small = cv2.transform(small, np.full((1, 3), 1 / 3))
    mean, spread = (float(value[0, 0]) for value in cv2.meanStdDev(small))
    even = 110 + 50 * (small - np.float32(mean)) / np.float32(max(spread, 1 / 255))
    depth = cv2.resize(frame.depth, (width, height), interpolation=cv2.INTER_NEAREST)
    return View(
        np.asarray(np.clip(even, 0, 255), np.uint8),
        np.asarray(depth, np.float32),
        frame.camera.scaled(width, height),
    )


def motion_between(first: View, second: View) -> Between | None:
    """Find the motion from first to second; None where too few tracks agree."""
    if first.camera != second.camera:
        return None
    start, end = _tracks(first.grey, second.grey)
    near, far = _depth_at(first.depth, start), _depth_at(second.depth, end)
    one = np.isnan(near) | np.isnan(far)
    depth = np.where(one, np.where(np.isnan(near), far, near), (near + far) / 2)
    same = one | (np.abs(near - far) < SAME_SURFACE * depth)
    good = same & (depth > 0)
    middle, flow = ((start + end) / 2)[good], (end - start)[good]
    if len(flow) < FEWEST:
        return None
    j = interaction_matrix(middle[:, 0], middle[:, 1], depth[good], first.camera)
    height = first.camera.height
    return _fit(j, flow, (middle[:, 1] - first.camera.cy) / height, height)


def _tracks(first: npt.NDArray[np.uint8], second: npt.NDArray[np.uint8]) -> tuple[Vector, Vector]:
    """Give where tracks start and end, (n, 2) [px] each, in two images [B00]."""
    none = np.zeros((0, 2))
    found_corners = cv2.goodFeaturesToTrack(first, CORNERS, QUALITY, APART, blockSize=7)
    if found_corners is None:
        return none, none
    corners = np.asarray(found_corners)
    there, found = _followed(first, second, corners)
    back, found_back = _followed(second, first, there)
    miss = np.linalg.norm((back - corners)[:, 0], axis=1)
    good = found & found_back & (miss < THERE_AND_BACK)
    return corners[good, 0].astype(np.float64), there[good, 0].astype(np.float64)


def _followed(
    first: npt.NDArray[np.uint8], second: npt.NDArray[np.uint8], points: npt.NDArray[Any]
) -> tuple[npt.NDArray[Any], npt.NDArray[np.bool_]]:
    """Give where points (n, 1, 2) of the first image are in the second, and which are found."""
    where = np.zeros_like(points)
    where, found, _ = cv2.calcOpticalFlowPyrLK(
        first, second, points, where, winSize=WINDOW, maxLevel=LEVELS
    )
    return np.asarray(where), np.asarray(found)[:, 0] > 0


def _depth_at(depth: FloatImage, points: Vector) -> Vector:
    """Give the depth (n,) at points (n, 2) [px]; NaN outside."""
    x, y = np.rint(points).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < depth.shape[1]) & (y < depth.shape[0])
    found = np.full(len(points), np.nan)
    found[inside] = depth[y[inside], x[inside]]
    return found


def _fit(j: Vector, flow: Vector, row: Vector, height: int) -> Between | None:
    """
    Fit a motion (6,) to flow (n, 2) = J p by reweighted least squares, (41), (42), (46).

    row (n,): of each track, in heights of the picture [px] from the optical axis.
    """
    late = row[:, None, None] * j
    # Both axes of all tracks below each other: a product of matrices, not of many small ones.
    both = np.concatenate([j, late[:, :, :3]], 2).reshape(-1, 9)
    weight = np.ones(len(flow))
    spread, ridge = FINEST, np.diag([1e-9] * 6 + [ROLL_RIDGE] * 3)
    for _ in range(ROUNDS):
        weighted = (np.repeat(weight, 2)[:, None] * both).T
        information = weighted @ both + ridge
        if weight.sum() < 6:
            return None
        p = np.linalg.solve(information, weighted @ flow.ravel())
        miss = np.hypot(*(flow - (both @ p).reshape(-1, 2)).T)
        spread = max(FINEST, 1.25 * float(np.median(miss)))
        weight = np.square(np.clip(1 - np.square(miss / (CUT * spread)), 0, None))
    agree = weight > 0
    if agree.sum() < FEWEST or agree.mean() < LEAST_SHARE:
        return None
    doubt = OPTIMISM * (spread / FINEST) * spread**2
    inverse = np.linalg.inv(information)
    stretch, skew = (
        inverse @ (weighted @ by.reshape(-1, 6))
        for by in (flow[:, 1, None, None] / height * j, late)
    )
    return Between(p, doubt * inverse, stretch, skew)
