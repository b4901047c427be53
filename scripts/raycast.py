"""
Exact ray casting of rectangles and spheres, in compiled loops.

Notation: c (3,) the eye in the world [m]; d (3,) a ray with length 1 along the camera's z, so that
a hit at c + t d has depth t. Rectangle row: corner (3), unit u (3), unit v (3), normal (3), size
along u and v [m]. Sphere row: centre (3), radius [m]. Material row, rectangles first: texture,
tile [m], tint (3), shine.
"""

from __future__ import annotations

import math
from typing import Any

from numba import njit, prange
import numpy as np
import numpy.typing as npt
from textures import SIDE

Array = npt.NDArray[np.float64]
Light = npt.NDArray[np.float32]
Ids = npt.NDArray[np.int64]
Ray = tuple[float, float, float]
Lens = tuple[float, float, float, float]  # fx, fy, cx, cy
World = tuple[Array, Array, Array, Array, Light]

AMBIENT = 0.42
TOP_LEVEL = SIDE.bit_length() - 1
SUBPIXELS = 2  # rays per pixel and axis
TILE = 32  # px
NEAR = 0.02  # m

_compiled = njit(cache=True, error_model='numpy')
_compiled_parallel = njit(cache=True, error_model='numpy', nogil=True, parallel=True)


@_compiled
def _nearest(
    rects: Array, spheres: Array, candidates: Ids, c: Array, d: tuple[float, float, float]
) -> tuple[float, int]:
    """Give depth and number of the first candidate along a ray; inf and -1 for none."""
    best, which = math.inf, -1
    dx, dy, dz = d
    norm2 = dx * dx + dy * dy + dz * dz
    for k in candidates:
        if k < rects.shape[0]:
            slope = rects[k, 9] * dx + rects[k, 10] * dy + rects[k, 11] * dz
            if slope >= 0:  # seen from behind
                continue
            ox, oy, oz = rects[k, 0] - c[0], rects[k, 1] - c[1], rects[k, 2] - c[2]
            t = (rects[k, 9] * ox + rects[k, 10] * oy + rects[k, 11] * oz) / slope
            if 1e-6 < t < best:
                x, y, z = t * dx - ox, t * dy - oy, t * dz - oz
                u = rects[k, 3] * x + rects[k, 4] * y + rects[k, 5] * z
                v = rects[k, 6] * x + rects[k, 7] * y + rects[k, 8] * z
                if 0 <= u <= rects[k, 12] and 0 <= v <= rects[k, 13]:
                    best, which = t, k
            continue
        i = k - rects.shape[0]
        ox, oy, oz = spheres[i, 0] - c[0], spheres[i, 1] - c[1], spheres[i, 2] - c[2]
        along = dx * ox + dy * oy + dz * oz
        square = along * along - norm2 * (ox * ox + oy * oy + oz * oz - spheres[i, 3] ** 2)
        if square > 0:
            t = (along - math.sqrt(square)) / norm2
            if 1e-6 < t < best:
                best, which = t, k
    return best, which


@_compiled
def _surface(
    rects: Array, spheres: Array, which: int, point: Ray
) -> tuple[float, float, float, float, float]:
    """Give the normal and the texture coordinates [m] of a point on a surface."""
    x, y, z = point
    if which < rects.shape[0]:
        r = rects[which]
        x, y, z = x - r[0], y - r[1], z - r[2]
        u, v = r[3] * x + r[4] * y + r[5] * z, r[6] * x + r[7] * y + r[8] * z
        return r[9], r[10], r[11], u, v
    s = spheres[which - rects.shape[0]]
    nx, ny, nz = (x - s[0]) / s[3], (y - s[1]) / s[3], (z - s[2]) / s[3]
    u = s[3] * (math.pi + math.atan2(nx, -nz))
    v = s[3] * (math.pi / 2 + math.asin(min(1.0, max(-1.0, ny))))
    return nx, ny, nz, u, v


