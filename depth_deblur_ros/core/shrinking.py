"""
The shrinking random search around motions, the same each time: one compiled loop.

Each round tries motions around the best so far, in a smaller neighbourhood than the round before.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

from depth_deblur_ros.core.crew import all_done, await_more, begin, hand_in, take
from depth_deblur_ros.core.data import Vector
from depth_deblur_ros.core.lanes import whole_blocks, WIDTH
from depth_deblur_ros.core.scores import common, common_score, judge, Scale
from depth_deblur_ros.core.threads import with_crew
from numba import njit
import numpy as np

SPREAD = (1.0, 1.0, 1.5, 1.5, 1.0, 1.0, 1.0, 1.0, 1.0)  # of the search along each axis of q
ROUNDS, TRIES, SHRINK = 14, 200, 0.78
TOGETHER = 6  # blocks of motions in a piece, so that its thread finds the tables in its cache


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
    steps = np.ascontiguousarray(steps[..., :size])
    with_crew(_shrink, steps, qs, best, (q, *common(scales, size), found))
    return qs


@njit(cache=True, nogil=True, inline='always')
def _try(step, qs, q, most):  # type: ignore[no-untyped-def]
    """Write the motions to try, a step (count, size) from qs (n, size), by components."""
    for j in range(len(qs)):
        for m in range(qs.shape[1]):
            for k in range(len(step)):
                q[m * most + j * len(step) + k] = qs[j, m] + step[k, m]


@njit(cache=True, nogil=True, inline='always')
def _choose(step, qs, best, found):  # type: ignore[no-untyped-def]
    """Go where it is better."""
    for j in range(len(qs)):
        lowest = 0
        for k in range(len(step)):
            if found[j * len(step) + k] < found[j * len(step) + lowest]:
                lowest = k
        if found[j * len(step) + lowest] < best[j]:
            best[j] = found[j * len(step) + lowest]
            for m in range(qs.shape[1]):
                qs[j, m] += step[lowest, m]


@njit(cache=True, nogil=True)
def _shrink(board, leads, steps, qs, best, told):  # type: ignore[no-untyped-def]
    """Take pieces of what is to be judged; who leads chooses, and says what to try next."""
    q, matches, weights, flows, tables, shares, costs, found = told
    rounds, count = 0, np.int64(0)  # for 0, a constant, `all_done` would be compiled once more
    while True:
        kind, piece, of = take(board)
        if kind >= 0:
            blocks = found.size // WIDTH
            first, end = piece * blocks // of, (piece + 1) * blocks // of
            judge(first, end, q, matches, weights, flows, tables, shares, costs, found)
            hand_in(board)
        elif not leads:
            if not await_more(board):
                return
        elif all_done(board, count):
            if rounds > 0:
                _choose(steps[rounds - 1], qs, best, found)
            if rounds == len(steps):
                return
            _try(steps[rounds], qs, q, found.size)
            rounds += 1
            pieces = max(1, found.size // WIDTH // TOGETHER)
            count = begin(board, np.int64(0), pieces)  # all work is of one kind
