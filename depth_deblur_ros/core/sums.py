"""
The sums of the likelihood in compiled loops.

numpy's take a tenth of the refinement's time, BLAS has threads that spin for long after such short
work. Images are (H, W), planes (3, H, W); links (4, H, W) of the prior lead to the neighbours
right, below, below right and below left and are zero where there is none, as quadratic.py weighs
them; ease (H, W) is that of their plane.
"""

from __future__ import annotations

import math

from depth_deblur_ros.core.sweep import GUARD
from depth_deblur_ros.core.threads import SHARED
from numba import njit
import numpy as np


@njit(cache=True, nogil=True, inline='always')
def _weigh(k, y, links, ease, row):  # type: ignore[no-untyped-def]
    """Write the weights of one row of links; give how far their ends are in the plane."""
    width = ease.shape[1]
    offset = np.uintp((1, width, width + 1, width - 1)[k])
    flat, own, here = ease.reshape(-1), links[k, y], np.uintp(y * width)
    for x in range(np.uintp(0), np.uintp(width)):
        row[x] = own[x] * min(flat[here + x], flat[here + x + offset])
    return offset


@njit(fastmath=True, **SHARED)
def squares(first, end, planes, links, ease, sums):  # type: ignore[no-untyped-def]
    """Write x' R x of each row (H, 3), by what its links lead to."""
    _, height, width = planes.shape
    flat, row = planes.reshape(-1), np.empty(width, np.float32)
    for y in range(first, end):
        sums[y] = 0
        if not GUARD <= y < height - GUARD:
            continue
        for k in range(4):
            offset = _weigh(k, y, links, ease, row)
            for c in range(3):
                here, total = np.uintp((c * height + y) * width), np.float32(0)
                for x in range(np.uintp(0), np.uintp(width)):
                    d = flat[here + x + offset] - flat[here + x]
                    total += row[x] * d * d
                sums[y, c] += total


@njit(cache=True, nogil=True)
def add_noise(noise, links, ease, out):  # type: ignore[no-untyped-def]
    """Add R^(1/2) n of noise (4, 2, H, W) for the links to two fields (2, H, W)."""
    _, height, width = out.shape
    flat, row = out.reshape(-1), np.empty(width, np.float32)
    for k in range(4):
        for y in range(GUARD, height - GUARD):
            offset = _weigh(k, y, links, ease, row)
            for x in range(width):
                row[x] = math.sqrt(row[x])
            for c in range(2):
                here, own = np.uintp((c * height + y) * width), noise[k, c, y]
                for x in range(np.uintp(0), np.uintp(width)):
                    flat[here + x] += row[x] * own[x]
                for x in range(np.uintp(0), np.uintp(width)):
                    flat[here + offset + x] -= row[x] * own[x]


@njit(fastmath=True, **SHARED)
def multiply(first, end, left, weight, right, sums):  # type: ignore[no-untyped-def]
    """Sum weight times left (n, H, W) times right (m, H, W) over each row: (H, n, m)."""
    for y in range(first, end):
        for i in range(len(left)):
            one = weight[y] * left[i, y]
            for j in range(len(right)):
                other, total = right[j, y], np.float32(0)
                for x in range(len(one)):
                    total += one[x] * other[x]
                sums[y, i, j] = total
