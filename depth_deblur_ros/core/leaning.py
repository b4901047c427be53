"""
How a blurred image changes with the motion, sixteen pixels at a time.

Notation as in sweep.py; t_i the instants, w_i what is seen at them, J the interaction matrix:

    d(A L)(x) / dp = -1/N sum_i t_i dL(x - t_i F_i(x)) J_i(x)

dL is the slope of the bilinear interpolation itself, as in motion.py, which is the slow twin.
"""

from __future__ import annotations

from depth_deblur_ros.core.blur import BlurOperator
from depth_deblur_ros.core.data import FloatImage
from depth_deblur_ros.core.instants import aim, apart, back_at, flow_at, MANY
from depth_deblur_ros.core.lanes import (
    load,
    load_whole,
    splat,
    store,
    tent,
    total,
    where_positive,
    WIDTH,
)
from depth_deblur_ros.core.sweep import Sweep
from depth_deblur_ros.core.threads import on_threads, SHARED
from numba import njit
import numpy as np


def lean(
    blur: BlurOperator, sweep: Sweep, latent: FloatImage, data: FloatImage, weight: FloatImage
) -> tuple[FloatImage, FloatImage]:
    """
    Give the slope of the first plane of A L in p (6, H, W'), and a force of each row (H, 6).

    sweep: A of blur, thinned or not; latent (3, h, w); the force: <slope, weight (A L - data)>
    over all planes, data and weight (3, H, W').
    """
    layout, rows = sweep.layout, data.shape[1]
    own, force = np.empty((6, *data.shape[1:]), np.float32), np.empty((rows, 6), np.float32)
    told = layout.nearness, layout.flow, layout.shares, layout.cells
    ray = np.ascontiguousarray(blur.ray[-rows:])
    frame = ray, blur.motion[6:8], sweep.far, layout.unit
    on_threads(_lean_rows, rows, latent, data, weight, told, frame, sweep.room, own, force)
    return own, force


@njit(cache=True, nogil=True)
def _rise(d):  # type: ignore[no-untyped-def]
    """Give the slope of tent(u - m) in u at d = u - m; where two meet, that of the right side."""
    zero, one = splat(np.float32(0)), splat(np.float32(1))
    left = where_positive(zero - one - d, zero, one)
    return where_positive(zero - d, left, where_positive(one - d, zero - one, zero))


@njit(cache=True, nogil=True)
def _in_cell(latent, p, wide, u, v):  # type: ignore[no-untyped-def]
    """Give value and slopes where all pixels of a block read in one cell."""
    above, below = load(latent, p), load(latent, p + wide)
    top, low = load(latent, p + 1) - above, load(latent, p + wide + 1) - below
    down = below + u * low - above - u * top
    return above + u * top + v * down, top + v * (low - top), down


@njit(cache=True, nogil=True)
def _in_cells(latent, p, plane, wide, place):  # type: ignore[no-untyped-def]
    """Give value and slopes of the three planes where they read in a few."""
    u, v, columns, rows = place
    none = splat(np.float32(0))
    r = g = b = (none, none, none)
    for j in range(rows):
        y = v - splat(np.float32(j))
        for m in range(columns):
            x, q = u - splat(np.float32(m)), p + j * wide + m
            w = tent(y) * tent(x), tent(y) * _rise(x), _rise(y) * tent(x)
            r = _mixed(r, w, load(latent, q))
            g = _mixed(g, w, load(latent, q + plane))
            b = _mixed(b, w, load(latent, q + 2 * plane))
    return r, g, b


@njit(cache=True, nogil=True)
def _mixed(seen, weights, here):  # type: ignore[no-untyped-def]
    return seen[0] + weights[0] * here, seen[1] + weights[1] * here, seen[2] + weights[2] * here


@njit(cache=True, nogil=True)
def _each(latent, p, wide, places):  # type: ignore[no-untyped-def]
    """Give value and slopes where pixels read each by itself; places: u, v, then the results."""
    for k in range(WIDTH):
        u, v = places[k], places[WIDTH + k]
        x, y = np.floor(u), np.floor(v)
        q, u, v = p + k + np.intp(y) * wide + np.intp(x), u - x, v - y
        top, low = latent[q + 1] - latent[q], latent[q + wide + 1] - latent[q + wide]
        down = latent[q + wide] + u * low - latent[q] - u * top
        places[2 * WIDTH + k] = latent[q] + u * top + v * down
        places[3 * WIDTH + k] = top + v * (low - top)
        places[4 * WIDTH + k] = down
    return load(places, 2 * WIDTH), load(places, 3 * WIDTH), load(places, 4 * WIDTH)


@njit(cache=True, nogil=True)
def _added(sums, seen, share, back, w):  # type: ignore[no-untyped-def]
    """Add what one instant shows of a plane: value, then each slope times -t and -t w."""
    value, across, down = seen
    x, y = back * across, back * down
    return (
        sums[0] + share * value,
        sums[1] + x,
        sums[2] + w * x,
        sums[3] + y,
        sums[4] + w * y,
    )


