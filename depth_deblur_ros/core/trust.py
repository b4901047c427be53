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
from depth_deblur_ros.core.threads import on_threads, SHARED
from numba import njit
import numpy as np

DIRECTIONS = 8
FURTHER = 3.0  # px of further blur
STRONG, BINS = 0.1, 8192  # share of the edges that count, and how finely it is found
RIM = 3  # px around the image, more than half of that
ENOUGH = 15_000  # pixels or more that are looked at; the ratio is then good to 0.002
# By scripts/calibrate.py: shares of the covariances that the spectra and the likelihood give, and
# what no picture tells better of q: two shifts, roll, zoom, two parallaxes [px]. The last err by
# a share of the blur, too, as depth does.
OF_SPECTRA = 0.12
OF_LIKELIHOOD = {'linear': 0.57, 'srgb': 0.163}
LEAST_ERROR = (0.07, 0.07, 0.13, 0.05, 0.02, 0.01)
OF_BLUR = (0, 0, 0, 0, 0.007, 0.003)


@dataclass(frozen=True, eq=False)
class Edges:
    """
    How sharp a grey picture (H, W) is, as `sharpness` counts it.

    along, across: in the directions where it is least sharp, and sharpest.
    """

    grey: FloatImage
    along: float
    across: float

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


def edges_of(grey: FloatImage) -> Edges:
    """Look at the edges of a grey picture (H, W), stored values."""
    return Edges(grey, *sharpness(grey))


def sharpness(grey: FloatImage) -> tuple[float, float]:
    """
    Give how much further blur weakens the strongest tenth of the edges: least and most.

    Least of all directions: 1 = not at all, long motion blur along that direction; 1.1 and more:
    no blur longer than 2 px. Most: 1.05 and less, soft in all directions, which no motion does.
    """
    smooth = np.asarray(cv2.GaussianBlur(grey, (0, 0), 0.6), np.float32)
    step = max(1, math.isqrt(grey.size // ENOUGH))
    height, width = (-(-side // step) for side in grey.shape)
    rimmed = cv2.copyMakeBorder(smooth, RIM, RIM, RIM, RIM, cv2.BORDER_REPLICATE)
    near, far = np.empty((2, DIRECTIONS, height, width), np.float32)
    on_threads(_compare, DIRECTIONS * height, rimmed, step, 1.0, near)
    on_threads(_compare, DIRECTIONS * height, rimmed, step, FURTHER, far)
    ratios = np.empty(DIRECTIONS, np.float32)
    on_threads(_rate, DIRECTIONS, near, far, near.max((1, 2)), ratios)
    return float(ratios.min()), float(ratios.max())


@njit(**SHARED)
def _rate(first, end, near, far, most, ratios):  # type: ignore[no-untyped-def]
    """Compare the root mean squares per px of near and far, over the strongest tenth of near."""
    for k in range(first, end):
        steep, wide = near[k].reshape(-1), far[k].reshape(-1)
        greatest = max(most[k], np.float32(1e-9))
        counts = np.zeros(BINS + 1, np.int64)
        to_bin = np.float32(BINS) / greatest
        for i in range(steep.size):
            counts[np.int64(to_bin * steep[i])] += 1
        above, least = counts[BINS], BINS
        while above < STRONG * steep.size:
            least -= 1
            above += counts[least]
        here = there = 0.0
        for i in range(steep.size):
            if to_bin * steep[i] >= least:
                here += steep[i] ** 2
                there += wide[i] ** 2
        ratios[k] = math.sqrt(here) / max(math.sqrt(there) / FURTHER, 1e-9)


@njit(cache=True, nogil=True, inline='always')
def _between(image, y, x, v, u):  # type: ignore[no-untyped-def]
    """Look up the place (y + v, x + u), whose four pixels are inside."""
    above = image[y, x] + u * (image[y, x + 1] - image[y, x])
    below = image[y + 1, x] + u * (image[y + 1, x + 1] - image[y + 1, x])
    return above + v * (below - above)


@njit(**SHARED)
def _compare(first, end, image, step, length, found):  # type: ignore[no-untyped-def]
    """Write |I(x + d/2) - I(x - d/2)|, d of one length [px], at each step-th x of I in a rim."""
    directions, height, width = found.shape
    for i in range(first, end):
        k, y = i // height, i % height
        dx = 0.5 * length * math.cos(math.pi * k / directions)
        dy = 0.5 * length * math.sin(math.pi * k / directions)
        left, top = math.floor(dx), math.floor(dy)
        u, v = np.float32(dx - left), np.float32(dy - top)
        back, up = math.floor(-dx), math.floor(-dy)
        s, t = np.float32(-dx - back), np.float32(-dy - up)
        row = np.uintp(RIM + step * y + top)
        other = np.uintp(RIM + step * y + up)
        for x in range(width):
            ahead = _between(image, row, np.uintp(RIM + step * x + left), v, u)
            behind = _between(image, other, np.uintp(RIM + step * x + back), t, s)
            found[k, y, x] = abs(ahead - behind)


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


def calibrated(motion: Motion, axes: Vector, share: float, blur_px: float) -> Motion:
    """Give the motion with a covariance as large as its errors are; axes G, share of the old."""
    own = axes[:6, :6]
    least = own @ np.diag(np.square(LEAST_ERROR) + np.square(OF_BLUR) * blur_px**2) @ own.T
    return replace(motion, covariance=share * motion.covariance + least)
