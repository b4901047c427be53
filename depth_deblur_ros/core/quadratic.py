"""
One reweighting of the image step: a quadratic problem; descent.py solves it.

Notation as in latent.py, (7) of docs/method.md. Each link between two neighbours pulls with a
weight that the present image gives it.
[KF09] Krishnan & Fergus, NIPS 2009: the hyper-Laplacian prior. [IRLS] Levin et al., SIGGRAPH 2007.
"""

from __future__ import annotations

from dataclasses import dataclass

from depth_deblur_ros.core.data import FloatImage
from depth_deblur_ros.core.lanes import load, smaller, splat, store, total, WIDTH
from depth_deblur_ros.core.light import light_ease
from depth_deblur_ros.core.powers import over_three_fifths
from depth_deblur_ros.core.sweep import GUARD, Sweep
from depth_deblur_ros.core.threads import on_threads, SHARED
from numba import njit
import numpy as np

EPSILON = 0.01  # stored units; differences below this count as noise
EXPONENT = 0.8  # alpha of the prior [KF09]


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
        strips = self.sweep.scatter(np.multiply(self.trust, missing, out=self.sweep.taken))
        r, products = np.zeros_like(latent), np.empty((latent.shape[1], 3), np.float32)
        told = self.links, self.ease, np.float32(-1), r, products
        on_threads(sum_rows, len(products), strips, missing.shape[1], latent, latent, *told)
        return r


def reweighted(
    stored: FloatImage, sweep: Sweep, transfer: str, trust: FloatImage, weight: np.float32
) -> Quadratic:
    """Put the weights of (7) at the present image, stored values in latent planes (3, h, w)."""
    links = np.zeros((4, *stored.shape[1:]), np.float32)
    on_threads(_link_weights, stored.shape[1], stored, weight, links)
    return Quadratic(sweep, trust, links, light_ease(stored, transfer))


@njit(cache=True, nogil=True, inline='always')
def _weight(x):  # type: ignore[no-untyped-def]
    """Weigh differences whose mean square is x: x^(EXPONENT / 2 - 1), [IRLS]."""
    return over_three_fifths(x)


# Flat images and unsigned indices: numba checks signed ones for negative values, and a loop that
# does is not turned into vector code.
@njit(fastmath=True, **SHARED)
def _link_weights(first, end, stored, weight, links):  # type: ignore[no-untyped-def]
    """Weigh the links to the neighbours right, below, below right, below left: [IRLS]."""
    _, height, width = stored.shape
    flat, mean = stored.reshape(-1), np.empty(width, np.float32)
    third, floor = np.float32(1 / 3), np.float32(EPSILON * EPSILON)
    for y in range(max(first, GUARD), min(end, height - GUARD)):
        for k in range(4):
            down, aside = min(k, 1), (1, 0, 1, -1)[k]
            left, right = np.uintp(max(-aside, 0)), np.uintp(width - max(aside, 0))
            if down and y == height - GUARD - 1:
                continue
            mean[:] = floor
            for c in range(3):
                here = np.uintp((c * height + y) * width)
                there = np.uintp((c * height + y + down) * width + aside)
                for x in range(left, right):
                    d = flat[there + x] - flat[here + x]
                    mean[x] += third * d * d
            # Diagonal links are longer: half the weight.
            share, row = weight if k < 2 else weight / 2, links[k, y]
            for x in range(left, right):
                row[x] = share * _weight(mean[x])


@njit(cache=True, nogil=True, inline='always')
def _pull(u, links, ease, p, n, link):  # type: ignore[no-untyped-def]
    """Give how one link draws the values at p away from their neighbours at n."""
    return load(links, link) * (load(u, p) - load(u, n)) * smaller(load(ease, p), load(ease, n))


@njit(cache=True, nogil=True, inline='always')
def _add_prior(y, x, r, links, ease, sign, out, products, room):  # type: ignore[no-untyped-def]
    """Add sign times the prior's part of x to one row of out; all flat but out (3, h, w)."""
    _, high, wide = out.shape
    flat, plane = out.reshape(-1), high * wide
    xq = rq = qq = splat(np.float32(0))
    for k in range(wide // WIDTH):
        here = y * wide + k * WIDTH
        for c in range(3):
            p = c * plane + here
            pulls = splat(np.float32(0))
            for m in range(4):
                ahead = (1, wide, wide + 1, wide - 1)[m]
                pulls += _pull(x, links, ease, p, p + ahead, m * plane + here)
                pulls += _pull(x, links, ease, p, p - ahead, m * plane + here - ahead)
            q = load(flat, p) + splat(sign) * pulls
            store(flat, p, q)
            z = q / load(ease, p)
            xq, rq, qq = xq + load(x, p) * q, rq + load(r, p) * z, qq + q * z
    products[y, 0], products[y, 1] = total(xq, room), total(rq, room)
    products[y, 2] = total(qq, room)


@njit(**SHARED)
def sum_rows(first, end, strips, rows, x, r, links, ease, sign, out, products):  # type: ignore[no-untyped-def]
    """
    Write strips of A' (of `rows` rows of B) and sign times the prior's part of x into out.

    products (h, 3) of each row: <x, out>; <r, out> and <out, out> preconditioned.
    """
    high = out.shape[1]
    count, _, depth, _ = strips.shape
    wide = out.shape[2]
    x, r, links, ease = x.reshape(-1), r.reshape(-1), links.reshape(-1), ease.reshape(-1)
    for y in range(max(first, GUARD), min(end, high - GUARD)):
        for c in range(3):
            for i in range(wide):
                out[c, y, i] = 0
            for k in range(count):
                j = y - np.int64(k) * rows // count
                if 0 <= j < depth:
                    for i in range(wide):
                        out[c, y, i] += strips[k, c, j, i]
        room = np.empty(WIDTH, np.float32)
        _add_prior(y, x, r, links, ease, sign, out, products, room)
