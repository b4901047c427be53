"""
The blur operator A of a known motion, and its exact adjoint.

Notation: L (h, w, 3) latent image on the frame's grid widened by `margin` pixels on every side,
because the blurred border shows what lies outside; B (H, W, 3) blurred image;
t_i = (i + 0.5) / N - 0.5 the N instants of the exposure; w = 1 / Z inverse depth [1/m].

    B(x) = 1/N sum_i L(x - t_i (a(x) + w_i(x) b(x))),    (5) of docs/method.md

where a + w b is the first-order flow of the motion (geometry.py) and w_i(x) the inverse depth of
the nearest surface that pixel x sees at t_i, so that near things hide far ones as they pass.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
import math

from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, Motion
from depth_deblur_ros.core.instants import flow_at
from depth_deblur_ros.core.lanes import greatest, larger, load, splat, whole_blocks, WIDTH
from depth_deblur_ros.core.seen import flow_rows, nearness_of, pack, seen_by_pixel, seen_planes
from depth_deblur_ros.core.sweep import Sweep, sweep_of
from depth_deblur_ros.core.threads import on_threads, SHARED, threads_here
from numba import njit
import numpy as np
import numpy.typing as npt

MIN_SAMPLES, MAX_SAMPLES = (
    8,
    128,
)  # instants of one exposure; one per pixel of the longest blur between
ROUNDING = 1e-3  # px; a blur that much longer than a whole number takes no further instant


@dataclass(frozen=True, eq=False)
class BlurOperator:
    """
    A of (motion, depth, camera): apply (h, w, 3) -> (H, W, 3) and adjoint back.

    float32 goes by blocks of pixels (sweep.py), float64 pixel by pixel.
    """

    ray: npt.NDArray[np.float32]  # (H + W, ) xn of the columns, then yn of the rows
    motion: npt.NDArray[np.float32]  # (11,): theta, v, fx, fy, rolling
    inverse_depth: FloatImage  # (H, W, N) seen at each instant [1/m]
    margin: int

    @property
    def _shape(self) -> tuple[int, int, int]:
        return *self.inverse_depth.shape[:2], 3

    @property
    def latent_shape(self) -> tuple[int, int, int]:
        """(h, w, 3) of the latent image."""
        height, width = self.inverse_depth.shape[:2]
        return height + 2 * self.margin, width + 2 * self.margin, 3

    @cached_property
    def sweep(self) -> Sweep:
        """A laid out for blocks of pixels of colour planes."""
        return self.thinned(0)

    def thinned(self, spacing: float, slack: float = 0.0) -> Sweep:
        """As `sweep`, but with a spacing and a slack, as `sweep_of` explains."""
        height, width = self.inverse_depth.shape[:2]
        seen = np.moveaxis(self.inverse_depth, 2, 1)
        if width < whole_blocks(width):
            seen = np.pad(seen, [(0, 0), (0, 0), (0, whole_blocks(width) - width)], 'edge')
        flow = flow_rows(self.ray, self.motion, (height, width))
        return sweep_of(np.ascontiguousarray(seen), flow, self.margin, spacing, slack)

    def apply(self, latent: FloatImage) -> FloatImage:
        """Blur: A L, (5) of docs/method.md."""
        if latent.dtype == np.float32:
            return self._apply_by_blocks(latent)
        blurred = np.empty((*self.inverse_depth.shape[:2], 3), latent.dtype)
        told = self.inverse_depth, self.ray, self.motion, self.margin
        on_threads(_gather, len(blurred), latent, *told, blurred)
        return blurred

    def adjoint(self, blurred: FloatImage) -> FloatImage:
        """Give A' B, so that <A L, B> = <L, A' B> to rounding."""
        if blurred.dtype == np.float32:
            return self._adjoint_by_blocks(blurred)
        rows = self.inverse_depth.shape[0]
        strips = min(threads_here(), rows)
        height, width, _ = self.latent_shape
        depth_of_strip = math.ceil(rows / strips) + 2 * self.margin
        parts = np.zeros((strips, depth_of_strip, width, 3), blurred.dtype)
        told = self.inverse_depth, self.ray, self.motion, self.margin
        on_threads(_scatter, strips, blurred, *told, parts)
        latent = np.zeros((height, width, 3), blurred.dtype)
        for k in range(strips):
            first = k * rows // strips
            last = min(first + depth_of_strip, height)
            latent[first:last] += parts[k, : last - first]
        return latent

    def widen(self, image: FloatImage) -> FloatImage:
        """Continue an image (H, W, ...) over the margin by its border pixels."""
        pad = [(self.margin, self.margin)] * 2 + [(0, 0)] * (image.ndim - 2)
        return np.pad(image, pad, 'edge')

    def crop(self, latent: FloatImage) -> FloatImage:
        """Cut a latent image back to the frame."""
        height, width = self.inverse_depth.shape[:2]
        m = self.margin
        return np.ascontiguousarray(latent[m : m + height, m : m + width])

    def _apply_by_blocks(self, latent: FloatImage) -> FloatImage:
        planes = np.zeros(self.sweep.latent_shape, np.float32)
        self.latent_part(planes)[:] = np.moveaxis(latent, 2, 0)
        one = self.sweep.blurred_planes(np.ones(self._shape, np.float32))
        blurred = self.sweep.gather(planes, one)
        return np.ascontiguousarray(np.moveaxis(blurred[..., : self._shape[1]], 0, 2))

    def _adjoint_by_blocks(self, blurred: FloatImage) -> FloatImage:
        planes = self.sweep.adjoint(self.sweep.blurred_planes(blurred))
        return np.ascontiguousarray(np.moveaxis(self.latent_part(planes), 0, 2))

    def latent_part(self, planes: FloatImage) -> FloatImage:
        """Look at the part of latent planes that this operator's latent image is."""
        height, width, _ = self.latent_shape
        first = self.sweep.room - self.margin
        return planes[:, first : first + height, first : first + width]


