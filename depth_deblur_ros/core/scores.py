"""
The score of a motion: how well it explains the bands of all patches.

A matched filter that is normalised, so that a template without bands cannot win, docs/method.md
(11), at each scale of the picture; the scales' scores add up to the common one, (12).

Notation: as in evidence.py; q (m, 6) or (m, 9) motions [px].

    S(p) = -sum_b w_b C_b(J_b p) / sqrt(sum_b w_b D(J_b p) + 0.1),    the lower the better
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from depth_deblur_ros.core.data import FloatImage, Vector
from depth_deblur_ros.core.evidence import Evidence
from depth_deblur_ros.core.lanes import (
    larger,
    load,
    pairs,
    splat,
    store,
    where_positive,
    whole,
    whole_blocks,
    WIDTH,
)
from depth_deblur_ros.core.templates import ACROSS, REACH
from depth_deblur_ros.core.threads import on_threads, SHARED
from numba import njit
import numpy as np

CLOSE = 0.5  # the scale at twice the size
WITNESS = 1.75  # the scale of a small picture, whose half holds too few patches; has no vote
SHARE = {
    CLOSE: 1.0,
    1: 1.0,
    2: 0.5,
    4: 0.25,
    WITNESS: 0.7,
}  # of a scale in the common score: coarse bands are deep but inexact
PARALLAX_COST = 2e-5  # of S per squared pixel: shifts are likelier than parallax
ROLLING_COST = 0.06  # of S per squared change from first to last row over the squared length
EVEN = 0.1  # of S: keeps faint templates from winning by their small norm
CHUNK = 256  # motions that are scored together
MOST = 3  # scales that are scored together


@dataclass(frozen=True, eq=False)
class Scale:
    """One scale of the search: its evidence, and by how much the picture is smaller."""

    factor: float
    evidence: Evidence


def scores(qs: Vector, evidence: Evidence) -> Vector:
    """Give S (m,) of motions q."""
    return _scored(qs, laid_out([evidence], [1.0], qs.shape[1], priced=False))


def common_score(qs: Vector, scales: Sequence[Scale]) -> Vector:
    """Give the score (m,) of motions q over all scales; parallax and rows have a price."""
    return _scored(qs, common(scales, qs.shape[1]))


def common(scales: Sequence[Scale], size: int) -> tuple[Any, ...]:
    """Lay out what `judge` has to know for the common score of motions q (m, size)."""
    shares = [SHARE[scale.factor] for scale in scales]
    return laid_out([scale.evidence for scale in scales], shares, size, priced=True)


def laid_out(
    told: Sequence[Evidence], shares: Sequence[float], size: int, *, priced: bool
) -> tuple[Any, ...]:
    """Give C, w and J G of up to MOST scales, D and sag, shares, and what motions cost."""
    flows = [np.ascontiguousarray(e.flow_of_q[..., :size]).reshape(-1, 2 * size) for e in told]
    lists = [[e.match.reshape(len(e.match), -1) for e in told], [e.weight for e in told], flows]
    for some in lists:
        some.extend([some[0][:0]] * (MOST - len(told)))
    tables = told[0].energy.reshape(-1), told[0].sag.reshape(-1)
    costs = (PARALLAX_COST, ROLLING_COST) if priced else (0.0, 0.0)
    return *map(tuple, lists), tables, np.array(shares), costs


def _scored(qs: Vector, told: tuple[Any, ...]) -> Vector:
    found = np.empty(whole_blocks(len(qs)))
    on_threads(judge, found.size // WIDTH, _by_components(qs), *told, found)
    return found[: len(qs)]


def _by_components(qs: Vector) -> FloatImage:
    count, size = qs.shape
    padded = np.zeros((size, whole_blocks(count)), np.float32)
    padded[:, :count] = qs.T
    return padded.reshape(-1)


def rough_scores(qs: Vector, e: Evidence) -> Vector:
    """Give about S, by the nearest templates: enough to tell which motions are worth the rest."""
    (match, *_), (weight, *_), (flows, *_), (energy, _), *_ = laid_out(
        [e], [1.0], qs.shape[1], priced=False
    )
    c = np.zeros(whole_blocks(len(qs)), np.float32)
    d = np.full(len(c), EVEN, np.float32)
    told = match, energy, _by_components(qs), weight, flows
    on_threads(_add_roughly, len(c) // WIDTH, *told, c, d)
    return np.asarray(-c[: len(qs)].astype(np.float64) / np.sqrt(d[: len(qs)]))


@njit(cache=True, nogil=True, inline='always')
def _flow(row, q, i, step):  # type: ignore[no-untyped-def]
    """Give one row of J G times q, for sixteen motions from the i-th on."""
    flow = splat(row[0]) * load(q, i)
    flow += splat(row[1]) * load(q, i + step)
    flow += splat(row[2]) * load(q, i + 2 * step)
    flow += splat(row[3]) * load(q, i + 3 * step)
    flow += splat(row[4]) * load(q, i + 4 * step)
    flow += splat(row[5]) * load(q, i + 5 * step)
    if len(row) > 6:
        flow += splat(row[6]) * load(q, i + 6 * step)
        flow += splat(row[7]) * load(q, i + 7 * step)
        flow += splat(row[8]) * load(q, i + 8 * step)
    return flow


@njit(cache=True, nogil=True, inline='always')
def _between(table, p, w):  # type: ignore[no-untyped-def]
    """Look up sixteen cells, bilinear weights w."""
    here, right = pairs(table, p)
    below, beyond = pairs(table, p + splat(np.float32(ACROSS)))
    return w[0] * here + w[1] * right + w[2] * below + w[3] * beyond


@njit(cache=True, nogil=True, inline='always')
def _place(flow, q, i, step):  # type: ignore[no-untyped-def]
    """Give where sixteen motions' flows of a patch lie in a table, and > 0 where they do."""
    zero, reach = splat(np.float32(0)), splat(np.float32(REACH))
    half = len(flow) // 2
    u, v = _flow(flow[:half], q, i, step), _flow(flow[half:], q, i, step)
    u, v = where_positive(v, u, zero - u), larger(v, zero - v)
    inside = reach - larger(v, larger(u, zero - u))
    return where_positive(inside, u + reach, zero), where_positive(inside, v, zero), inside


