"""
The blur operator and its adjoint on colour planes, sixteen pixels at a time: (5), but faster.

Notation: H, W the frame; N instants; W' = W in whole blocks of 16 pixels of a row. Latent planes
(3, H + 2 r, w) hold the frame from row r and column r on, w in whole blocks too; blurred planes
are (3, H, W').

At one instant the pixels of a block read places that lie side by side, too, but for a slow drift
and for edges in depth. So a block reads the same few offsets for all its pixels: 2 x 2 of them
where all displacements fall into one cell, with bilinear weights; some more where they straddle a
cell's border, weighted by tents, which comes to the same; pixel by pixel beyond MANY. In
a thinned sweep blocks with a shorter blur have fewer instants (instants.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import math
from typing import Any

from depth_deblur_ros.core.data import FloatImage
from depth_deblur_ros.core.instants import back_at, cells_of, displacement, flow_at, thinned
from depth_deblur_ros.core.lanes import (
    last_lane,
    load,
    next_lane,
    splat,
    store,
    tent,
    whole_blocks,
    WIDTH,
)
from depth_deblur_ros.core.threads import on_threads, SHARED, threads_here
from numba import njit
import numpy as np
import numpy.typing as npt

MANY = 20  # offsets of one block
GUARD = 2  # px beyond the margin, so that neighbours of what is read exist in every plane


@dataclass(frozen=True, eq=False)
class Sweep:
    """A of one motion, laid out for blocks; its room is for one thread's work at a time."""

    nearness: FloatImage  # (H, N, W') inverse depth seen [1/m]
    flow: FloatImage  # (H, 4, W') a_x, a_y [px], b_x, b_y [px m] of the flow a + w b
    shares: FloatImage  # (H, W' / 16) 1 / how many instants a block has: its first ones above
    cells: npt.NDArray[np.int16]  # (H, W' / 16, N, 4) least offset x, y; how many x, y
    far: np.float32  # px, the longest displacement along an axis
    room: int  # r

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """Shape of latent planes."""
        height, _, width = self.nearness.shape
        return 3, height + 2 * self.room, whole_blocks(width + 2 * self.room)

    def blurred_planes(self, image: FloatImage) -> FloatImage:
        """Lay out a blurred image (H, W, 3) as planes, zero beyond it."""
        height, _, width = self.nearness.shape
        planes = np.zeros((3, height, width), np.float32)
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
        """Give weight (3, H, W') times A L of latent planes, in `out` if given."""
        blurred = np.empty_like(weight) if out is None else out
        on_threads(_gather, len(self.nearness), latent, weight, blurred, *self._parts())
        return blurred

    @cached_property
    def taken(self) -> FloatImage:
        """Room for blurred planes."""
        height, _, width = self.nearness.shape
        return np.empty((3, height, width), np.float32)

    @cached_property
    def directions(self) -> FloatImage:
        """Room for two sets of latent planes (2, 3, h, w), zero beyond what steps reach."""
        return np.zeros((2, *self.latent_shape), np.float32)

    @cached_property
    def strips(self) -> FloatImage:
        """Room for what each thread of `scatter` writes: (n, 3, rows, w)."""
        height = self.nearness.shape[0]
        count = min(threads_here(), height)
        _, _, wide = self.latent_shape
        return np.empty((count, 3, math.ceil(height / count) + 2 * self.room, wide), np.float32)

    def scatter(self, blurred: FloatImage) -> FloatImage:
        """Spread blurred planes over `strips`; row j of strip k of n: latent row k H // n + j."""
        on_threads(_scatter, len(self.strips), blurred, self.strips, *self._parts())
        return self.strips

    def adjoint(self, blurred: FloatImage) -> FloatImage:
        """Give A' B in latent planes."""
        strips = self.scatter(blurred)
        latent = np.zeros(self.latent_shape, np.float32)
        height, count = self.nearness.shape[0], len(strips)
        for k, strip in enumerate(strips):
            first = k * height // count
            rows = min(strip.shape[1], latent.shape[1] - first)
            latent[:, first : first + rows] += strip[:, :rows]
        return latent

    def _parts(self) -> tuple[Any, ...]:
        return self.nearness, self.flow, self.shares, self.cells, self.far, self.room


