"""
The instants of the exposure that each block of sixteen pixels has, and where it reads at each.

Notation as in sweep.py; flow (W' + 8 H,) as `seen.flow_rows` gives it. A block with n of the N
instants has them evenly over the exposure, and the first n of its places in all arrays. What it
sees lies side by side, in sixteen bits: the kernels wait for memory more than they calculate.
"""

from __future__ import annotations

from dataclasses import dataclass
import math

from depth_deblur_ros.core.data import FloatImage
from depth_deblur_ros.core.lanes import (
    greatest,
    larger,
    least,
    load,
    load_whole,
    smaller,
    splat,
    store,
    store_whole,
    whole,
    WIDTH,
)
from depth_deblur_ros.core.seen import ROW
from depth_deblur_ros.core.threads import on_threads, SHARED
from numba import njit
import numpy as np
import numpy.typing as npt

FEWEST = 3  # instants of a block
MANY = 20  # offsets of one block; with more, each pixel reads by itself
APART = 1000  # offsets that a block is said to need where some pixel reads too far
MOST = 65535  # the nearest that a block sees
OF_NEARNESS = 5  # of a row's numbers of the flow: the first that stands for px m


@dataclass(frozen=True, eq=False)
class Layout:
    """What blocks see at their own instants, and where they read."""

    nearness: npt.NDArray[np.uint16]  # (H, W' / 16, N, 16) inverse depth seen, in parts of `flow`
    flow: FloatImage  # (W' + 8 H,) as `seen.flow_rows` gives it, for inverse depth as above
    shares: FloatImage  # (H, W' / 16) 1 / how many instants a block has: its first ones above
    cells: npt.NDArray[np.int16]  # (H, W' / 16, N, 4) least offset x, y; how many x, y
    unit: np.float32  # 1/m, one part of nearness


def laid_out(
    seen: FloatImage, flow: FloatImage, spacing: float, far: np.float32, slack: float
) -> Layout:
    """
    Lay out inverse depth seen (H, N, W') [1/m] for blocks, and flow (W' + 8 H,).

    spacing: px of its own longest blur for which a block has an instant, of at most N; 0: all N.
    far: px, the longest displacement along an axis. slack: px beyond a cell of 2 x 2 offsets where
    its bilinear surface still serves.
    """
    height, samples, width = seen.shape
    # In sixteen bits the longest displacement is off by less than a hundred thousandth.
    unit = max(float(seen.max()), 1e-30) / MOST
    flow = flow.copy()
    flow[width:].reshape(height, ROW)[:, OF_NEARNESS:] *= np.float32(unit)
    blocks = height, width // WIDTH
    nearness = np.empty((*blocks, samples, WIDTH), np.uint16)
    shares, cells = np.empty(blocks, np.float32), np.empty((*blocks, samples, 4), np.int16)
    told = np.float32(1 / unit), np.float32(spacing), far, np.float32(slack)
    on_threads(_lay_out, height, seen, flow, *told, nearness, shares, cells)
    return Layout(nearness, flow, shares, cells, np.float32(unit))


@njit(cache=True, nogil=True, inline='always')
def flow_at(y, k, flow, width):  # type: ignore[no-untyped-def]
    """Give a_x, a_y, b_x, b_y of a block."""
    xn, at = load(flow, k * WIDTH), width + ROW * y
    ax = splat(flow[at]) + xn * (splat(flow[at + 1]) + xn * splat(flow[at + 2]))
    ay = splat(flow[at + 3]) + xn * splat(flow[at + 4])
    return ax, ay, splat(flow[at + 5]) + xn * splat(flow[at + 6]), splat(flow[at + 7])


@njit(cache=True, nogil=True, inline='always')
def _count(y, k, seen, flow, scale, spacing, samples, width):  # type: ignore[no-untyped-def]
    """Give how many instants a block has; scale: what 1/m is in parts of `flow`."""
    if spacing == 0:
        return samples
    ax, ay, bx, by = flow_at(y, k, flow, width)
    at, square = y * samples * width + k * WIDTH, splat(np.float32(0))
    for i in range(samples):
        w = splat(scale) * load(seen, at + i * width)
        dx, dy = ax + w * bx, ay + w * by
        square = larger(square, dx * dx + dy * dy)
    return min(max(math.ceil(math.sqrt(greatest(square)) / spacing), FEWEST), samples)


