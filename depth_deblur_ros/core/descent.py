"""
The conjugate gradients of the image step, preconditioned with l'^2: one compiled loop.

A step goes twice over memory. What it leaves, <r, P r>, is known before it is gone, docs/method.md
(section 4), so that one pass can go along d and turn it.

Notation: latent L; r minus the gradient; d the direction; q the normal equations' matrix times d;
P = 1 / ease.
"""

from __future__ import annotations

from depth_deblur_ros.core.crew import await_all, await_more, begin, hand_in, take
from depth_deblur_ros.core.data import FloatImage
from depth_deblur_ros.core.quadratic import Quadratic, sum_rows
from depth_deblur_ros.core.scatter import scatter_rows
from depth_deblur_ros.core.sweep import gather_rows
from depth_deblur_ros.core.threads import SHARED, with_crew
from numba import njit
import numpy as np

GATHER, SCATTER, SUM, ADVANCE = range(4)


def conjugate_gradients(
    problem: Quadratic, latent: FloatImage, slope: FloatImage, limit: int
) -> FloatImage:
    """
    Solve from latent by `limit` steps; slope: minus the gradient.

    Both are written over, and latent is given back.
    """
    sweep, rows = problem.sweep, latent.shape[1]
    d, q = sweep.directions
    sums = np.zeros((rows, 3), np.float32), np.zeros(rows, np.float32), np.zeros(2, np.float32)
    planes = latent, slope, d, q, problem.links, problem.ease
    blurred = problem.trust, sweep.taken, sweep.strips
    with_crew(_lead, _follow, limit, planes, blurred, sweep.parts(), sums)
    return latent


@njit(cache=True, nogil=True)
def _work(kind, piece, count, planes, blurred, parts, sums):  # type: ignore[no-untyped-def]
    """Do one piece of a step's work."""
    latent, r, d, q, links, ease = planes
    trust, taken, strips = blurred
    products, squares, pace = sums
    rows = (trust.shape[1], len(strips), r.shape[1], r.shape[1])[kind]
    first, end = piece * rows // count, (piece + 1) * rows // count
    if kind == GATHER:
        nearness, flow, shares, cells, far, room = parts
        gather_rows(first, end, d, trust, False, taken, nearness, flow, shares, cells, far, room)
    elif kind == SCATTER:
        nearness, flow, shares, cells, far, room = parts
        scatter_rows(first, end, taken, strips, nearness, flow, shares, cells, far, room)
    elif kind == SUM:
        one = np.float32(1)
        sum_rows(first, end, strips, trust.shape[1], d, r, links, ease, one, q, products)
    else:
        _advance(first, end, latent, r, d, q, ease, pace[0], pace[1], squares)


@njit(cache=True, nogil=True)
def _all(board, kind, rows, planes, blurred, parts, sums):  # type: ignore[no-untyped-def]
    """Do all of one kind, together."""
    count = begin(board, kind, rows)
    while True:
        mine, piece, of = take(board)
        if mine < 0:
            break
        _work(mine, piece, of, planes, blurred, parts, sums)
        hand_in(board)
    await_all(board, count)


@njit(cache=True, nogil=True)
def _follow(board, limit, planes, blurred, parts, sums):  # type: ignore[no-untyped-def]
    while await_more(board):
        kind, piece, count = take(board)
        if kind >= 0:
            _work(kind, piece, count, planes, blurred, parts, sums)
            hand_in(board)


@njit(cache=True, nogil=True)
def _lead(board, limit, planes, blurred, parts, sums):  # type: ignore[no-untyped-def]
    rows, (products, squares, pace) = len(sums[1]), sums
    planes[2][:] = 0
    pace[:] = 0
    _all(board, ADVANCE, rows, planes, blurred, parts, sums)
    left = squares.astype(np.float64).sum()
    for _ in range(limit):
        if left <= 0:
            break
        _all(board, GATHER, blurred[0].shape[1], planes, blurred, parts, sums)
        _all(board, SCATTER, len(blurred[2]), planes, blurred, parts, sums)
        _all(board, SUM, rows, planes, blurred, parts, sums)
        dq, rq, qq = products.astype(np.float64).sum(0)
        if dq <= 0:  # nothing is trusted and nothing holds together
            break
        step = left / dq
        pace[0], pace[1] = step, max(0.0, left - step * (2 * rq - step * qq)) / left
        _all(board, ADVANCE, rows, planes, blurred, parts, sums)
        left = squares.astype(np.float64).sum()


@njit(fastmath=True, **SHARED)
def _advance(first, end, latent, r, d, q, ease, step, turn, products):  # type: ignore[no-untyped-def]
    width = r.shape[2]
    for y in range(first, end):
        s = np.float32(0)
        for c in range(3):
            for x in range(width):
                latent[c, y, x] += step * d[c, y, x]
                left = r[c, y, x] - step * q[c, y, x]
                z = left / ease[c, y, x]
                r[c, y, x], d[c, y, x] = left, z + turn * d[c, y, x]
                s += left * z
        products[y] = s
