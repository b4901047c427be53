"""
Depth without holes, guided by the colour image.

Every hole pixel takes the mean of measured pixels around it. They are found by asking nine pixels,
spread around it in proportion to the distance of its nearest measurement, for their own nearest
measurement: so the reach fits the hole, and all its sides are heard. These seeds count the more,
the closer they are, the more their colour is that of the hole pixel, and the farther away their
surface lies: beside an edge, depth cameras lose the background more often than the foreground.
Colours are compared across the hole, not along a path through it. Motion blur smears an edge into
a ramp whose gradients say nothing, but in its middle both sides are still equally alike.

Notation: d0 distance to the nearest measurement [px], r distance to a seed [px], c colour
difference, rms over the channels, z depth of a seed and z_max the largest among the seeds [m].
Weight of a seed, docs/method.md:

    (d0 / r)^4 exp(-c^2 / (2 COLOUR_SIGMA^2) - BACKGROUND (1 - z / z_max))
"""

from __future__ import annotations

from dataclasses import dataclass
import math
from typing import Any

import cv2
from depth_deblur_ros.core.data import FloatImage, InputError
from depth_deblur_ros.core.threads import at_most, on_threads, SHARED
from numba import njit
import numpy as np
import numpy.typing as npt

# Measured on cases with known truth; the error is flat around these values (docs/results.md).
COLOUR_SIGMA = 0.08  # stored values 0..1
BACKGROUND = 3.0

# (9, 2) whom to ask, (dy, dx) in units of d0: the pixel itself, a near cross, and wide diagonals
# that hear the far side of the hole too.
CROSS = [(0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)]
ASKED = np.array([*CROSS, (-2, -2), (-2, 2), (2, -2), (2, 2)], np.float32)
SEEDS = len(ASKED)  # a number, so that the compiler unrolls the loops


def fill_depth(depth: FloatImage, guide: FloatImage, *, threads: int) -> FloatImage:
    """
    Fill the holes of depth (H, W) [m]; what was measured is kept bit for bit.

    NaN, zero, negative and infinite values are holes. guide (H, W) or (H, W, 3), finite, 0..1, may
    be blurred by motion. What is filled in lies between the depths around it.
    """
    with at_most(threads):
        return find_holes(depth, guide).filled()


@dataclass(frozen=True, eq=False)
class Holes:
    """Depth (H, W) [m], 0 where it is not measured, and what its holes are filled with."""

    depth: FloatImage
    measured: npt.NDArray[np.bool_]
    seeds: tuple[Any, ...]  # colours (H, W, C) and what `find_seeds` gives; none without holes

    def filled(self) -> FloatImage:
        """Fill them, in place."""
        if self.seeds:
            on_threads(_fill, len(self.depth), self.depth, self.measured, *self.seeds)
        return self.depth


def find_holes(depth: FloatImage, guide: FloatImage) -> Holes:
    """Look what `fill_depth` will need; hardly more than one thread is used for it."""
    _check(depth, guide)
    measured = (depth > 0) & (depth < np.inf)
    if measured.all():
        return Holes(depth.copy(), measured, ())
    if not measured.any():
        raise InputError('depth has no measured pixel: 100 % of it are holes')
    known = np.where(measured, depth, np.float32(0))
    colours = np.ascontiguousarray(guide).reshape(*depth.shape, -1)
    return Holes(known, measured, (colours, *find_seeds(known, measured, colours)))


def find_seeds(
    depth: FloatImage, measured: npt.NDArray[np.bool_], colours: FloatImage
) -> tuple[npt.NDArray[np.uint32], FloatImage]:
    """
    Give (H, W) the number of the nearest seed, to about a pixel, and the seeds (n + 1, 3 + C).

    Seeds are the measured pixels that touch a hole, as rows of y, x, depth, colour. Row 0 is none.
    """
    holes = np.logical_not(measured).view(np.uint8)
    inside = (cv2.dilate(holes, np.ones((3, 3), np.uint8)) == holes).view(np.uint8)
    _, labels = cv2.distanceTransformWithLabels(
        inside, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    rim = np.flatnonzero(inside == 0)
    seeds = np.zeros((len(rim) + 1, 3 + colours.shape[2]), np.float32)
    seeds[1:, 0], seeds[1:, 1] = np.divmod(rim, depth.shape[1])  # labelled row by row, from 1
    seeds[1:, 2] = depth.ravel()[rim]
    seeds[1:, 3:] = colours.reshape(depth.size, -1)[rim]
    return labels.view(np.uint32), seeds


@njit(**SHARED)
def _fill(first, end, depth, measured, colours, nearest, seeds):  # type: ignore[no-untyped-def]
    """Write the weighted mean of its seeds into every hole pixel of depth."""
    height, width = measured.shape
    per_colour = np.float32(1 / (2 * COLOUR_SIGMA**2 * colours.shape[2]))
    for y in range(first, end):
        z, cost, closeness = np.empty((3, SEEDS), np.float32)
        for x in range(width):
            if measured[y, x]:
                continue
            s = nearest[y, x]
            near2 = _square(seeds[s, 0], y) + _square(seeds[s, 1], x)
            near = math.sqrt(near2)
            for k in range(SEEDS):
                v = _step_inside(y, ASKED[k, 0] * near, height)
                u = _step_inside(x, ASKED[k, 1] * near, width)
                s = nearest[v, u]
                c2 = np.float32(0)
                for i in range(colours.shape[2]):
                    c2 += (colours[y, x, i] - seeds[s, 3 + i]) ** 2
                far2 = _square(seeds[s, 0], y) + _square(seeds[s, 1], x)
                z[k], cost[k], closeness[k] = seeds[s, 2], per_colour * c2, (near2 / far2) ** 2
            depth[y, x] = _mean(z, cost, closeness)


@njit(cache=True, nogil=True, error_model='numpy')
def _square(a, b):  # type: ignore[no-untyped-def]
    """Give (a - b)^2."""
    return (a - np.float32(b)) ** 2


@njit(cache=True, nogil=True, error_model='numpy')
def _step_inside(start, step, size):  # type: ignore[no-untyped-def]
    """Round start + step to the nearest index in 0..size - 1."""
    # Cutting off rounds what is positive, the rest is outside. Unsigned: not counted from the end.
    stop = np.int64(np.float32(start) + step + np.float32(0.5))
    return np.uint32(min(max(stop, 0), size - 1))


@njit(cache=True, nogil=True, error_model='numpy')
def _mean(z, cost, closeness):  # type: ignore[no-untyped-def]
    """Give the mean of z weighted by closeness, cost and the background's advantage."""
    low = high = z[0]
    for k in range(1, SEEDS):
        low, high = min(low, z[k]), max(high, z[k])
    advantage = np.float32(BACKGROUND) / high
    total = mean = np.float32(0)
    for k in range(SEEDS):
        weight = closeness[k] * math.exp(advantage * (z[k] - high) - cost[k])
        total += weight
        mean += weight * z[k]
    return min(max(mean / total, low), high)  # rounding must not leave the range


def _check(depth: FloatImage, guide: FloatImage) -> None:
    for name, array in (('depth', depth), ('guide', guide)):
        if not isinstance(array, np.ndarray) or array.dtype != np.float32:
            kind = getattr(array, 'dtype', type(array).__name__)
            raise InputError(f'{name} must be a float32 array, got {kind}')
    if depth.ndim != 2:
        raise InputError(f'depth must have shape (H, W), got {depth.shape}')
    height, width = depth.shape
    if guide.shape not in (depth.shape, (height, width, 3)):
        raise InputError(f'guide must be {width}x{height} like the depth, got shape {guide.shape}')