@_compiled
def _texel(pool: Light, texture: int, level: int, u: float, v: float) -> Ray:
    """Look a texture up at u, v in tiles, between the four texels around it; it wraps."""
    side = SIDE >> level
    first = (4 * SIDE * SIDE - 4 * side * side) // 3
    x, y = u * side - 0.5, v * side - 0.5
    i, j = math.floor(x), math.floor(y)
    a, b = x - i, y - j
    i0, i1 = i & (side - 1), (i + 1) & (side - 1)
    j0, j1 = first + (j & (side - 1)) * side, first + ((j + 1) & (side - 1)) * side
    p, q, r, s = (1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b
    n, m, k, h = j0 + i0, j0 + i1, j1 + i0, j1 + i1
    t = pool[texture]
    return (
        p * t[n, 0] + q * t[m, 0] + r * t[k, 0] + s * t[h, 0],
        p * t[n, 1] + q * t[m, 1] + r * t[k, 1] + s * t[h, 1],
        p * t[n, 2] + q * t[m, 2] + r * t[k, 2] + s * t[h, 2],
    )


@_compiled
def _brightness(lamps: Array, point: Ray, n: Ray) -> float:
    """Add up the light of the lamps (position, power) on a matt surface with normal n."""
    total = AMBIENT
    x, y, z = point
    for k in range(lamps.shape[0]):
        lx, ly, lz = lamps[k, 0] - x, lamps[k, 1] - y, lamps[k, 2] - z
        distance2 = lx * lx + ly * ly + lz * lz
        cosine = (lx * n[0] + ly * n[1] + lz * n[2]) / math.sqrt(distance2)
        total += lamps[k, 3] * max(0.0, cosine) / (1 + distance2)
    return total


@_compiled
def _add_light(world: World, candidates: Ids, ray: tuple[Array, Ray, float], out: Light) -> None:
    """Add to out (3,) what a ray (eye, direction, angle to the next ray [rad]) brings back."""
    c, d, pitch = ray
    rects, spheres, materials, lamps, pool = world
    t, which = _nearest(rects, spheres, candidates, c, d)
    if which < 0:
        return
    x, y, z = c[0] + t * d[0], c[1] + t * d[1], c[2] + t * d[2]
    nx, ny, nz, u, v = _surface(rects, spheres, which, (x, y, z))
    texture, tile = int(materials[which, 0]), materials[which, 1]
    length = math.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)
    cosine = -(nx * d[0] + ny * d[1] + nz * d[2]) / length
    # How far apart two rays hit the surface along its steepest direction, in texels.
    step = t * pitch / max(cosine, 0.05) / tile * SIDE
    level = min(max(math.log2(step), 0.0), TOP_LEVEL - 1e-6)
    whole = int(level)
    part = level - whole
    light = _brightness(lamps, (x, y, z), (nx, ny, nz))
    near = _texel(pool, texture, whole, u / tile, v / tile)
    far = _texel(pool, texture, whole + 1, u / tile, v / tile)
    for k in range(3):
        out[k] += light * materials[which, 2 + k] * (near[k] + part * (far[k] - near[k]))


@_compiled
def _ray(m: Array, xn: float, yn: float) -> Ray:
    """Turn the ray (xn, yn, 1) of the camera into the world."""
    return (
        m[0, 0] * xn + m[0, 1] * yn + m[0, 2],
        m[1, 0] * xn + m[1, 1] * yn + m[1, 2],
        m[2, 0] * xn + m[2, 1] * yn + m[2, 2],
    )


@_compiled
def _within(bounds: Array, x: int, y: int) -> Ids:
    """List the surfaces whose bounds meet the tile that begins at pixel x, y."""
    meets = (
        (bounds[:, 0] <= x + TILE)
        & (bounds[:, 1] >= x - 1)
        & (bounds[:, 2] <= y + TILE)
        & (bounds[:, 3] >= y - 1)
    )
    return np.nonzero(meets)[0]