def blur_operator(
    motion: Motion, depth: FloatImage, camera: CameraIntrinsics, spacing: float = 1.0
) -> BlurOperator:
    """
    Build A for a motion over the exposure; depth (H, W) filled [m].

    spacing: px of the longest blur from one instant to the next, where the limits allow it.
    """
    ray, packed = pack(motion, camera)
    flow = flow_rows(ray, packed, depth.shape)
    near = nearness_of(depth)
    blocks = np.pad(near, [(0, 0), (0, whole_blocks(camera.width) - camera.width)], 'edge')
    longest = math.sqrt(_largest(blocks[:, None], flow)[2])
    least = math.ceil(MIN_SAMPLES / spacing)
    samples = int(np.clip(math.ceil(longest / spacing - ROUNDING), least, MAX_SAMPLES))
    seen = seen_planes(near, ray, packed, flow, samples)
    reach = max(_largest(seen, flow)[:2]) / 2
    margin = math.ceil(min(reach, max(camera.width, camera.height))) + 2  # 2: interpolation
    return BlurOperator(ray, packed, seen_by_pixel(seen, camera.width), margin)


def _largest(nearness: FloatImage, flow: FloatImage) -> tuple[float, float, float]:
    """Give the largest |x| [px], |y| [px] and squared length [px^2] of the flow, w (H, N, W)."""
    rows = np.empty((nearness.shape[0], 3), np.float32)
    on_threads(_largest_of_rows, len(rows), nearness, flow, rows)
    x, y, square = rows.max(axis=0).tolist()
    return x, y, square


