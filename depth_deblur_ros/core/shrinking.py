"""
The shrinking random search around motions, the same each time: one compiled loop.

Each round tries motions around the best so far, in a smaller neighbourhood than the round before.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

from depth_deblur_ros.core.crew import await_all, await_more, begin, hand_in, take
from depth_deblur_ros.core.data import Vector
from depth_deblur_ros.core.lanes import whole_blocks, WIDTH
from depth_deblur_ros.core.scores import common, common_score, judge, Scale
from depth_deblur_ros.core.threads import with_crew
from numba import njit
import numpy as np

SPREAD = (1.0, 1.0, 1.5, 1.5, 1.0, 1.0, 1.0, 1.0, 1.0)  # of the search along each axis of q
ROUNDS, TRIES, SHRINK = 14, 200, 0.78


@lru_cache(maxsize=1)
def _steps() -> Vector:
    """Give the steps (ROUNDS, TRIES, 9) of the search, in units of its radius and spread."""
    steps = np.random.default_rng(0).standard_normal((ROUNDS, TRIES, 9))
    return np.asarray(steps * SHRINK ** np.arange(ROUNDS)[:, None, None])


def shrink_around(
    qs: Vector,
    scales: Sequence[Scale],
    radius: float,
    *,
    count: int = TRIES,
    spread: Vector | None = None,
) -> Vector:
    """
    Give the best motions by the common score around each of qs (n, 6 or 9); radius [px].

    count: of the motions that are tried in each round; spread (9, 9): how far along each axis of
    q, SPREAD if none.
    """
    many, size = qs.shape
    qs, best = qs.copy(), common_score(qs, scales)
    found = np.empty(whole_blocks(many * count))
    q = np.zeros(size * found.size, np.float32)
    steps = radius * _steps()[:, :count] @ (np.diag(SPREAD) if spread is None else spread)
    with_crew(
        _lead,
        _follow,
        np.ascontiguousarray(steps[..., :size]),
        qs,
        best,
        (q, *common(scales, size), found),
    )
    return qs


@njit(cache=True, nogil=True)
def _judge_piece(piece, count, told):  # type: ignore[no-untyped-def]
    q, matches, weights, flows, tables, shares, costs, found = told
    blocks = found.size // WIDTH
    first, end = piece * blocks // count, (piece + 1) * blocks // count
    judge(first, end, q, matches, weights, flows, tables, shares, costs, found)


@njit(cache=True, nogil=True)
def _follow(board, steps, qs, best, told):  # type: ignore[no-untyped-def]
    while await_more(board):
        kind, piece, count = take(board)
        if kind >= 0:
            _judge_piece(piece, count, told)
            hand_in(board)


@njit(cache=True, nogil=True)
def _judge_all(board, told):  # type: ignore[no-untyped-def]
    count = begin(board, 0, told[-1].size // WIDTH)
    while True:
        kind, piece, _ = take(board)
        if kind < 0:
            break
        _judge_piece(piece, count, told)
        hand_in(board)
    await_all(board, count)


@njit(cache=True, nogil=True)
def _lead(board, steps, qs, best, told):  # type: ignore[no-untyped-def]
    q, found = told[0], told[-1]
    (many, size), count = qs.shape, steps.shape[1]
    for step in steps:
        for j in range(many):
            for m in range(size):
                for k in range(count):
                    q[m * found.size + j * count + k] = qs[j, m] + step[k, m]
        _judge_all(board, told)
        for j in range(many):
            own = found[j * count : (j + 1) * count]
            lowest = np.argmin(own)
            if own[lowest] < best[j]:
                best[j] = own[lowest]
                qs[j] += step[lowest]
