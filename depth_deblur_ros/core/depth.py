"""
Depth without holes, guided by the colour image.

Every hole pixel takes the mean of the measured pixels around it. They are found by asking it and
eight pixels on a ring around it, as far away as its nearest measurement, for their own nearest
measurement: so the reach fits the hole, and all its sides are heard. These seeds count the more,
the closer they are, the more their colour is that of the hole pixel, and the farther away their
surface lies: beside an edge, depth cameras lose the background more often than the foreground.
Colours are compared across the hole, not along a path through it. Motion blur smears an edge into
a ramp whose gradients say nothing, but in its middle both sides are still equally alike.

Notation: d0 distance to the nearest measurement [px], r distance to a seed [px], c colour
difference, rms over the channels, z depth of a seed and z_max the largest among the seeds [m].
Weight of a seed, docs/method.md:

    exp(-NEARNESS / 2 r^2 / d0^2 - c^2 / (2 COLOUR_SIGMA^2) - BACKGROUND (1 - z / z_max))
"""

from __future__ import annotations

import math

import cv2
from depth_deblur_ros.core.data import FloatImage, InputError
from numba import config, get_num_threads, njit, prange, set_num_threads
import numpy as np
import numpy.typing as npt

# Measured on cases with known truth; the error is flat around these values (docs/results.md).
NEARNESS = 4.0
COLOUR_SIGMA = 0.09  # stored values 0..1
BACKGROUND = 3.0

# (9, 2) whom to ask, (dy, dx) in units of d0: the pixel itself and the ring.
_TURN = np.arange(8) * (math.pi / 4)
RING = np.vstack([np.zeros((1, 2)), np.c_[np.sin(_TURN), np.cos(_TURN)]]).astype(np.float32)


def fill_depth(depth: FloatImage, guide: FloatImage, *, threads: int) -> FloatImage:
    """
    Fill the holes of depth (H, W) [m]; what was measured is kept bit for bit.

    NaN, zero, negative and infinite values are holes. guide (H, W) or (H, W, 3), finite, 0..1, may
    be blurred by motion. What is filled in lies between the depths around it.
    """
    _check(depth, guide)
    measured = (depth > 0) & (depth < np.inf)
    if measured.all():
        return depth.copy()
    if not measured.any():
        raise InputError('depth has no measured pixel: 100 % of it are holes')
    filled = np.where(measured, depth, np.float32(0))
    colours = np.ascontiguousarray(guide).reshape(*depth.shape, -1)
    before = get_num_threads()
    set_num_threads(min(threads, config.NUMBA_NUM_THREADS))  # type: ignore[attr-defined]
    _fill(filled, measured, colours, nearest_measured(measured), RING)
    set_num_threads(before)
    return filled


def nearest_measured(measured: npt.NDArray[np.bool_]) -> npt.NDArray[np.uint32]:
    """Give (H, W) the flat index of the measured pixel that is nearest, to about a pixel."""
    holes = np.logical_not(measured).view(np.uint8)
    _, labels = cv2.distanceTransformWithLabels(
        holes, cv2.DIST_L2, cv2.DIST_MASK_5, labelType=cv2.DIST_LABEL_PIXEL
    )
    # OpenCV numbers the measured pixels row by row, from 1.
    nearest: npt.NDArray[np.uint32] = np.flatnonzero(measured).astype(np.uint32)[labels - 1]
    return nearest


@njit(cache=True, nogil=True, parallel=True)
def _fill(depth, measured, colours, nearest, ring):  # type: ignore[no-untyped-def]
    """Write the weighted mean of its seeds into every hole pixel of depth."""
    height, width = measured.shape
    per_colour = np.float32(1 / (2 * COLOUR_SIGMA**2 * colours.shape[2]))
    for y in prange(height):
        z, cost = np.empty(len(ring), np.float32), np.empty(len(ring), np.float32)
        for x in range(width):
            if measured[y, x]:
                continue
            sy, sx = _row_column(nearest[y, x], width)
            near2 = _square(sy, y) + _square(sx, x)
            near, per_far2 = math.sqrt(near2), np.float32(NEARNESS / 2) / near2
            for k in range(len(ring)):
                v = _step_inside(y, ring[k, 0] * near, height)
                u = _step_inside(x, ring[k, 1] * near, width)
                sy, sx = _row_column(nearest[v, u], width)
                c2 = np.float32(0)
                for i in range(colours.shape[2]):
                    c2 += (colours[y, x, i] - colours[sy, sx, i]) ** 2
                z[k] = depth[sy, sx]
                cost[k] = per_far2 * (_square(sy, y) + _square(sx, x)) + per_colour * c2
            depth[y, x] = _mean(z, cost)


# Indices are unsigned in what follows, so that none is taken for one counted from the end.
@njit(cache=True, nogil=True)
def _row_column(index, width):  # type: ignore[no-untyped-def]
    """Split a flat index."""
    row = np.uint32(index) // np.uint32(width)
    return row, np.uint32(index) - row * np.uint32(width)


@njit(cache=True, nogil=True)
def _step_inside(start, step, size):  # type: ignore[no-untyped-def]
    """Round start + step to the nearest index in 0..size - 1."""
    stop = np.int64(np.float32(start) + step + np.float32(0.5))
    return np.uint32(min(max(stop, 0), size - 1))


@njit(cache=True, nogil=True)
def _square(a, b):  # type: ignore[no-untyped-def]
    """Give (a - b)^2."""
    return (np.float32(a) - np.float32(b)) ** 2


@njit(cache=True, nogil=True)
def _mean(z, cost):  # type: ignore[no-untyped-def]
    """Give the mean of z by exp(-cost) and the background's advantage; never beyond z."""
    low = high = z[0]
    for k in range(1, len(z)):
        low, high = min(low, z[k]), max(high, z[k])
    advantage = np.float32(BACKGROUND) / high
    total = mean = np.float32(0)
    for k in range(len(z)):
        weight = math.exp(advantage * (z[k] - high) - cost[k])
        total += weight
        mean += weight * z[k]
    return min(max(mean / total, low), high)


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