@njit(cache=True, nogil=True)
def _slopes(sums, xn, yn, focal, unit):  # type: ignore[no-untyped-def]
    """Give the slope in p of a block, (3)."""
    one, fx, fy = splat(np.float32(1)), splat(focal[0]), splat(focal[1])
    gx, hx, gy, hy = fx * sums[1], fx * unit * sums[2], fy * sums[3], fy * unit * sums[4]
    zero = one - one
    turn = zero - xn * yn * gx - (one + yn * yn) * gy, (one + xn * xn) * gx + xn * yn * gy
    return *turn, xn * gy - yn * gx, hx, hy, zero - xn * hx - yn * hy


@njit(cache=True, nogil=True)
def _block(y, k, latent, told, sizes, far, places):  # type: ignore[no-untyped-def]
    """Give what `_added` adds up of each plane of a block."""
    nearness, flow, shares, _ = told
    width, samples, plane, wide, room = sizes
    one, none = shares[y * (width // WIDTH) + k], splat(np.float32(0))
    parts, start = flow_at(y, k, flow, width), (y * (width // WIDTH) + k) * samples
    r = g = b = (none, none, none, none, none)
    for i in range(samples):
        if back_at(i, one) < np.float32(-0.5):
            break
        u, v, left, top, columns, rows = aim((y, k, samples, width), i, one, parts, told)
        w, share = load_whole(nearness, (start + i) * WIDTH), splat(one)
        back = splat(one * back_at(i, one))
        p = (y + room + top) * wide + k * WIDTH + room + left
        if columns == 2 and rows == 2:
            r = _added(r, _in_cell(latent, p, wide, u, v), share, back, w)
            g = _added(g, _in_cell(latent, p + plane, wide, u, v), share, back, w)
            b = _added(b, _in_cell(latent, p + 2 * plane, wide, u, v), share, back, w)
        elif columns * rows <= MANY:
            seen = _in_cells(latent, p, plane, wide, (u, v, columns, rows))
            r = _added(r, seen[0], share, back, w)
            g = _added(g, seen[1], share, back, w)
            b = _added(b, seen[2], share, back, w)
        else:
            apart(places, u, v, left, top, far)
            r = _added(r, _each(latent, p, wide, places), share, back, w)
            g = _added(g, _each(latent, p + plane, wide, places), share, back, w)
            b = _added(b, _each(latent, p + 2 * plane, wide, places), share, back, w)
    return r, g, b


@njit(cache=True, nogil=True)
def _pushed(push, slopes, value, at, data, weight):  # type: ignore[no-untyped-def]
    """Add what a plane of a block pushes."""
    missing = load(weight, at) * (value - load(data, at))
    return (
        push[0] + slopes[0] * missing,
        push[1] + slopes[1] * missing,
        push[2] + slopes[2] * missing,
        push[3] + slopes[3] * missing,
        push[4] + slopes[4] * missing,
        push[5] + slopes[5] * missing,
    )


@njit(cache=True, nogil=True)
def _lean_row(y, latent, data, weight, told, frame, sizes, own, force):  # type: ignore[no-untyped-def]
    ray, focal, far, unit = frame
    width, colour = sizes[0], own.size // 6
    places, none = np.empty(5 * WIDTH, np.float32), splat(np.float32(0))
    push = (none, none, none, none, none, none)
    yn, of_unit = splat(ray[y]), splat(unit)
    for k in range(width // WIDTH):
        r, g, b = _block(y, k, latent, told, sizes, far, places)
        at, xn = y * width + k * WIDTH, load(told[1], k * WIDTH)
        slopes = _slopes(r, xn, yn, focal, of_unit)
        for j in range(6):
            store(own, j * colour + at, slopes[j])
        push = _pushed(push, slopes, r[0], at, data, weight)
        slopes = _slopes(g, xn, yn, focal, of_unit)
        push = _pushed(push, slopes, g[0], at + colour, data, weight)
        slopes = _slopes(b, xn, yn, focal, of_unit)
        push = _pushed(push, slopes, b[0], at + 2 * colour, data, weight)
    for j in range(6):
        force[y, j] = total(push[j], places)


@njit(**SHARED)
def _lean_rows(first, end, latent, data, weight, layout, frame, room, own, force):  # type: ignore[no-untyped-def]
    nearness, flow, shares, cells = layout
    _, blocks, samples, _ = nearness.shape
    told = nearness.reshape(-1), flow, shares.reshape(-1), cells.reshape(-1)
    sizes = blocks * WIDTH, samples, latent[0].size, latent.shape[2], room
    planes = latent.reshape(-1), data.reshape(-1), weight.reshape(-1)
    for y in range(first, end):
        _lean_row(y, *planes, told, frame, sizes, own.reshape(-1), force)
