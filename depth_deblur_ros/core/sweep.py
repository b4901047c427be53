"""
The blur operator and its adjoint on colour planes, sixteen pixels at a time: (5), but faster.

Notation: H, W the frame; N instants; W' = W in whole blocks of 16 pixels of a row. Latent planes
(3, H + 2 r, w) hold the frame from row r and column r on, w in whole blocks too; blurred planes
are (3, H, W').

At one instant the pixels of a block read places that lie side by side, too, but for a slow drift
and for edges in depth. So a block reads the same few offsets for all its pixels: 2 x 2 of them
where all displacements fall into one cell, with bilinear weights; some more where they straddle a
cell's border, weighted by tents, which comes to the same; pixel by pixel beyond MANY. Where slack
is allowed, a cell may go on a little beyond its border instead. In a thinned sweep blocks with a
shorter blur have fewer instants (instants.py). What is gathered here scatter.py spreads again.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import math
from typing import Any

from depth_deblur_ros.core.data import FloatImage
from depth_deblur_ros.core.instants import (
    aim,
    apart,
    back_at,
    bilinear,
    flow_at,
    laid_out,
    Layout,
    MANY,
)
from depth_deblur_ros.core.lanes import load, next_lane, splat, store, tent, whole_blocks, WIDTH
from depth_deblur_ros.core.scatter import scatter_rows
from depth_deblur_ros.core.threads import on_threads, SHARED, threads_here
from numba import njit
import numpy as np

STRIPS = 2  # of the adjoint for each thread, so that a faster one does more
GUARD = 2  # px beyond the margin, so that neighbours of what is read exist in every plane


@dataclass(frozen=True, eq=False)
class Sweep:
    """A of one motion, laid out for blocks; its room is for one thread's work at a time."""

    layout: Layout
    far: np.float32  # px, the longest displacement along an axis
    room: int  # r

    @property
    def blurred_shape(self) -> tuple[int, int, int]:
        """Shape of blurred planes."""
        height, blocks = self.layout.shares.shape
        return 3, height, blocks * WIDTH

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """Shape of latent planes."""
        _, height, width = self.blurred_shape
        return 3, height + 2 * self.room, whole_blocks(width + 2 * self.room)

    def blurred_planes(self, image: FloatImage) -> FloatImage:
        """Lay out a blurred image (H, W, 1 or 3) as planes, zero beyond it."""
        planes = np.zeros((image.shape[2], *self.blurred_shape[1:]), np.float32)
        planes[:, :, : image.shape[1]] = np.moveaxis(image, 2, 0)
        return planes

    def widened(self, planes: FloatImage) -> FloatImage:
        """Continue planes (3, H, W) over the latent planes by their border pixels."""
        _, height, width = self.latent_shape
        below, right = height - self.room - planes.shape[1], width - self.room - planes.shape[2]
        return np.pad(planes, [(0, 0), (self.room, below), (self.room, right)], 'edge')

    def gather(
        self, latent: FloatImage, weight: FloatImage, out: FloatImage | None = None
    ) -> FloatImage:
        """Give weight (1 or 3, H, W') times A L of latent planes, in `out` if given."""
        return self._gathered(latent, weight, out, less=False)

    def missing(
        self, data: FloatImage, latent: FloatImage, out: FloatImage | None = None
    ) -> FloatImage:
        """Give blurred planes (3, H, W') less A L of latent planes, in `out` if given."""
        return self._gathered(latent, data, out, less=True)

    def _gathered(
        self, latent: FloatImage, own: FloatImage, out: FloatImage | None, *, less: bool
    ) -> FloatImage:
        blurred = np.empty(self.blurred_shape, np.float32) if out is None else out
        rows = self.blurred_shape[1]
        on_threads(gather_rows, rows, latent, own, less, blurred, *self.parts())
        return blurred

    @cached_property
    def taken(self) -> FloatImage:
        """Room for blurred planes."""
        return np.empty(self.blurred_shape, np.float32)

    @cached_property
    def directions(self) -> FloatImage:
        """Room for two sets of latent planes (2, 3, h, w), zero beyond what steps reach."""
        return np.zeros((2, *self.latent_shape), np.float32)

    @cached_property
    def strips(self) -> FloatImage:
        """Room for what `scatter` writes apart: (n, 3, rows, w)."""
        _, height, _ = self.blurred_shape
        threads = threads_here()
        count = min(STRIPS * threads, height) if threads > 1 else 1
        _, _, wide = self.latent_shape
        return np.empty((count, 3, math.ceil(height / count) + 2 * self.room, wide), np.float32)

    def scatter(self, blurred: FloatImage) -> FloatImage:
        """Spread blurred planes over `strips`; row j of strip k of n: latent row k H // n + j."""
        on_threads(scatter_rows, len(self.strips), blurred, self.strips, *self.parts())
        return self.strips

    def adjoint(self, blurred: FloatImage) -> FloatImage:
        """Give A' B in latent planes."""
        strips = self.scatter(blurred)
        latent = np.zeros(self.latent_shape, np.float32)
        height, count = self.blurred_shape[1], len(strips)
        for k, strip in enumerate(strips):
            first = k * height // count
            rows = min(strip.shape[1], latent.shape[1] - first)
            latent[:, first : first + rows] += strip[:, :rows]
        return latent

    def parts(self) -> tuple[Any, ...]:
        """Give what the kernels are told of A."""
        told = self.layout
        return told.nearness, told.flow, told.shares, told.cells, self.far, self.room


