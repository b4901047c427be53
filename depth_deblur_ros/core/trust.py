"""
Whether to believe a motion, and how much.

One image must first show that it is blurred at all: a sharp picture gives a wild answer, too.
Three witnesses: the depth of the dark bands at the found motion (evidence.py), its repetition at
the next scale, and how fast differences fade when the image is blurred a little further.
docs/method.md (13), (14).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
import math

import cv2
from depth_deblur_ros.core.data import FloatImage, Motion, Vector
from depth_deblur_ros.core.threads import on_threads
import numpy as np
import numpy.typing as npt

DIRECTIONS = 8
FURTHER = 3.0  # px of further blur
ENOUGH = 15_000  # pixels or more that are looked at; the ratio is then good to 0.002
# By scripts/calibrate.py: shares of the covariances that the spectra and the likelihood give, and
# what no picture tells better of q: two shifts, roll, zoom, two parallaxes [px].
OF_SPECTRA = 0.12
OF_LIKELIHOOD = {'linear': 0.6, 'srgb': 0.172}
LEAST_ERROR = (0.07, 0.07, 0.13, 0.05, 0.03, 0.03)


@dataclass(frozen=True, eq=False)
class Edges:
    """How sharp a grey picture (H, W) is, as `sharpness` counts it."""

    grey: FloatImage

    @property
    def along(self) -> float:
        """In the direction where it is least sharp."""
        return self._fine[0]

    @property
    def across(self) -> float:
        """In the direction where it is sharpest."""
        return self._fine[1]

    @cached_property
    def coarse(self) -> float:
        """Where it is least sharp, at half the size: noise hides long blurs at the full one."""
        return sharpness(self._half)[0]

    @cached_property
    def evenly(self) -> float:
        """As `coarse`, in the least sharp quarter of the picture that has edges at all."""
        height, width = (side // 2 for side in self._half.shape)
        rows, columns = (slice(height), slice(height, None)), (slice(width), slice(width, None))
        found = [sharpness(self._half[y, x])[0] for y in rows for x in columns]
        return min(filter(None, found), default=0.0)

    @cached_property
    def _half(self) -> FloatImage:
        half = cv2.resize(self.grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        return np.asarray(half, np.float32)

    @cached_property
    def _fine(self) -> tuple[float, float]:
        return sharpness(self.grey)


def sharpness(grey: FloatImage) -> tuple[float, float]:
    """
    Give how much further blur weakens the strongest tenth of the edges: least and most.

    Least of all directions: 1 = not at all, long motion blur along that direction; 1.1 and more:
    no blur longer than 2 px. Most: 1.05 and less, soft in all directions, which no motion does.
    """
    smooth = np.asarray(cv2.GaussianBlur(grey, (0, 0), 0.6), np.float32)
    step = max(1, math.isqrt(grey.size // ENOUGH))
    ratios = np.empty(DIRECTIONS)

    def look(first: int, end: int) -> None:
        for k in range(first, end):
            angle = math.pi * k / DIRECTIONS
            near = _difference(smooth, angle, 1.0, step)
            far = _difference(smooth, angle, FURTHER, step) / np.float32(FURTHER)
            steep = np.abs(near)
            strong = steep >= np.percentile(steep, 90)
            ratios[k] = _rms(near[strong]) / max(_rms(far[strong]), 1e-9)

    on_threads(look, DIRECTIONS)
    return float(ratios.min()), float(ratios.max())


def _difference(image: FloatImage, angle: float, length: float, step: int) -> FloatImage:
    """Give I(x + d/2) - I(x - d/2) at each step-th x, d of this length [px] and angle."""
    half = 0.5 * length * np.array([math.cos(angle), math.sin(angle)])
    ahead, behind = (_shifted(image, sign * half, step) for sign in (1, -1))
    return ahead - behind


def _shifted(image: FloatImage, shift: npt.NDArray[np.float64], step: int) -> FloatImage:
    """Give I(x + shift) at each step-th x; borders repeat."""
    matrix = np.array([[step, 0, shift[0]], [0, step, shift[1]]], np.float32)
    size = (-(-image.shape[1] // step), -(-image.shape[0] // step))
    how = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    moved = cv2.warpAffine(image, matrix, size, flags=how, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(moved, np.float32)


def _rms(values: FloatImage) -> float:
    return float(np.sqrt(np.square(values, dtype=np.float64).mean())) if values.size else 0.0


def covariance_from_curvature(curvature: Vector, gain: float, prior_px: float) -> Vector:
    """
    Give the covariance (n, n) [px^2] of q where S^2 / 2 bends by -curvature (n, n).

    gain: how many independent observations S^2 is made of; directions that the image does not show
    keep the prior's spread.
    """
    information = gain * (curvature + curvature.T) / 2
    values, vectors = np.linalg.eigh(information)
    values = np.maximum(values, 0) + 1 / prior_px**2
    return np.asarray(vectors / values @ vectors.T)


def calibrated(motion: Motion, axes: Vector, share: float) -> Motion:
    """Give the motion with a covariance as large as its errors are; axes G, share of the old."""
    own = axes[:6, :6]
    least = own @ np.diag(np.square(LEAST_ERROR)) @ own.T
    return replace(motion, covariance=share * motion.covariance + least)
