"""
What each pixel sees at each instant of the exposure, so that near things hide far ones.

Notation as in blur.py: N instants t_i, w inverse depth [1/m], flow a + w b over the exposure. The
kernels take rows of whole blocks (sweep.py), W' pixels for W.
"""

from __future__ import annotations

from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, Motion
from depth_deblur_ros.core.lanes import whole_blocks
from depth_deblur_ros.core.threads import on_threads, SHARED
from numba import njit
import numpy as np

MIN_INVERSE_DEPTH = 1e-4  # 1/m; beyond 10 km nothing moves
ROW = 8  # numbers that `flow_rows` gives of each row
LEAST_GROWTH = 0.1  # a surface that comes closer than this share of its depth counts as there


def seen_inverse_depth(
    motion: Motion, depth: FloatImage, camera: CameraIntrinsics, samples: int
) -> FloatImage:
    """Give w_i (H, W, samples) [1/m]: what each pixel sees at each instant, (4)."""
    ray, packed = pack(motion, camera)
    flow = flow_rows(ray, packed, depth.shape)
    planes = seen_planes(nearness_of(depth), ray, packed, flow, samples)
    return seen_by_pixel(planes, depth.shape[1])


def seen_by_pixel(planes: FloatImage, width: int) -> FloatImage:
    """Look at planes (H, samples, W') as (H, W, samples)."""
    return np.moveaxis(planes[..., :width], 1, 2)


def seen_planes(
    nearness: FloatImage, ray: FloatImage, packed: FloatImage, flow: FloatImage, samples: int
) -> FloatImage:
    """Give w_i (H, samples, W'), beyond W as at its rim; ray, packed and flow as below."""
    width = len(flow) - ROW * len(nearness)
    seen = np.empty((len(nearness), samples, width), np.float32)
    on_threads(_see, samples, nearness, ray, packed, flow, seen)
    return seen


def nearness_of(depth: FloatImage) -> FloatImage:
    """Give the inverse depth [1/m] of depth [m]."""
    return np.maximum(1 / depth, np.float32(MIN_INVERSE_DEPTH)).astype(np.float32)


def pack(motion: Motion, camera: CameraIntrinsics) -> tuple[FloatImage, FloatImage]:
    """Give the rays (W + H,), xn and yn, and (theta, v, fx, fy, rolling) (11,), float32."""
    cols = (np.arange(camera.width) - camera.cx) / camera.fx
    rows = (np.arange(camera.height) - camera.cy) / camera.fy
    ray = np.concatenate([cols, rows]).astype(np.float32)
    focal = [camera.fx, camera.fy]
    return ray, np.concatenate([motion.vector, focal, motion.rolling]).astype(np.float32)


def flow_rows(ray: FloatImage, motion: FloatImage, shape: tuple[int, int]) -> FloatImage:
    """
    Give the flow a + w b, (3), by what it takes to calculate it: (W' + 8 H,).

    xn of the columns, its rim beyond; then of each row what makes, with xn^0, xn^1, ...: a_x
    (three), a_y (two) [px], b_x (two), b_y (one) [px m].
    """
    height, width = shape
    xn = np.pad(ray[:width], (0, whole_blocks(width) - width), 'edge')
    yn = ray[width:]
    tx, ty, tz = motion[:3, None] + motion[8:, None] * yn
    vx, vy, vz, fx, fy = motion[3:8]
    rows = np.empty((height, ROW), np.float32)
    rows[:, 0], rows[:, 1], rows[:, 2] = fx * (ty - tz * yn), -fx * tx * yn, fx * ty
    rows[:, 3], rows[:, 4] = -fy * (1 + yn * yn) * tx, fy * (ty * yn + tz)
    rows[:, 5], rows[:, 6], rows[:, 7] = fx * vx, -fx * vz, fy * (vy - yn * vz)
    return np.concatenate([xn, rows.ravel()])


