"""
The sharp image when the motion is known.

Notation: L latent light, B blurred light, A the blur (blur.py), u = stored values of L, l' slope
of the transfer (light.py), sigma noise of the stored values, d(u) differences to the eight
neighbours. Minimises, (7) of docs/method.md,

    1/2 |A L - B|^2_W + c sigma^2 sum (|d u|^2 + eps^2)^(alpha / 2),   W = 1 / l'(B)^2,

with differences of the three channels taken together, by iteratively reweighted least squares:
each step solves a quadratic problem by conjugate gradients, preconditioned with l'^2. Noise is
even in stored values, not in light, so both the data and the prior are weighted by the slope.
[KF09] Krishnan & Fergus, NIPS 2009: the hyper-Laplacian prior. [IRLS] Levin et al., SIGGRAPH 2007.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import cv2
from depth_deblur_ros.core.blur import blur_operator, BlurOperator
from depth_deblur_ros.core.compression import block_sigma
from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, MIN_SIDE, Motion
from depth_deblur_ros.core.lanes import load, smaller, splat, store, total, WIDTH
from depth_deblur_ros.core.light import light_from_stored, light_slope, stored_from_light
from depth_deblur_ros.core.sweep import GUARD, Sweep
from numba import njit, prange
import numpy as np

SATURATED = 0.99  # stored values above may stand for any amount of light
EPSILON = 0.01  # stored units; differences below this count as noise
EXPONENT = 0.8  # alpha of the prior [KF09]
SPACING = 1.5  # px of the longest blur between two instants of the exposure
COARSE_OUTER, COARSE_LONGER = 2, 1.5  # reweightings at half the size, and how much longer each
CLEAN = 0.003  # sigma [stored units] up to which all steps are worth it
# Least sigma [stored units]: 8 bit rounding for averaged values; real cameras hide their noise
# from the estimate by demosaicing, and lens and shutter leave more unexplained.
SIGMA_FLOOR = {'linear': 0.0025, 'srgb': 0.012}


@dataclass(frozen=True)
class LatentSteps:
    """How long and how smooth: prior weight c, reweightings, conjugate gradient steps in each."""

    prior: float
    outer: int
    inner: int


def noise_sigma(stored: FloatImage) -> float:
    """
    Estimate the noise [stored units] of a blurred image (H, W, 3), from its flattest fifth.

    Second differences across both axes remove planes; motion blur leaves little else in flat
    parts.
    """
    s = stored.reshape(*stored.shape[:2], -1)
    d = s[1:] - s[:-1]
    d = d[:, 1:] - d[:, :-1]
    d = (d[1:, 1:] - d[:-1, 1:]) - (d[1:, :-1] - d[:-1, :-1])
    height, width = (n // 8 * 8 for n in d.shape[:2])
    blocks = d[:height, :width].reshape(height // 8, 8, width // 8, 8, -1)
    power = np.square(blocks).mean(axis=(1, 3, 4))
    # The mask (1 -2 1)' (1 -2 1) has a sum of squares of 36.
    return float(np.sqrt(np.percentile(power, 20) / 36))


def restore_coarse_to_fine(
    blurred: FloatImage,
    depth: FloatImage,
    motion: Motion,
    camera: CameraIntrinsics,
    steps: LatentSteps,
) -> FloatImage:
    """
    Give the sharp image (H, W, 3), stored values, under a known motion; depth (H, W) filled [m].

    At half the size an eighth of the work brings most of what is long and slow to converge, and
    so on. Noise makes the prior weigh more, which takes fewer steps.
    """
    sigma = math.hypot(noise_sigma(blurred), block_sigma(blurred))
    worth = math.sqrt(CLEAN / max(CLEAN, sigma, SIGMA_FLOOR[camera.transfer]))
    steps = replace(steps, inner=math.ceil(worth * steps.inner))
    light = _restored(blurred, depth, motion, camera, (sigma, steps))
    return stored_from_light(light, camera.transfer)


def _restored(
    blurred: FloatImage,
    depth: FloatImage,
    motion: Motion,
    camera: CameraIntrinsics,
    effort: tuple[float, LatentSteps],
) -> FloatImage:
    """Restore light from that of half the size, as long as there is one; effort: noise, steps."""
    first, (sigma, steps) = None, effort
    width, height = camera.width // 2, camera.height // 2
    if min(width, height) >= MIN_SIDE:
        small = _resized(blurred, width, height, cv2.INTER_AREA)
        near = _resized(depth, width, height, cv2.INTER_NEAREST)
        coarse = LatentSteps(steps.prior, COARSE_OUTER, round(COARSE_LONGER * steps.inner))
        # Four pixels in one: half the noise.
        half = _restored(small, near, motion, camera.scaled(width, height), (sigma / 2, coarse))
        first = _magnified(half, camera)
    blur = blur_operator(motion, depth, camera, SPACING)
    return restored_light(blurred, blur, camera.transfer, sigma, steps, first=first)


def _magnified(light: FloatImage, camera: CameraIntrinsics) -> FloatImage:
    """Give light at a camera's size; what is brighter than can be stored stays so."""
    size, transfer = (camera.width, camera.height), camera.transfer
    stored = _resized(stored_from_light(light, transfer), *size, cv2.INTER_CUBIC)
    within = light_from_stored(np.clip(stored, 0, 1), transfer)
    beyond = np.maximum(light - 1, 0)
    return within + _resized(beyond, *size, cv2.INTER_LINEAR) if beyond.any() else within