@njit(**SHARED)
def _lay_out(first, end, seen, flow, scale, spacing, far, slack, nearness, shares, cells):  # type: ignore[no-untyped-def]
    """Keep what each block sees at its own instants, and where it begins to read, how far."""
    _, samples, width = seen.shape
    flat, kept, half = seen.reshape(-1), nearness.reshape(-1), splat(np.float32(0.5))
    for y in range(first, end):
        for k in range(width // WIDTH):
            count = _count(y, k, flat, flow, scale, spacing, samples, width)
            shares[y, k] = 1 / count
            ax, ay, bx, by = flow_at(y, k, flow, width)
            at = (y * (width // WIDTH) + k) * samples * WIDTH
            for i in range(count):
                nearest = (2 * i + 1) * samples // (2 * count)
                w = load(flat, (y * samples + nearest) * width + k * WIDTH)
                w, back = whole(splat(scale) * w + half), splat(back_at(i, shares[y, k]))
                store_whole(kept, at + i * WIDTH, w)
                dx, dy = _displacement(ax, bx, w, back), _displacement(ay, by, w, back)
                left, columns = _span(dx, far, slack)
                top, rows = _span(dy, far, slack)
                if columns > 2 or rows > 2:  # tents end where a cell does
                    left, columns = _span(dx, far, np.float32(0))
                    top, rows = _span(dy, far, np.float32(0))
                cells[y, k, i, 0], cells[y, k, i, 1] = left, top
                cells[y, k, i, 2], cells[y, k, i, 3] = columns, rows


@njit(cache=True, nogil=True, inline='always')
def back_at(i, share):  # type: ignore[no-untyped-def]
    """Give -t_i of a block with 1 / share instants; less than -1/2 if i is none of them."""
    return np.float32(0.5) - (np.float32(i) + np.float32(0.5)) * share


@njit(cache=True, nogil=True, inline='always')
def _displacement(a, b, w, back):  # type: ignore[no-untyped-def]
    """Give how far from its own place a pixel reads, along one axis [px]."""
    return back * (a + w * b)


@njit(cache=True, nogil=True, inline='always')
def _within(lanes, least, most):  # type: ignore[no-untyped-def]
    """Give what lies beyond two bounds as the bound."""
    return larger(smaller(lanes, splat(most)), splat(least))


@njit(cache=True, nogil=True, inline='always')
def _span(lanes, far, slack):  # type: ignore[no-untyped-def]
    """Give the first offset that a block's displacements need, and how many: two within slack."""
    low, high = least(lanes), greatest(lanes)
    first = np.intp(np.floor(min(max(low, -far), far)))
    if low < -far or high > far:
        return first, APART
    last = np.intp(np.floor(high))
    closer = np.intp(np.floor(low + slack))
    if last > first and high < np.float32(closer + 1) + slack:
        return closer, 2
    return first, last - first + 2


@njit(cache=True, nogil=True, inline='always')
def aim(place, i, share, parts, data):  # type: ignore[no-untyped-def]
    """
    Say where a block reads at instant i; place: y, k, N, W'.

    Displacements u, v from the first offset; the offset's columns and rows from the block's own
    place; how many columns and rows of offsets there are.
    """
    y, k, samples, width = place
    ax, ay, bx, by = parts
    near, _, _, cells = data
    at = (y * (width // WIDTH) + k) * samples + i
    w, back, c = load_whole(near, at * WIDTH), splat(back_at(i, share)), 4 * at
    left, top = np.intp(cells[c]), np.intp(cells[c + 1])
    u = _displacement(ax, bx, w, back) - splat(np.float32(left))
    v = _displacement(ay, by, w, back) - splat(np.float32(top))
    return u, v, left, top, np.intp(cells[c + 2]), np.intp(cells[c + 3])


@njit(cache=True, nogil=True, inline='always')
def bilinear(u, v):  # type: ignore[no-untyped-def]
    """Give the weights of a cell's corners: above, above right, below, below right."""
    w11 = u * v
    w10, w01 = v - w11, u - w11
    return splat(np.float32(1)) - u - w10, w01, w10, w11


@njit(cache=True, nogil=True, inline='always')
def apart(places, u, v, left, top, far):  # type: ignore[no-untyped-def]
    """Note where each pixel of a block reads: at most `far` away."""
    x, y = np.float32(left), np.float32(top)
    store(places, 0, _within(u, -far - x, far - x))
    store(places, WIDTH, _within(v, -far - y, far - y))