def sweep_of(nearness: FloatImage, flow: FloatImage, margin: int, spacing: float = 0.0) -> Sweep:
    """
    Lay out A for nearness (H, N, W') and flow (H, 4, W'); no pixel reads beyond the margin.

    spacing: px of its own longest blur for which a block has an instant, of at most N; 0: all N.
    """
    far = np.float32(margin - 1)
    nearness, shares = thinned(nearness, flow, spacing)
    cells = cells_of(nearness, flow, shares, far)
    return Sweep(nearness, flow, shares, cells, far, margin + GUARD)


@njit(cache=True, nogil=True, inline='always')
def _bilinear(u, v):  # type: ignore[no-untyped-def]
    """Give the weights of a cell's corners: above, above right, below, below right."""
    w11 = u * v
    w10, w01 = v - w11, u - w11
    return splat(np.float32(1)) - u - w10, w01, w10, w11


@njit(cache=True, nogil=True, inline='always')
def _read(plane, p, wide, w):  # type: ignore[no-untyped-def]
    q = p + wide
    above = w[0] * load(plane, p) + w[1] * load(plane, p + 1)
    return above + w[2] * load(plane, q) + w[3] * load(plane, q + 1)


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


@njit(cache=True, nogil=True, inline='always')
def _aim(place, i, share, parts, data, far):  # type: ignore[no-untyped-def]
    """
    Say where a block reads at instant i; place: y, k, N, W'.

    Displacements u, v from the first offset; the offset's columns and rows from the block's own
    place; how many columns and rows of offsets there are.
    """
    y, k, samples, width = place
    ax, ay, bx, by = parts
    near, _, _, cells = data
    w, back = load(near, (y * samples + i) * width + k * WIDTH), splat(back_at(i, share))
    c = 4 * ((y * (width // WIDTH) + k) * samples + i)
    left, top = np.intp(cells[c]), np.intp(cells[c + 1])
    u = displacement(ax, bx, w, back, far) - splat(np.float32(left))
    v = displacement(ay, by, w, back, far) - splat(np.float32(top))
    return u, v, left, top, np.intp(cells[c + 2]), np.intp(cells[c + 3])


@njit(cache=True, nogil=True)
def _gather_row(y, latent, weight, blurred, data, far, room, sizes):  # type: ignore[no-untyped-def]
    """Write one row of `gather`; planes are flat, data the flat arrays of a Sweep."""
    height, samples, width, high, wide = sizes
    plane, colour = high * wide, height * width
    places = np.empty(3 * WIDTH, np.float32)
    for k in range(width // WIDTH):
        r = g = b = splat(np.float32(0))
        one, parts = data[2][y * (width // WIDTH) + k], flow_at(y, k, data[1], width)
        for i in range(samples):
            if back_at(i, one) < np.float32(-0.5):
                break
            place = y, k, samples, width
            u, v, left, top, columns, rows = _aim(place, i, one, parts, data, far)
            p = (y + room + top) * wide + k * WIDTH + room + left
            if columns == 2 and rows == 2:
                corners = _bilinear(u, v)
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
                store(places, 0, u)
                store(places, WIDTH, v)
                r += _read_each(latent, p, wide, places)
                g += _read_each(latent, p + plane, wide, places)
                b += _read_each(latent, p + 2 * plane, wide, places)
        at, share = y * width + k * WIDTH, splat(one)
        store(blurred, at, share * load(weight, at) * r)
        store(blurred, at + colour, share * load(weight, at + colour) * g)
        store(blurred, at + 2 * colour, share * load(weight, at + 2 * colour) * b)


@njit(**SHARED)
def _gather(first, end, latent, weight, blurred, nearness, flow, shares, cells, far, room):  # type: ignore[no-untyped-def]
    height, samples, width = nearness.shape
    sizes = (height, samples, width, latent.shape[1], latent.shape[2])
    data = (nearness.reshape(-1), flow.reshape(-1), shares.reshape(-1), cells.reshape(-1))
    flat = (latent.reshape(-1), weight.reshape(-1), blurred.reshape(-1))
    for y in range(first, end):
        _gather_row(y, *flat, data, far, room, sizes)


@njit(cache=True, nogil=True, inline='always')
def _add(plane, p, lanes):  # type: ignore[no-untyped-def]
    store(plane, p, load(plane, p) + lanes)


@njit(cache=True, nogil=True, inline='always')
def _spread(plane, p, wide, w, value):  # type: ignore[no-untyped-def]
    """Add to a row and the one below, each once: what overlaps has to wait for its turn."""
    here, beside = w[0] * value, w[1] * value
    _add(plane, p, here + next_lane(beside))
    plane[p + WIDTH] += last_lane(beside)
    here, beside = w[2] * value, w[3] * value
    _add(plane, p + wide, here + next_lane(beside))
    plane[p + wide + WIDTH] += last_lane(beside)


@njit(cache=True, nogil=True)
def _spread_each(plane, p, wide, places, value):  # type: ignore[no-untyped-def]
    """Spread for each pixel of a block by itself; places (3, 16): u, v, scratch."""
    store(places, 2 * WIDTH, value)
    for k in range(WIDTH):
        u, v, b = places[k], places[WIDTH + k], places[2 * WIDTH + k]
        x0, y0 = math.floor(u), math.floor(v)
        u, v = u - x0, v - y0
        q = p + k + y0 * wide + x0
        plane[q] += (1 - v) * (1 - u) * b
        plane[q + 1] += (1 - v) * u * b
        plane[q + wide] += v * (1 - u) * b
        plane[q + wide + 1] += v * u * b


@njit(cache=True, nogil=True, inline='always')
def _shared(blurred, at, colour, share):  # type: ignore[no-untyped-def]
    """Give an instant's share of the three colours of a block."""
    r, g, b = load(blurred, at), load(blurred, at + colour), load(blurred, at + 2 * colour)
    return share * r, share * g, share * b


@njit(cache=True, nogil=True)
def _scatter_row(y, first, strip, blurred, data, far, room, sizes):  # type: ignore[no-untyped-def]
    """Spread one row over a strip that begins at row `first`; planes and strip are flat."""
    height, samples, width, high, wide = sizes
    plane, colour = high * wide, height * width
    places = np.empty(3 * WIDTH, np.float32)
    for i in range(samples):
        for k in range(width // WIDTH):
            one = data[2][y * (width // WIDTH) + k]
            if back_at(i, one) < np.float32(-0.5):
                continue
            r, g, b = _shared(blurred, y * width + k * WIDTH, colour, splat(one))
            place, parts = (y, k, samples, width), flow_at(y, k, data[1], width)
            u, v, left, top, columns, rows = _aim(place, i, one, parts, data, far)
            p = (y - first + room + top) * wide + k * WIDTH + room + left
            if columns == 2 and rows == 2:
                corners = _bilinear(u, v)
                _spread(strip, p, wide, corners, r)
                _spread(strip, p + plane, wide, corners, g)
                _spread(strip, p + 2 * plane, wide, corners, b)
            elif columns * rows <= MANY:
                for j in range(rows):
                    down = tent(v - splat(np.float32(j)))
                    for m in range(columns):
                        share_of, q = down * tent(u - splat(np.float32(m))), p + j * wide + m
                        _add(strip, q, share_of * r)
                        _add(strip, q + plane, share_of * g)
                        _add(strip, q + 2 * plane, share_of * b)
            else:
                store(places, 0, u)
                store(places, WIDTH, v)
                _spread_each(strip, p, wide, places, r)
                _spread_each(strip, p + plane, wide, places, g)
                _spread_each(strip, p + 2 * plane, wide, places, b)


@njit(**SHARED)
def _scatter(first, end, blurred, strips, nearness, flow, shares, cells, far, room):  # type: ignore[no-untyped-def]
    height, samples, width = nearness.shape
    sizes = (height, samples, width, strips.shape[2], strips.shape[3])
    data = (nearness.reshape(-1), flow.reshape(-1), shares.reshape(-1), cells.reshape(-1))
    flat, count = blurred.reshape(-1), strips.shape[0]
    for k in range(first, end):
        strip = strips[k].reshape(-1)
        strip[:] = 0
        top = k * height // count
        for y in range(top, (k + 1) * height // count):
            _scatter_row(y, top, strip, flat, data, far, room, sizes)