def _resized(image: FloatImage, width: int, height: int, how: int) -> FloatImage:
    return np.asarray(cv2.resize(image, (width, height), interpolation=how), np.float32)


def restored_light(
    blurred: FloatImage,
    blur: BlurOperator,
    transfer: str,
    sigma: float,
    steps: LatentSteps,
    *,
    first: FloatImage | None = None,
) -> FloatImage:
    """
    Give the sharp light (H, W, 3) of stored values under a known blur; first: a guess.

    Where blurred values are saturated it may exceed 1.
    """
    sweep, (height, width) = blur.sweep, blurred.shape[:2]
    stored = sweep.blurred_planes(blurred)
    light = light_from_stored(stored, transfer)
    full, noise = stored >= SATURATED, 1 / np.square(light_slope(stored, transfer))
    noise[:, :, width:] = 0
    start = light[:, :, :width] if first is None else np.moveaxis(first, 2, 0)
    latent = sweep.widened(start)
    within = sweep.blurred_planes(np.ones_like(blurred))
    weight = np.float32(steps.prior * max(sigma, SIGMA_FLOOR[transfer]) ** 2)
    for _ in range(steps.outer):
        missing = light - sweep.gather(latent, within)
        # What is saturated says only "at least this": drop it where the model gives more.
        trust = np.where(full & (missing <= 0), np.float32(0), noise)
        problem = reweighted(stored_from_light(latent, transfer), sweep, transfer, trust, weight)
        latent = conjugate_gradients(problem, latent, problem.slope(missing, latent), steps.inner)
    r = sweep.room
    return np.ascontiguousarray(np.moveaxis(latent[:, r : r + height, r : r + width], 0, 2))


@dataclass(frozen=True, eq=False)
class Quadratic:
    """
    (7) with the weights of one reweighting: 1/2 |A L - B|^2_trust + 1/2 <L, links L>.

    In planes, as sweep.py lays them out: blurred (3, H, W'), latent (3, h, w).
    """

    sweep: Sweep
    trust: FloatImage  # (3, H, W')
    links: FloatImage  # (4, h, w) weights to the neighbours right, below, below right, below left
    ease: FloatImage  # (3, h, w) 1 / l'^2

    def slope(self, missing: FloatImage, latent: FloatImage) -> FloatImage:
        """Give minus the gradient at a latent image; missing = B - A latent."""
        strips, r = self.sweep.strips(), np.zeros_like(latent)
        self.sweep.scatter(self.trust * missing, strips)
        self._sum(strips, -latent, r)
        return r

    def normal(self, d: FloatImage, strips: FloatImage, q: FloatImage) -> float:
        """Write the normal equations' matrix times d into q; give <d, q>."""
        self.sweep.scatter(self.sweep.gather(d, self.trust), strips)
        return self._sum(strips, d, q)

    def _sum(self, strips: FloatImage, x: FloatImage, out: FloatImage) -> float:
        """Add strips of A' and the prior's part of x; give <x, out>."""
        products = np.zeros(x.shape[1:2], np.float32)
        rows = self.trust.shape[1]
        _sum_rows(strips, rows, x, self.links, self.ease, out, products)
        return float(products.sum(dtype=np.float64))


def reweighted(
    stored: FloatImage, sweep: Sweep, transfer: str, trust: FloatImage, weight: np.float32
) -> Quadratic:
    """Put the weights of (7) at the present image, stored values in latent planes (3, h, w)."""
    links = np.zeros((4, *stored.shape[1:]), np.float32)
    _link_weights(stored, weight, _POWERS, links)
    ease = (1 / np.square(light_slope(stored, transfer))).astype(np.float32)
    return Quadratic(sweep, trust, links, ease)


def conjugate_gradients(
    problem: Quadratic, latent: FloatImage, slope: FloatImage, limit: int
) -> FloatImage:
    """Solve from latent by `limit` steps, preconditioned with l'^2; slope = minus the gradient."""
    latent, r = latent.copy(), slope.copy()
    d, q, strips = np.zeros_like(r), np.zeros_like(r), problem.sweep.strips()
    products = np.zeros(r.shape[1], np.float32)
    _advance(latent, r, d, q, problem.ease, np.float32(0), products)
    rz, last = float(products.sum(dtype=np.float64)), math.inf
    for _ in range(limit):
        if rz <= 0:
            break
        _turn(d, r, problem.ease, np.float32(rz / last))
        step = np.float32(rz / problem.normal(d, strips, q))
        _advance(latent, r, d, q, problem.ease, step, products)
        rz, last = float(products.sum(dtype=np.float64)), rz
    return latent