@_compiled_parallel
def colour_rays(
    world: World, bounds: Array, pose: tuple[Array, Array], lens: Lens, out: Light
) -> None:
    """
    Fill out (H, W, 3), zero before, with the linear light of each pixel, SUBPIXELS^2 rays each.

    world: rects, spheres, materials, lamps, texture pool (n, texels, 3); pose: rotation, centre;
    bounds (n, 4): see image_bounds.
    """
    (m, c), (fx, fy, cx, cy) = pose, lens
    across = (out.shape[1] + TILE - 1) // TILE
    for tile in prange(across * ((out.shape[0] + TILE - 1) // TILE)):
        top, left = tile // across * TILE, tile % across * TILE
        candidates = _within(bounds, left, top)
        for y in range(top, min(top + TILE, out.shape[0])):
            for x in range(left, min(left + TILE, out.shape[1])):
                for k in range(SUBPIXELS**2):
                    xn = (x + (k % SUBPIXELS + 0.5) / SUBPIXELS - 0.5 - cx) / fx
                    yn = (y + (k // SUBPIXELS + 0.5) / SUBPIXELS - 0.5 - cy) / fy
                    d = _ray(m, xn, yn)
                    _add_light(world, candidates, (c, d, 1 / (fx * SUBPIXELS)), out[y, x])
    out /= SUBPIXELS**2


@_compiled_parallel
def depth_rays(
    surfaces: tuple[Array, Array, Array],
    pose: tuple[Array, Array],
    lens: Lens,
    projector: Array,
    out: tuple[Array, Array, Array, npt.NDArray[np.bool_]],
) -> None:
    """
    Fill out = depth [m], cosine of incidence, shine, lit; (H, W) each, a ray through each pixel.

    surfaces: rects, spheres, materials; lit: a projector at that place in the world sees the point
    too. depth keeps what it was where nothing is hit.
    """
    rects, spheres, materials = surfaces
    (m, c), (fx, fy, cx, cy) = pose, lens
    depth, incidence, shine, lit = out
    everything = np.arange(len(rects) + len(spheres))
    for row in prange(depth.shape[0]):
        for column in range(depth.shape[1]):
            d = _ray(m, (column - cx) / fx, (row - cy) / fy)
            t, which = _nearest(rects, spheres, everything, c, d)
            if which < 0:
                continue
            x, y, z = c[0] + t * d[0], c[1] + t * d[1], c[2] + t * d[2]
            nx, ny, nz, _, _ = _surface(rects, spheres, which, (x, y, z))
            length = math.sqrt(d[0] ** 2 + d[1] ** 2 + d[2] ** 2)
            depth[row, column] = t
            incidence[row, column] = -(nx * d[0] + ny * d[1] + nz * d[2]) / length
            shine[row, column] = materials[which, 5]
            beam = (x - projector[0], y - projector[1], z - projector[2])
            first, _ = _nearest(rects, spheres, everything, projector, beam)
            lit[row, column] = first > 0.995


def image_bounds(rects: Array, spheres: Array, pose: tuple[Array, Array], lens: Lens) -> Array:
    """Give bounds (n, 4) = x low, x high, y low, y high [px] of each surface in the image."""
    (m, c), (fx, fy, cx, cy) = pose, lens
    u, v = rects[:, 12:13] * rects[:, 3:6], rects[:, 13:14] * rects[:, 6:9]
    corner = rects[:, :3]
    flat = np.stack([corner, corner + u, corner + v, corner + u + v], 1)
    cube = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    round_ones = spheres[:, None, :3] + spheres[:, None, 3:4] * cube
    bounds = []
    for points in [*flat, *round_ones]:
        x, y, z = ((points - c) @ m).T
        if z.min() < NEAR:  # reaches behind the eye: it may be anywhere, or nowhere
            reach = np.inf if z.max() > 0 else -np.inf
            bounds.append((-reach, reach, -reach, reach))
            continue
        px, py = fx * x / z + cx, fy * y / z + cy
        bounds.append((px.min(), px.max(), py.min(), py.max()))
    return np.array(bounds)


def empty_light(height: int, width: int) -> Light:
    """Give a black image for colour_rays to fill."""
    return np.zeros((height, width, 3), np.float32)


def empty_depth(height: int, width: int) -> tuple[Array, Array, Array, npt.NDArray[Any]]:
    """Give the four arrays that depth_rays fills."""
    shape = (height, width)
    return np.full(shape, np.inf), np.zeros(shape), np.zeros(shape), np.zeros(shape, np.bool_)