@njit(**SHARED)
def _see(first, end, nearness, ray, motion, flow, seen):  # type: ignore[no-untyped-def]
    """Warp the inverse depth (H, W) to some instants; seen (H, N, W or more) is written."""
    height, width = nearness.shape
    samples, one = seen.shape[1], np.uintp(1)
    places, values = np.empty(width, np.int32), np.empty(width, np.float32)
    across = np.empty(width, np.float32)
    for x in range(width):
        across[x] = x + 1
    # Cell (y, x) of the four pixels from (y - 1, x - 1) on: its nearest surface.
    cells = np.empty((height + 1, width + 1), np.float32)
    view = np.empty((height, width), np.float32)
    for i in range(first, end):
        t = np.float32((i + 0.5) / samples - 0.5)
        cells[:] = 0
        for y in range(height):
            _place_row(y, t, nearness, ray, motion, flow, across, places, values)
            _mark(places, values, cells.reshape(-1))
        for y in range(height):
            above, below, own = cells[y], cells[y + 1], view[y]
            for x in range(np.uintp(0), np.uintp(width)):
                own[x] = max(above[x], above[x + one], below[x], below[x + one])
        _fill_uncovered(view, nearness)
        for y in range(height):
            # Not by slices: what would say that they do not fit takes a second to compile.
            own, out = view[y], seen[y, i]
            for x in range(np.uintp(0), np.uintp(width)):
                out[x] = own[x]
            for x in range(np.uintp(width), np.uintp(len(out))):
                out[x] = own[width - 1]


@njit(cache=True, nogil=True, inline='always')
def _place_row(y, t, nearness, ray, motion, flow, across, places, values):  # type: ignore[no-untyped-def]
    """Say for each point of a row in which cell, 0 if in none, and how near it comes to stand."""
    height, width = nearness.shape
    high, wide = np.float32(height + 1), np.float32(width + 1)
    one, least, zero = np.float32(1), np.float32(LEAST_GROWTH), np.float32(0)
    roll, row = one + t * motion[0] * ray[width + y], np.float32(y + 1)
    near, m = nearness[y], flow[len(flow) - ROW * (height - y) :]
    ax, ax1, ax2, ay, ay1, bx, bx1, by = m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7]
    for x in range(np.uintp(0), np.uintp(width)):
        w, xn = near[x], ray[x]
        growth = roll + t * (motion[5] * w - motion[1] * xn)
        px = across[x] + t * (ax + xn * (ax1 + xn * ax2) + w * (bx + xn * bx1))
        py = row + t * (ay + xn * ay1 + w * by)
        inside = (px >= zero) & (px < wide) & (py >= zero) & (py < high)
        place = np.int32(py) * np.int32(width + 1) + np.int32(px)
        places[x] = place if inside else np.int32(0)
        values[x] = w / max(growth, least) if inside else zero


@njit(cache=True, nogil=True, inline='always')
def _mark(places, values, cells):  # type: ignore[no-untyped-def]
    """Leave in each cell the nearest of the points there."""
    for k in range(len(places)):
        place = np.uint32(places[k])
        cells[place] = max(cells[place], values[k])


@njit(cache=True, nogil=True, inline='always')
def _fill_uncovered(view, nearness):  # type: ignore[no-untyped-def]
    """Give uncovered pixels (0) the farther of their row's next surfaces, if there are any."""
    height, width = view.shape
    for y in range(height):
        own, x, left = view[y], 0, 0
        for k in range(np.uintp(0), np.uintp(width)):
            left += own[k] == 0
        while left:
            if own[x] > 0:
                x += 1
                continue
            end = x
            while end < width and own[end] == 0:
                end += 1
            before = own[x - 1] if x > 0 else np.float32(np.inf)
            beyond = own[end] if end < width else np.float32(np.inf)
            far = min(before, beyond)
            for k in range(x, end):
                own[k] = far if far < np.inf else nearness[y, k]
            left, x = left - (end - x), end