@njit(**SHARED)
def _largest_of_rows(first, end, nearness, flow, rows):  # type: ignore[no-untyped-def]
    _, samples, width = nearness.shape
    near, parts = nearness.reshape(-1), flow.reshape(-1)
    for y in range(first, end):
        px = py = square = zero = splat(np.float32(0))
        for k in range(width // WIDTH):
            ax, ay, bx, by = flow_at(y, k, parts, width)
            for i in range(samples):
                w = load(near, (y * samples + i) * width + k * WIDTH)
                dx, dy = ax + w * bx, ay + w * by
                px, py = larger(px, larger(dx, zero - dx)), larger(py, larger(dy, zero - dy))
                square = larger(square, dx * dx + dy * dy)
        rows[y, 0], rows[y, 1], rows[y, 2] = greatest(px), greatest(py), greatest(square)


@njit(cache=True, nogil=True, inline='always')
def _flow_parts(x, y, ray, width, m):  # type: ignore[no-untyped-def]
    """Give a and b of the flow a + w b at a pixel, (3) of docs/method.md."""
    xn, yn = ray[x], ray[width + y]
    one = np.float32(1)
    tx, ty, tz = m[0] + yn * m[8], m[1] + yn * m[9], m[2] + yn * m[10]
    ax = m[6] * (-xn * yn * tx + (one + xn * xn) * ty - yn * tz)
    ay = m[7] * (-(one + yn * yn) * tx + xn * yn * ty + xn * tz)
    return ax, ay, m[6] * (m[3] - xn * m[5]), m[7] * (m[4] - yn * m[5])


@njit(cache=True, nogil=True, inline='always')
def _cell(cx, cy, dx, dy, far):  # type: ignore[no-untyped-def]
    """Give the cell at most far from (cx, cy), dx and dy before it, and its bilinear weights."""
    px, py = cx - min(max(dx, -far), far), cy - min(max(dy, -far), far)
    one = np.float32(1)
    x0, y0 = np.uint32(px), np.uint32(py)
    u, v = px - np.float32(x0), py - np.float32(y0)
    w11 = u * v
    w10, w01 = v - w11, u - w11
    return x0, y0, one - u - w10, w01, w10, w11


# Flat images and unsigned indices below: numba checks signed ones for negative values, which
# costs a third of the time.
@njit(fastmath=True, **SHARED)
def _gather(first, end, latent, seen, ray, motion, margin, blurred):  # type: ignore[no-untyped-def]
    _, width, samples = seen.shape
    wide = latent.shape[1]
    far = np.float32(margin - 1)  # what lies farther is taken from there
    flat = latent.reshape(-1)
    share, half = np.float32(1.0 / samples), np.float32(0.5)
    row, one, two, three = np.uint32(3 * wide), np.uint32(1), np.uint32(2), np.uint32(3)
    for y in range(first, end):
        for x in range(width):
            ax, ay, bx, by = _flow_parts(x, y, ray, width, motion)
            r = g = b = flat[0] * 0
            cx, cy = np.float32(x + margin), np.float32(y + margin)
            for i in range(samples):
                t = np.float32(i + half) * share - half
                near = seen[y, x, i]
                dx, dy = t * (ax + near * bx), t * (ay + near * by)
                x0, y0, w00, w01, w10, w11 = _cell(cx, cy, dx, dy, far)
                p = np.uint32(y0 * row + three * x0)
                q, n, m = np.uint32(p + row), np.uint32(p + three), np.uint32(p + row + three)
                r += w00 * flat[p] + w01 * flat[n] + w10 * flat[q] + w11 * flat[m]
                g += (
                    w00 * flat[p + one]
                    + w01 * flat[n + one]
                    + w10 * flat[q + one]
                    + w11 * flat[m + one]
                )
                b += (
                    w00 * flat[p + two]
                    + w01 * flat[n + two]
                    + w10 * flat[q + two]
                    + w11 * flat[m + two]
                )
            blurred[y, x, 0], blurred[y, x, 1], blurred[y, x, 2] = share * r, share * g, share * b


@njit(fastmath=True, **SHARED)
def _scatter(first, end, blurred, seen, ray, motion, margin, parts):  # type: ignore[no-untyped-def]
    """Spread each blurred pixel over what it read; strip k of rows writes to parts[k] alone."""
    height, width, samples = seen.shape
    strips, wide = parts.shape[0], parts.shape[2]
    far = np.float32(margin - 1)  # a strip ends there
    share, half = np.float32(1.0 / samples), np.float32(0.5)
    row, three = np.uint32(3 * wide), np.uint32(3)
    for k in range(first, end):
        top, bottom = k * height // strips, (k + 1) * height // strips
        flat = parts[k].reshape(-1)
        for y in range(top, bottom):
            for x in range(width):
                ax, ay, bx, by = _flow_parts(x, y, ray, width, motion)
                cx, cy = np.float32(x + margin), np.float32(y + margin)
                r, g, b = blurred[y, x, 0], blurred[y, x, 1], blurred[y, x, 2]
                spread = (share * r, share * g, share * b)
                for i in range(samples):
                    t = np.float32(i + half) * share - half
                    near = seen[y, x, i]
                    dx, dy = t * (ax + near * bx), t * (ay + near * by)
                    x0, y0, w00, w01, w10, w11 = _cell(cx, cy, dx, dy, far)
                    p = np.uint32((y0 - np.uint32(top)) * row + three * x0)
                    for c in range(3):
                        j = np.uint32(p + np.uint32(c))
                        flat[j] += w00 * spread[c]
                        flat[j + three] += w01 * spread[c]
                        flat[j + row] += w10 * spread[c]
                        flat[j + row + three] += w11 * spread[c]
