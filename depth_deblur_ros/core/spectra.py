"""
The spectra of patches, as far as the band goes that bands are looked for in.

A patch's transform is a product with two small matrices of waves: of its rows, which patches one
above the other share, then of its columns. docs/method.md (8).

Notation: PATCH pixels a side; K waves, BAND_COLUMNS cosines and as many sines, under the window.
"""

from __future__ import annotations

from functools import lru_cache

import cv2
from depth_deblur_ros.core.data import FloatImage
from depth_deblur_ros.core.lanes import load, splat, store, WIDTH
from depth_deblur_ros.core.templates import BAND_COLUMNS, HALF, PATCH
from depth_deblur_ros.core.threads import on_threads, SHARED
from numba import njit
import numpy as np
import numpy.typing as npt

WAVES = 2 * BAND_COLUMNS
assert WAVES == 3 * WIDTH, 'what _combine has room for'


def patch_spectra(
    grey: FloatImage,
    valid: FloatImage,
    corners: list[tuple[int, int]],
    bins: npt.NDArray[np.intp],
) -> tuple[FloatImage, FloatImage]:
    """
    Give the gradients' spectrum (B, n) of each patch in the bins, and their mean square (B,).

    grey, valid (H, W); corners (row, column) of the patches; bins: of the half spectrum
    (PATCH, HALF), flat.
    """
    power = np.empty((len(corners), len(bins)), np.float32)
    weight = np.empty(len(corners), np.float32)
    tops, lefts = np.array(corners).T
    order = np.argsort(lefts, kind='stable')
    columns, first = np.unique(lefts[order], return_index=True)
    strips = np.stack([columns, first, np.append(first[1:], len(order))], 1)
    patches = np.stack([order, tops[order]], 1)
    waves, turned, window = _waves()
    told = (_differences(grey) * valid, waves, turned, window, _places(bins), power, weight)
    on_threads(_look, len(strips), strips, patches, *told)
    return power, weight


@lru_cache(maxsize=1)
def _waves() -> tuple[FloatImage, FloatImage, FloatImage]:
    """Give the waves under the window (PATCH, K), flat, their transpose, and its square."""
    window = np.hanning(PATCH + 2)[1:-1]
    angle = 2 * np.pi / PATCH * np.outer(np.arange(PATCH), np.arange(BAND_COLUMNS))
    waves = window[:, None] * np.concatenate([np.cos(angle), np.sin(angle)], 1)
    own = np.asarray(waves, np.float32)
    return own.reshape(-1), own.T.reshape(-1), np.square(window).astype(np.float32)


def _places(bins: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Say where `_powers` leaves the bins: frequencies v >= 0 along y, then v <= 0."""
    v, u = np.divmod(bins, HALF)
    upwards = v >= BAND_COLUMNS
    rows = np.where(upwards, PATCH - v + BAND_COLUMNS, v)
    return np.asarray(rows * BAND_COLUMNS + u)


def _differences(grey: FloatImage) -> FloatImage:
    """Give the gradient (2, H, W), x and y."""
    kernel = np.array([[-0.5, 0, 0.5]], np.float32)
    gx, gy = cv2.filter2D(grey, -1, kernel), cv2.filter2D(grey, -1, kernel.T.copy())
    return np.array([gx, gy], np.float32)


@njit(cache=True, nogil=True, inline='always')
def _combine(shares, p, q, rows, first, out, a, b):  # type: ignore[no-untyped-def]
    """Sum PATCH rows of K values, with the shares from p on, and from q on; flat arrays."""
    a0 = a1 = a2 = b0 = b1 = b2 = splat(np.float32(0))
    for k in range(PATCH):
        at = first + k * WAVES
        r0, r1, r2 = load(rows, at), load(rows, at + WIDTH), load(rows, at + 2 * WIDTH)
        one, other = splat(shares[p + k]), splat(shares[q + k])
        a0 += one * r0
        a1 += one * r1
        a2 += one * r2
        b0 += other * r0
        b1 += other * r1
        b2 += other * r2
    store(out, a, a0)
    store(out, a + WIDTH, a1)
    store(out, a + 2 * WIDTH, a2)
    store(out, b, b0)
    store(out, b + WIDTH, b1)
    store(out, b + 2 * WIDTH, b2)


@njit(cache=True, nogil=True)
def _add_power(across, first, turned, both, power):  # type: ignore[no-untyped-def]
    """Add the power of a patch's field, whose rows are transformed; both (K, K) is written."""
    flat = both.reshape(-1)
    for k in range(0, WAVES, 2):
        p, a = k * PATCH, k * WAVES
        _combine(turned, p, p + PATCH, across, first, flat, a, a + WAVES)
    for v in range(BAND_COLUMNS):
        for u in range(BAND_COLUMNS):
            cc, ss = both[v, u], both[v + BAND_COLUMNS, u + BAND_COLUMNS]
            sc, cs = both[v + BAND_COLUMNS, u], both[v, u + BAND_COLUMNS]
            power[v, u] += (cc - ss) ** 2 + (sc + cs) ** 2
            power[v + BAND_COLUMNS, u] += (cc + ss) ** 2 + (sc - cs) ** 2


@njit(**SHARED)
def _look(first, end, strips, patches, fields, waves, turned, window, bins, power, weight):  # type: ignore[no-untyped-def]
    """Look at the patches of some columns."""
    _, height, width = fields.shape
    flat = fields.reshape(-1)
    across, squares = np.empty(2 * height * WAVES, np.float32), np.empty(height, np.float32)
    both, own = np.empty((WAVES, WAVES), np.float32), np.empty((WAVES, BAND_COLUMNS), np.float32)
    for c in range(first, end):
        left, own_first, own_end = strips[c]
        for y in range(0, 2 * height, 2):
            p = y * width + left
            _combine(flat, p, p + width, waves, 0, across, y * WAVES, (y + 1) * WAVES)
        squares[:] = 0
        for f in range(2):
            for y in range(height):
                for k in range(PATCH):
                    squares[y] += fields[f, y, left + k] ** 2 * window[k]
        for i in range(own_first, own_end):
            b, top = patches[i]
            own[:] = 0
            for f in range(2):
                _add_power(across, (f * height + top) * WAVES, turned, both, own)
            for k in range(len(bins)):
                power[b, k] = own.reshape(-1)[bins[k]]
            mean = np.float32(0)
            for k in range(PATCH):
                mean += squares[top + k] * window[k]
            weight[b] = mean / np.float32(PATCH * PATCH)
