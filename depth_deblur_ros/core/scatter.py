"""
The adjoint of the blur on colour planes: what each block of sixteen pixels saw, spread again.

Notation as in sweep.py. A block's instants follow each other, and as long as they read the same
2 x 2 offsets their sums are held back: what is written is waited for when it is read again.
"""

from __future__ import annotations

import math

from depth_deblur_ros.core.instants import aim, apart, back_at, bilinear, flow_at, MANY
from depth_deblur_ros.core.lanes import last_lane, load, next_lane, splat, store, tent, WIDTH
from depth_deblur_ros.core.threads import SHARED
from numba import njit
import numpy as np


@njit(cache=True, nogil=True, inline='always')
def _add(plane, p, lanes):  # type: ignore[no-untyped-def]
    store(plane, p, load(plane, p) + lanes)


@njit(cache=True, nogil=True)
def _with(held, w, value):  # type: ignore[no-untyped-def]
    """Add what a value gives the corners of a cell to what is held for them."""
    above = held[0] + w[0] * value, held[1] + w[1] * value
    return above[0], above[1], held[2] + w[2] * value, held[3] + w[3] * value


@njit(cache=True, nogil=True)
def _leave(plane, p, wide, held):  # type: ignore[no-untyped-def]
    """Add to a row and the one below, each once: what overlaps has to wait for its turn."""
    none = splat(np.float32(0))
    _add(plane, p, held[0] + next_lane(held[1], none))
    plane[p + WIDTH] += last_lane(held[1])
    _add(plane, p + wide, held[2] + next_lane(held[3], none))
    plane[p + wide + WIDTH] += last_lane(held[3])


@njit(cache=True, nogil=True)
def _leave_all(strip, p, wide, plane, held):  # type: ignore[no-untyped-def]
    if p >= 0:
        _leave(strip, p, wide, held[0])
        _leave(strip, p + plane, wide, held[1])
        _leave(strip, p + 2 * plane, wide, held[2])


@njit(cache=True, nogil=True, inline='always')
def _shifted(here, beyond, value):  # type: ignore[no-untyped-def]
    """Move sixteen values and what follows them by a place, and add a value to the first."""
    return value + next_lane(here, splat(np.float32(0))), next_lane(beyond, here)


@njit(cache=True, nogil=True)
def _spread(strip, p, wide, plane, cells, colours):  # type: ignore[no-untyped-def]
    """Spread over some more offsets; cells: u, v, how many columns and rows."""
    u, v, columns, rows = cells
    none = splat(np.float32(0))
    for j in range(rows):
        down, q = tent(v - splat(np.float32(j))), p + j * wide
        r = g = b = none, none
        for m in range(columns - 1, -1, -1):
            w = down * tent(u - splat(np.float32(m)))
            r = _shifted(r[0], r[1], w * colours[0])
            g = _shifted(g[0], g[1], w * colours[1])
            b = _shifted(b[0], b[1], w * colours[2])
        for s in range(2):
            _add(strip, q + s * WIDTH, r[s])
            _add(strip, q + plane + s * WIDTH, g[s])
            _add(strip, q + 2 * plane + s * WIDTH, b[s])


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
    none = splat(np.float32(0)), splat(np.float32(0)), splat(np.float32(0)), splat(np.float32(0))
    for k in range(width // WIDTH):
        one, parts = data[2][y * (width // WIDTH) + k], flow_at(y, k, data[1], width)
        r, g, b = _shared(blurred, y * width + k * WIDTH, colour, splat(one))
        of_r = of_g = of_b = none
        held = np.intp(-1)  # a constant would have what is called compiled once more
        for i in range(samples):
            if back_at(i, one) < np.float32(-0.5):
                break
            place = y, k, samples, width
            u, v, left, top, columns, rows = aim(place, i, one, parts, data)
            p = (y - first + room + top) * wide + k * WIDTH + room + left
            if columns == 2 and rows == 2:
                if p != held:  # the next instant often has the same cell
                    _leave_all(strip, held, wide, plane, (of_r, of_g, of_b))
                    of_r = of_g = of_b = none
                    held = p
                w = bilinear(u, v)
                of_r, of_g, of_b = _with(of_r, w, r), _with(of_g, w, g), _with(of_b, w, b)
            elif columns * rows <= MANY:
                cells = u, v, columns, rows
                _spread(strip, p, wide, plane, cells, (r, g, b))
            else:
                apart(places, u, v, left, top, far)
                _spread_each(strip, p, wide, places, r)
                _spread_each(strip, p + plane, wide, places, g)
                _spread_each(strip, p + 2 * plane, wide, places, b)
        _leave_all(strip, held, wide, plane, (of_r, of_g, of_b))


@njit(**SHARED)
def scatter_rows(first, end, blurred, strips, nearness, flow, shares, cells, far, room):  # type: ignore[no-untyped-def]
    """Write strips `first` to `end` of `Sweep.scatter`."""
    height, blocks, samples, _ = nearness.shape
    width = blocks * WIDTH
    sizes = (height, samples, width, strips.shape[2], strips.shape[3])
    data = (nearness.reshape(-1), flow.reshape(-1), shares.reshape(-1), cells.reshape(-1))
    flat, count = blurred.reshape(-1), strips.shape[0]
    for k in range(first, end):
        strip = strips[k].reshape(-1)
        strip[:] = 0
        top = k * height // count
        for y in range(top, (k + 1) * height // count):
            _scatter_row(y, top, strip, flat, data, far, room, sizes)
