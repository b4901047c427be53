"""
The instants of the exposure that each block of sixteen pixels has, and where it reads at each.

Notation as in sweep.py: nearness (H, N, W') inverse depth seen [1/m], flow (H, 4, W') a_x, a_y
[px], b_x, b_y [px m] of the flow a + w b. A block with n of the N instants has them evenly over
the exposure, and the first n of its places in all arrays.
"""

from __future__ import annotations

import math

from depth_deblur_ros.core.data import FloatImage
from depth_deblur_ros.core.lanes import greatest, larger, least, load, smaller, splat, store, WIDTH
from depth_deblur_ros.core.threads import on_threads, SHARED
from numba import njit
import numpy as np
import numpy.typing as npt

FEWEST = 3  # instants of a block


def thinned(
    nearness: FloatImage, flow: FloatImage, spacing: float
) -> tuple[FloatImage, FloatImage]:
    """
    Give what blocks see at their own instants, and 1 / n of each (H, W' / 16).

    spacing: px of its own longest blur for which a block has an instant, of at most N; 0: all N.
    """
    height, samples, width = nearness.shape
    shares = np.full((height, width // WIDTH), 1 / samples, np.float32)
    if not spacing:
        return nearness, shares
    kept = np.empty_like(nearness)
    on_threads(_thin, height, nearness, flow, np.float32(spacing), kept, shares)
    return kept, shares


def cells_of(
    nearness: FloatImage, flow: FloatImage, shares: FloatImage, far: np.float32
) -> npt.NDArray[np.int16]:
    """Give the least offset x, y that a block reads, and how many x, y (H, W' / 16, N, 4)."""
    height, samples, width = nearness.shape
    cells = np.empty((height, width // WIDTH, samples, 4), np.int16)
    on_threads(_find_cells, height, nearness, flow, shares, far, cells)
    return cells


@njit(cache=True, nogil=True, inline='always')
def flow_at(y, k, flow, width):  # type: ignore[no-untyped-def]
    """Give a_x, a_y, b_x, b_y of a block."""
    at = 4 * y * width + k * WIDTH
    x, y = load(flow, at), load(flow, at + width)
    return x, y, load(flow, at + 2 * width), load(flow, at + 3 * width)


@njit(**SHARED)
def _thin(first, end, nearness, flow, spacing, kept, shares):  # type: ignore[no-untyped-def]
    """Give each block as many instants as its blur is long; keep what it sees at those."""
    _, samples, width = nearness.shape
    seen, parts, out = nearness.reshape(-1), flow.reshape(-1), kept.reshape(-1)
    for y in range(first, end):
        for k in range(width // WIDTH):
            ax, ay, bx, by = flow_at(y, k, parts, width)
            at, square = y * samples * width + k * WIDTH, splat(np.float32(0))
            for i in range(samples):
                w = load(seen, at + i * width)
                dx, dy = ax + w * bx, ay + w * by
                square = larger(square, dx * dx + dy * dy)
            length = math.sqrt(greatest(square)) / spacing
            count = min(max(math.ceil(length), FEWEST), samples)
            shares[y, k] = 1 / count
            for i in range(count):
                nearest = (2 * i + 1) * samples // (2 * count)
                store(out, at + i * width, load(seen, at + nearest * width))


@njit(cache=True, nogil=True, inline='always')
def back_at(i, share):  # type: ignore[no-untyped-def]
    """Give -t_i of a block with 1 / share instants; less than -1/2 if i is none of them."""
    return np.float32(0.5) - (np.float32(i) + np.float32(0.5)) * share


@njit(cache=True, nogil=True, inline='always')
def displacement(a, b, w, back, far):  # type: ignore[no-untyped-def]
    """Give how far from its own place a pixel reads, along one axis [px]; at most far."""
    return larger(smaller(back * (a + w * b), splat(far)), splat(-far))


@njit(cache=True, nogil=True, inline='always')
def _span(lanes):  # type: ignore[no-untyped-def]
    """Give the first offset that a block's displacements need, and how many."""
    first = np.intp(np.floor(least(lanes)))
    return first, np.intp(np.floor(greatest(lanes))) - first + 2


@njit(**SHARED)
def _find_cells(first, end, nearness, flow, shares, far, cells):  # type: ignore[no-untyped-def]
    """Write where each block begins to read at each instant, and how many columns and rows."""
    _, samples, width = nearness.shape
    near, parts = nearness.reshape(-1), flow.reshape(-1)
    for y in range(first, end):
        for k in range(width // WIDTH):
            ax, ay, bx, by = flow_at(y, k, parts, width)
            for i in range(samples):
                back = back_at(i, shares[y, k])
                if back < np.float32(-0.5):
                    break
                w = load(near, (y * samples + i) * width + k * WIDTH)
                dx = displacement(ax, bx, w, splat(back), far)
                dy = displacement(ay, by, w, splat(back), far)
                cells[y, k, i, 0], cells[y, k, i, 2] = _span(dx)
                cells[y, k, i, 1], cells[y, k, i, 3] = _span(dy)
