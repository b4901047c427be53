"""
The exposure from how much softer one frame is than the one before, where blurs are too short.

A straight blur by u multiplies power at the frequency f by sinc^2(f.u). Two frames of the same
scene share all else, so that their ratio tells u^2 = T^2 F^2 where velocities F differ, down to
half a pixel, docs/method.md (58). One frame alone tells nothing below 2 px.
"""

from __future__ import annotations

import math
from typing import Any

from depth_deblur_ros.between import View
from depth_deblur_ros.core.data import Vector
from depth_deblur_ros.core.geometry import interaction_matrix
from depth_deblur_ros.shutter import Exposure
import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
import numpy.typing as npt
import scipy.fft

SIDE, STEP = 48, 24  # px; of a patch, and from one to the next
LOWEST, HIGHEST, NOISE_FROM = 0.04, 0.3, 0.42  # cycles/px
STRAIGHT = 0.5  # f.u up to which log sinc^2 is a parabola
CLEAN = 10.0  # times the noise, at which power counts half
CLIP = 2.0  # of a log ratio; what differs by more is another surface
FEWEST = 12  # patches
UNEVEN = 0.2  # least standard deviation of a log ratio
INEXACT = 0.15  # relative; what softness tells of an exposure is no better than this
OPTIMISM = 1.5  # times the standard deviation: neighbouring patches err alike
TINY = 1e-12
VAGUE = 0.6  # relative; what is less exact is not told
UNKNOWN = 0.6  # relative doubt of an exposure that is a guess

_WINDOW = np.outer(np.hanning(SIDE), np.hanning(SIDE)).astype(np.float32)
_FX, _FY = np.meshgrid(np.fft.rfftfreq(SIDE), np.fft.fftfreq(SIDE))
_BAND = (np.hypot(_FX, _FY) > LOWEST) & (np.hypot(_FX, _FY) < HIGHEST)
_NOISE = np.hypot(_FX, _FY) > NOISE_FROM
_F = np.stack([_FX[_BAND], _FY[_BAND]])  # (2, m) cycles/px


def exposure_from_softness(
    first: tuple[View, Vector],
    second: tuple[View, Vector],
    way: Vector,
    *,
    known: Exposure | None,
    longest: float,
) -> Exposure | None:
    """
    Give the exposure that two neighbouring frames have in common; None where they do not tell.

    first, second: a frame and its velocity (6,) [rad/s, m/s]; way (6,): the motion from one to the
    other; longest [s]: what the exposure may be.
    """
    (before, then), (after, now) = first, second
    half = SIDE // 2
    rows, columns = before.grey.shape
    y, x = np.mgrid[half : rows - half : STEP, half : columns - half : STEP].reshape(2, -1)
    j = interaction_matrix(x, y, before.depth[y, x].astype(np.float64), before.camera)
    moved = j @ way
    inside = np.asarray(np.isfinite(moved).all(axis=1))
    x2, y2 = np.rint(np.stack([x, y]) + np.where(inside[:, None], moved, 0).T).astype(int)
    inside &= (x2 >= half) & (y2 >= half) & (x2 <= columns - half) & (y2 <= rows - half)
    if inside.sum() < FEWEST:
        return None
    log, weight = _ratio(
        _power(before, x[inside], y[inside]), _power(after, x2[inside], y2[inside])
    )
    along = [(j[inside] @ u) @ _F for u in (then, now)]
    straight = np.maximum(*np.abs(along)) * longest < STRAIGHT
    bend = -(math.pi**2) / 3 * (np.square(along[0]) - np.square(along[1]))
    found = _fitted(log, bend, weight * straight, known)
    return found if found and found.seconds < longest else None


def _power(view: View, x: npt.NDArray[Any], y: npt.NDArray[Any]) -> Vector:
    """Give the power (n, m) of patches around pixels at the frequencies _F, and their noise."""
    half = SIDE // 2
    patches = sliding_window_view(view.grey, (SIDE, SIDE))[y - half, x - half].astype(np.float32)
    patches -= patches.mean(axis=(1, 2), keepdims=True)
    seen = scipy.fft.rfft2(patches * _WINDOW, overwrite_x=True)
    power = np.square(seen.real) + np.square(seen.imag)
    noise = np.median(power[:, _NOISE], axis=1)
    return np.concatenate([power[:, _BAND], noise[:, None]], axis=1)


def _ratio(first: Vector, second: Vector) -> tuple[Vector, Vector]:
    """Give log ratios of power (n, m), and what they weigh."""
    weakest = np.minimum(first, second)[:, :-1] + TINY
    noise = np.maximum(first, second)[:, -1:]
    log = np.clip(np.log((first[:, :-1] + TINY) / (second[:, :-1] + TINY)), -CLIP, CLIP)
    return log, np.square(1 / (1 + CLEAN * noise / weakest))


def _fitted(log: Vector, bend: Vector, weight: Vector, known: Exposure | None) -> Exposure | None:
    """Fit log = T^2 bend + a constant of each patch by weighted least squares."""
    total = weight.sum(axis=1, keepdims=True) + TINY
    log = log - (weight * log).sum(axis=1, keepdims=True) / total
    bend = bend - (weight * bend).sum(axis=1, keepdims=True) / total
    curve, slope = (weight * bend * bend).sum(axis=1), (weight * bend * log).sum(axis=1)
    steep = float(curve.sum())
    if steep < TINY:
        return None
    square = float(slope.sum()) / steep
    spread = float(np.linalg.norm(slope - square * curve)) / steep
    return _exposure(square, OPTIMISM * max(spread, UNEVEN / math.sqrt(steep)), known)


def _exposure(square: float, spread: float, known: Exposure | None) -> Exposure | None:
    """Give T of T^2 and its standard deviation, which noise may have made negative."""
    expected = known.seconds if known and known.doubt < UNKNOWN else 0.0
    doubt = math.hypot(INEXACT, spread / 2 / max(square, expected**2, TINY))
    if doubt > VAGUE or (square <= 0 and not expected):
        return None
    if square > expected**2:
        return Exposure(math.sqrt(square), doubt)
    return Exposure(max((expected**2 + square) / (2 * expected), expected / 4), doubt)