# x^(EXPONENT / 2 - 1) from 2^-14 to 2, in even steps within each octave, counted by a float's bits
POWER_BITS = 6  # 2^6 steps in each octave
_POWER_FROM, _POWER_SHIFT = (127 - 14) << 23, 23 - POWER_BITS
_POWERS = (
    (_POWER_FROM + (np.arange((15 << POWER_BITS) + 2) << _POWER_SHIFT).astype(np.int32))
    .view(np.float32)
    .astype(np.float64)
    ** (EXPONENT / 2 - 1)
).astype(np.float32)


@njit(cache=True, nogil=True, parallel=True, fastmath=True)
def _link_weights(stored, weight, powers, links):  # type: ignore[no-untyped-def]
    """Weigh the links to the neighbours right, below, below right, below left: [IRLS]."""
    _, height, width = stored.shape
    rest_of, mask = np.float32(2.0**-_POWER_SHIFT), np.uint32((1 << _POWER_SHIFT) - 1)
    third, floor = np.float32(1 / 3), np.float32(EPSILON * EPSILON)
    for y in prange(GUARD, height - GUARD):
        mean = np.empty(width, np.float32)
        bits = mean.view(np.int32)
        for k in range(4):
            down, aside = min(k, 1), (1, 0, 1, -1)[k]
            first, end = max(-aside, 0), width - max(aside, 0)
            if down and y == height - GUARD - 1:
                continue
            mean[:] = 1
            for x in range(first, end):
                s = np.float32(0)
                for c in range(3):
                    d = stored[c, y + down, x + aside] - stored[c, y, x]
                    s += d * d
                mean[x] = third * s + floor
            # Diagonal links are longer: half the weight.
            share = weight if k < 2 else weight / 2
            for x in range(first, end):
                place = np.uint32(bits[x] - _POWER_FROM)
                i, rest = place >> np.uint32(_POWER_SHIFT), rest_of * np.float32(place & mask)
                links[k, y, x] = share * (powers[i] + rest * (powers[i + 1] - powers[i]))


@njit(cache=True, nogil=True, inline='always')
def _pull(u, links, ease, p, n, link):  # type: ignore[no-untyped-def]
    """Give how one link draws the values at p away from their neighbours at n."""
    return load(links, link) * (load(u, p) - load(u, n)) * smaller(load(ease, p), load(ease, n))


@njit(cache=True, nogil=True)
def _add_prior(y, x, links, ease, out, products, room):  # type: ignore[no-untyped-def]
    """Add the prior's quadratic form of x to one row of out; all flat but out (3, h, w)."""
    _, high, wide = out.shape
    flat, plane = out.reshape(-1), high * wide
    product = splat(np.float32(0))
    for k in range(wide // WIDTH):
        here = y * wide + k * WIDTH
        for c in range(3):
            p = c * plane + here
            s = load(flat, p)
            for m in range(4):
                ahead = (1, wide, wide + 1, wide - 1)[m]
                s += _pull(x, links, ease, p, p + ahead, m * plane + here)
                s += _pull(x, links, ease, p, p - ahead, m * plane + here - ahead)
            store(flat, p, s)
            product += load(x, p) * s
    products[y] = total(product, room)


@njit(cache=True, nogil=True, parallel=True)
def _sum_rows(strips, rows, x, links, ease, out, products):  # type: ignore[no-untyped-def]
    """Write the sum of strips of A' (of `rows` rows of B) and the prior's part of x into out."""
    high = out.shape[1]
    count, _, depth, _ = strips.shape
    wide = out.shape[2]
    flat = (x.reshape(-1), links.reshape(-1), ease.reshape(-1))
    for y in prange(GUARD, high - GUARD):
        for c in range(3):
            for i in range(wide):
                out[c, y, i] = 0
            for k in range(count):
                j = y - np.int64(k) * rows // count
                if 0 <= j < depth:
                    for i in range(wide):
                        out[c, y, i] += strips[k, c, j, i]
        _add_prior(y, *flat, out, products, np.empty(WIDTH, np.float32))


@njit(cache=True, nogil=True, parallel=True, fastmath=True)
def _advance(latent, r, d, q, ease, step, products):  # type: ignore[no-untyped-def]
    """Go along d: latent + step d, r - step q; give <r, r / ease> of each row."""
    _, height, width = r.shape
    for y in prange(height):
        s = np.float32(0)
        for c in range(3):
            for x in range(width):
                latent[c, y, x] += step * d[c, y, x]
                r[c, y, x] -= step * q[c, y, x]
                s += r[c, y, x] * r[c, y, x] / ease[c, y, x]
        products[y] = s


@njit(cache=True, nogil=True, parallel=True, fastmath=True)
def _turn(d, r, ease, share):  # type: ignore[no-untyped-def]
    """Turn d to r / ease + share d."""
    _, height, width = r.shape
    for y in prange(height):
        for c in range(3):
            for x in range(width):
                d[c, y, x] = r[c, y, x] / ease[c, y, x] + share * d[c, y, x]
