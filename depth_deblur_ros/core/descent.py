"""
The conjugate gradients of the image step, preconditioned with l'^2: one compiled loop.

A step goes twice over memory. What it leaves, <r, P r>, is known before it is gone, docs/method.md
(section 4), so that one pass can go along d and turn it.

Notation: latent L; r minus the gradient; d the direction; q the normal equations' matrix times d;
P = 1 / ease.
"""

from __future__ import annotations

from depth_deblur_ros.core.crew import all_done, await_more, begin, hand_in, take
from depth_deblur_ros.core.data import FloatImage
from depth_deblur_ros.core.quadratic import Quadratic, sum_rows
from depth_deblur_ros.core.scatter import scatter_rows
from depth_deblur_ros.core.sweep import gather_rows
from depth_deblur_ros.core.threads import SHARED, with_crew
from numba import njit
import numpy as np

KINDS = 4
GATHER, SCATTER, SUM, ADVANCE = range(KINDS)


def conjugate_gradients(
    problem: Quadratic, latent: FloatImage, slope: FloatImage, limit: int
) -> FloatImage:
    """
    Solve from latent by `limit` steps; slope: minus the gradient.

    Both are written over: latent is given back, and slope is left as minus the gradient there.
    """
    sweep, rows = problem.sweep, latent.shape[1]
    d, q = sweep.directions
    sums = np.zeros((rows, 2), np.float32), np.zeros(rows, np.float32), np.zeros(2, np.float32)
    # What d holds from before counts for nothing: the first pace is 0, 0.
    planes = latent, slope, d, q, problem.links, problem.ease
    blurred = problem.trust, sweep.taken, sweep.strips
    with_crew(_descend, limit, planes, blurred, sweep.parts(), sums)
    return latent


@njit(cache=True, nogil=True, inline='always')
def _work(kind, piece, count, planes, blurred, parts, sums):  # type: ignore[no-untyped-def]
    """Do one piece of a step's work."""
    latent, r, d, q, links, ease = planes
    trust, taken, strips = blurred
    products, squares, pace = sums
    rows = _rows(kind, planes, blurred)
    first, end = piece * rows // count, (piece + 1) * rows // count
    if kind == GATHER:
        nearness, flow, shares, cells, far, room = parts
        less = kind != GATHER  # for False, a constant, the kernel would be compiled once more
        gather_rows(first, end, d, trust, less, taken, nearness, flow, shares, cells, far, room)
    elif kind == SCATTER:
        nearness, flow, shares, cells, far, room = parts
        scatter_rows(first, end, taken, strips, nearness, flow, shares, cells, far, room)
    elif kind == SUM:
        one = np.float32(1)
        sum_rows(first, end, strips, trust.shape[1], d, links, ease, one, q, products)
    else:
        _advance(first, end, latent, r, d, q, ease, pace[0], pace[1], squares)


@njit(cache=True, nogil=True, inline='always')
def _rows(kind, planes, blurred):  # type: ignore[no-untyped-def]
    """Give of how many rows, or strips, a kind of work is."""
    if kind == GATHER:
        return blurred[0].shape[1]
    return blurred[2].shape[0] if kind == SCATTER else planes[0].shape[1]


@njit(cache=True, nogil=True, inline='always')
def _measured(sums, left):  # type: ignore[no-untyped-def]
    """Set the pace of a step, by what is left; give <d, q>."""
    products, _, pace = sums
    dq = qq = 0.0
    for row in products:
        dq, qq = dq + row[0], qq + row[1]
    if dq > 0:
        step = left / dq
        pace[0], pace[1] = step, max(0.0, step * step * qq / left - 1)
    return dq


@njit(cache=True, nogil=True, inline='always')
def _total(values):  # type: ignore[no-untyped-def]
    total = 0.0
    for value in values:
        total += value
    return total


@njit(cache=True, nogil=True)
def _descend(board, leads, limit, planes, blurred, parts, sums):  # type: ignore[no-untyped-def]
    """Take pieces; who leads says what is next: the first direction, then step after step."""
    # For 0, a constant, what is called would be compiled once more.
    kind, count, steps, left = np.int64(ADVANCE), np.int64(0), 0, 0.0
    if leads:
        count = begin(board, kind, _rows(kind, planes, blurred))
    while True:
        mine, piece, of = take(board)
        if mine >= 0:
            _work(mine, piece, of, planes, blurred, parts, sums)
            hand_in(board)
        elif not leads:
            if not await_more(board):
                return
        elif all_done(board, count):
            if kind == ADVANCE:
                left = _total(sums[1])
                if left <= 0 or steps == limit:
                    return
                steps += 1
            # Where d q is not above zero, nothing is trusted and nothing holds together.
            if kind == SUM and _measured(sums, left) <= 0:
                return
            kind = (kind + 1) % KINDS
            count = begin(board, kind, _rows(kind, planes, blurred))


@njit(fastmath=True, **SHARED)
def _advance(first, end, latent, r, d, q, ease, step, turn, products):  # type: ignore[no-untyped-def]
    width = r.shape[2]
    for y in range(first, end):
        s = np.float32(0)
        for c in range(3):
            own = min(c, len(ease) - 1)
            for x in range(width):
                latent[c, y, x] += step * d[c, y, x]
                left = r[c, y, x] - step * q[c, y, x]
                z = left / ease[own, y, x]
                r[c, y, x], d[c, y, x] = left, z + turn * d[c, y, x]
                s += left * z
        products[y] = s