@njit(cache=True, nogil=True)
def _add_patch(first, end, match, energy, sag, q, step, weight, flow, c, d):  # type: ignore[no-untyped-def]
    """Add what one patch says about motions `first` to `end` of `step` to c and d, from 0 on."""
    zero, one, w = splat(np.float32(0)), splat(np.float32(1)), splat(weight)
    for i in range(first, end, WIDTH):
        u, v, inside = _place(flow, q, i, step)
        x, y = whole(u), whole(v)
        a, b = u - x, v - y
        both = a * b
        corners = (one - a - b + both, a - both, b - both, both)
        place = x + y * splat(np.float32(ACROSS))
        along, down = pairs(sag, place + place)
        own = _between(energy, place, corners) - a * (one - a) * along - b * (one - b) * down
        found = where_positive(inside, w * _between(match, place, corners), zero)
        k = i - first
        store(c, k, load(c, k) + found)
        # A flow beyond the table costs.
        store(d, k, load(d, k) + w * where_positive(inside, own, one))


@njit(cache=True, nogil=True, inline='always')
def _price(q, i, step, costs):  # type: ignore[no-untyped-def]
    """Give what motion i costs before anything is seen."""
    price = costs[0] * (q[i + 4 * step] ** 2 + q[i + 5 * step] ** 2)
    if q.size > 6 * step:
        length = rows = 0.0
        for k in range(4):
            length += q[i + k * step] ** 2
        for k in range(6, 9):
            rows += q[i + k * step] ** 2
        price += costs[1] * rows / (1 + length)
    return price


@njit(**SHARED)
def judge(first, end, q, matches, weights, flows, tables, shares, costs, found):  # type: ignore[no-untyped-def]
    """Write the scores of blocks `first` to `end` of sixteen motions q (n * m,) to found (m,)."""
    step, (energy, sag) = found.size, tables
    c, d = np.empty(CHUNK, np.float32), np.empty(CHUNK, np.float32)
    for start in range(first * WIDTH, end * WIDTH, CHUNK):
        stop = min(start + CHUNK, end * WIDTH)
        for i in range(start, stop):
            found[i] = _price(q, i, step, costs)
        for s in range(len(shares)):
            for i in range(CHUNK):
                c[i], d[i] = 0, EVEN
            told, weight, flow = matches[s], weights[s], flows[s]
            for b in range(len(weight)):
                patch = told[b], energy, sag, q, step, weight[b], flow[b]
                _add_patch(start, stop, *patch, c, d)
            for i in range(start, stop):
                found[i] -= shares[s] * np.float64(c[i - start]) / np.sqrt(d[i - start])


@njit(**SHARED)
def _add_roughly(first, end, match, energy, q, weight, flows, c, d):  # type: ignore[no-untyped-def]
    """Add C and D of the nearest templates at sixteen motions each, from `first` to `end`."""
    zero, half = splat(np.float32(0)), splat(np.float32(0.5))
    both = np.empty(2 * energy.size, np.float32)
    for b in range(len(weight)):
        w, flow = weight[b], flows[b]
        for k in range(energy.size):
            both[2 * k], both[2 * k + 1] = w * match[b, k], w * energy[k]
        for i in range(first * WIDTH, end * WIDTH, WIDTH):
            u, v, inside = _place(flow, q, i, c.size)
            place = whole(u + half) + whole(v + half) * splat(np.float32(ACROSS))
            found, own = pairs(both, place + place)
            store(c, i, load(c, i) + where_positive(inside, found, zero))
            store(d, i, load(d, i) + where_positive(inside, own, splat(w)))