def sweep_of(
    seen: FloatImage, flow: FloatImage, margin: int, spacing: float = 0.0, slack: float = 0.0
) -> Sweep:
    """
    Lay out A for inverse depth seen (H, N, W') and flow; no pixel reads beyond the margin.

    spacing: px of its own longest blur for which a block has an instant, of at most N; 0: all N.
    slack: px that a block may read beyond a cell as if the cell went on.
    """
    far = np.float32(margin - 1)
    return Sweep(laid_out(seen, flow, spacing, far, slack), far, margin + GUARD)


@njit(cache=True, nogil=True)
def _row(plane, p):  # type: ignore[no-untyped-def]
    """Give a block and the one that begins at the next element, which is read; one is enough."""
    beyond = load(plane, p + 1)
    return next_lane(beyond, splat(plane[p])), beyond


@njit(cache=True, nogil=True)
def _read(plane, p, wide, w):  # type: ignore[no-untyped-def]
    (a, b), (c, d) = _row(plane, p), _row(plane, p + wide)
    return w[0] * a + w[1] * b + w[2] * c + w[3] * d


@njit(cache=True, nogil=True)
def _read_each(plane, p, wide, places):  # type: ignore[no-untyped-def]
    """Read for each pixel of a block by itself; places (4, 16): u, v, scratch, result."""
    for k in range(WIDTH):
        u, v = places[k], places[WIDTH + k]
        x0, y0 = math.floor(u), math.floor(v)
        u, v = u - x0, v - y0
        q = p + k + y0 * wide + x0
        above = (1 - u) * plane[q] + u * plane[q + 1]
        below = (1 - u) * plane[q + wide] + u * plane[q + wide + 1]
        places[2 * WIDTH + k] = (1 - v) * above + v * below
    return load(places, 2 * WIDTH)


@njit(cache=True, nogil=True)
def _finish(own, near, less, blurred, at, found):  # type: ignore[no-untyped-def]
    store(blurred, at, load(own, near) - found if less else load(own, near) * found)


@njit(cache=True, nogil=True)
def _gather_row(y, latent, own, less, blurred, data, far, room, sizes):  # type: ignore[no-untyped-def]
    """Write one row of own times A L, or less A L; all are flat, data the arrays of a Sweep."""
    height, samples, width, high, wide = sizes
    plane, colour = high * wide, height * width
    further = 0 if own.size == colour else colour  # one plane of own may serve all
    places = np.empty(3 * WIDTH, np.float32)
    for k in range(width // WIDTH):
        r = g = b = splat(np.float32(0))
        one, parts = data[2][y * (width // WIDTH) + k], flow_at(y, k, data[1], width)
        for i in range(samples):
            if back_at(i, one) < np.float32(-0.5):
                break
            place = y, k, samples, width
            u, v, left, top, columns, rows = aim(place, i, one, parts, data)
            p = (y + room + top) * wide + k * WIDTH + room + left
            if columns == 2 and rows == 2:
                corners = bilinear(u, v)
                r += _read(latent, p, wide, corners)
                g += _read(latent, p + plane, wide, corners)
                b += _read(latent, p + 2 * plane, wide, corners)
            elif columns * rows <= MANY:
                for j in range(rows):
                    down = tent(v - splat(np.float32(j)))
                    for m in range(columns):
                        share_of, q = down * tent(u - splat(np.float32(m))), p + j * wide + m
                        r += share_of * load(latent, q)
                        g += share_of * load(latent, q + plane)
                        b += share_of * load(latent, q + 2 * plane)
            else:
                apart(places, u, v, left, top, far)
                r += _read_each(latent, p, wide, places)
                g += _read_each(latent, p + plane, wide, places)
                b += _read_each(latent, p + 2 * plane, wide, places)
        at, share = y * width + k * WIDTH, splat(one)
        _finish(own, at, less, blurred, at, share * r)
        _finish(own, at + further, less, blurred, at + colour, share * g)
        _finish(own, at + 2 * further, less, blurred, at + 2 * colour, share * b)


@njit(**SHARED)
def gather_rows(first, end, latent, own, less, blurred, nearness, flow, shares, cells, far, room):  # type: ignore[no-untyped-def]
    """Write rows of own times A L, or less A L."""
    height, blocks, samples, _ = nearness.shape
    width = blocks * WIDTH
    sizes = (height, samples, width, latent.shape[1], latent.shape[2])
    data = (nearness.reshape(-1), flow.reshape(-1), shares.reshape(-1), cells.reshape(-1))
    flat = (latent.reshape(-1), own.reshape(-1), less, blurred.reshape(-1))
    for y in range(first, end):
        _gather_row(y, *flat, data, far, room, sizes)
