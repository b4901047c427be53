"""
One reweighting of the image step: a quadratic problem; descent.py solves it.

Notation as in latent.py, (7) of docs/method.md. Each link between two neighbours pulls with a
weight that the present image gives it.
[KF09] Krishnan & Fergus, NIPS 2009: the hyper-Laplacian prior. [IRLS] Levin et al., SIGGRAPH 2007.
"""

from __future__ import annotations

from dataclasses import dataclass

from depth_deblur_ros.core.data import FloatImage
from depth_deblur_ros.core.lanes import (
    load,
    next_lane,
    prefetch,
    smaller,
    splat,
    store,
    total,
    WIDTH,
)
from depth_deblur_ros.core.light import stored_and_ease
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

    In planes, as sweep.py lays them out: blurred (3, H, W'), latent (3, h, w). What is the same
    for all three is one plane.
    """

    sweep: Sweep
    trust: FloatImage  # (1 or 3, H, W')
    links: FloatImage  # (4, h, w) weights to the neighbours right, below, below right, below left
    ease: FloatImage  # (1 or 3, h, w) 1 / l'^2

    def slope(self, pull: FloatImage, latent: FloatImage) -> FloatImage:
        """Give minus the gradient at a latent image; pull (3, H, W') = trust (B - A latent)."""
        return self._with_prior(-1, latent, self.sweep.scatter(pull), np.zeros_like(latent))

    def slope_after(self, before: Quadratic, slope: FloatImage, latent: FloatImage) -> FloatImage:
        """
        Give minus the gradient at latent from that of the problem before, which is written over.

        Both have the same sweep, whose `directions` are used, and trust; slope, latent (3, h, w).
        """
        _, room = self.sweep.directions
        # One strip of all rows, to which the prior's part is added.
        without = before._with_prior(1, latent, slope[None], room)
        return self._with_prior(-1, latent, without[None], slope)

    def _with_prior(
        self, sign: int, latent: FloatImage, strips: FloatImage, out: FloatImage
    ) -> FloatImage:
        """Write strips of A' and sign times the prior's part of a latent image into out."""
        products = np.empty((latent.shape[1], 2), np.float32)
        told = self.links, self.ease, np.float32(sign), out, products
        height = self.sweep.blurred_shape[1]
        on_threads(sum_rows, len(products), strips, height, latent, *told)
        return out


def reweighted(
    light: FloatImage, sweep: Sweep, transfer: str, trust: FloatImage, weight: np.float32
) -> Quadratic:
    """Put the weights of (7) at the present image, light in latent planes (1 or 3, h, w)."""
    stored, ease = stored_and_ease(light, transfer)
    links = np.empty((4, *stored.shape[1:]), np.float32)
    on_threads(_link_weights, stored.shape[1], stored, weight, links)
    return Quadratic(sweep, trust, links, ease)


@njit(cache=True, nogil=True, inline='always')
def _weight(x):  # type: ignore[no-untyped-def]
    """Weigh differences whose mean square is x: x^(EXPONENT / 2 - 1), [IRLS]."""
    return over_three_fifths(x)


# Flat images and unsigned indices: numba checks signed ones for negative values, and a loop that
# does is not turned into vector code.
@njit(fastmath=True, **SHARED)
def _link_weights(first, end, stored, weight, links):  # type: ignore[no-untyped-def]
    """Weigh the links to the neighbours right, below, below right, below left: [IRLS]."""
    planes, height, width = stored.shape
    flat, mean = stored.reshape(-1), np.empty(width, np.float32)
    share, floor = np.float32(1 / planes), np.float32(EPSILON * EPSILON)
    for y in range(first, end):
        for k in range(4):
            row, down, aside = links[k, y], min(k, 1), (1, 0, 1, -1)[k]
            left, right = np.uintp(max(-aside, 0)), np.uintp(width - max(aside, 0))
            for x in range(width):
                row[x] = 0
            if not GUARD <= y < height - GUARD - down:
                continue
            mean[:] = floor
            for c in range(planes):
                here = np.uintp((c * height + y) * width)
                there = np.uintp((c * height + y + down) * width + aside)
                for x in range(left, right):
                    d = flat[there + x] - flat[here + x]
                    mean[x] += share * d * d
            # Diagonal links are longer: half the weight.
            pull = weight if k < 2 else weight / 2
            for x in range(left, right):
                row[x] = pull * _weight(mean[x])


@njit(cache=True, nogil=True)
def _pull(links, at, u, p, n, ease, off):  # type: ignore[no-untyped-def]
    """Give how one link draws the values at p away from those at n; theirs of ease: off before."""
    least = smaller(load(ease, p - off), load(ease, n - off))
    return load(links, at) * (load(u, p) - load(u, n)) * least


@njit(cache=True, nogil=True)
def _pulls(c, place, u, links, ease, beside, below):  # type: ignore[no-untyped-def]
    """
    Give how all links draw a block of channel c, and those that also draw the block beside it.

    place: row, column, rows and columns of latent planes; by how much less a plane of ease is
    farther on than one of u.
    """
    y, x, high, wide, less = place
    plane, here, off = high * wide, y * wide + x, c * less
    p, kept = c * plane + here, c * wide + x
    n = p + wide
    # A row later these are needed at once; asked for now, the sum takes a quarter less time.
    prefetch(u, n + wide)
    prefetch(ease, n + wide - off)
    right = _pull(links, here, u, p, p + 1, ease, off)
    down = _pull(links, plane + here, u, p, n, ease, off)
    aslant = _pull(links, 2 * plane + here, u, p, n + 1, ease, off)
    back = _pull(links, 3 * plane + here + 1, u, p + 1, n, ease, off)
    across, before, behind = beside
    own = right + down + aslant - next_lane(right, across) + next_lane(back, behind)
    drawn = load(below, kept) + own
    store(below, kept, splat(np.float32(0)) - down - back - next_lane(aslant, before))
    return drawn, (right, aslant, back)


@njit(cache=True, nogil=True)
def _added(p, drawn, x, ease, off, out, sums):  # type: ignore[no-untyped-def]
    """Add to a block of out, and what it then is to the sums."""
    q = load(out, p) + drawn
    store(out, p, q)
    return sums[0] + load(x, p) * q, sums[1] + q * q / load(ease, p - off)


@njit(cache=True, nogil=True)
def _add_prior(y, counts, x, links, ease, sign, out, products, below):  # type: ignore[no-untyped-def]
    """
    Add sign times the prior's part of x to one row of out, if it counts; x, links, ease flat.

    Each link is asked once for both of its ends: below (3 w) holds what those of the row above do
    to this row, and is left with what those of this row do to the next.
    """
    _, high, wide = out.shape
    flat, plane, none = out.reshape(-1), high * wide, splat(np.float32(0))
    r = g = b = none, none, none
    sums, signs = (none, none), splat(sign)
    less = plane if ease.size == plane else 0
    zero = np.intp(0)  # for 0, a constant, what is called would be compiled once more
    for k in range(wide // WIDTH):
        place, here = (y, k * WIDTH, high, wide, less), y * wide + k * WIDTH
        for m in range(4):
            prefetch(links, m * plane + here + wide)
        of_r, r = _pulls(zero, place, x, links, ease, r, below)
        of_g, g = _pulls(zero + 1, place, x, links, ease, g, below)
        of_b, b = _pulls(zero + 2, place, x, links, ease, b, below)
        if counts:
            sums = _added(here, signs * of_r, x, ease, zero, flat, sums)
            sums = _added(here + plane, signs * of_g, x, ease, less, flat, sums)
            sums = _added(here + 2 * plane, signs * of_b, x, ease, 2 * less, flat, sums)
    if counts:
        room = np.empty(WIDTH, np.float32)
        products[y, 0], products[y, 1] = total(sums[0], room), total(sums[1], room)


@njit(**SHARED)
def sum_rows(first, end, strips, rows, x, links, ease, sign, out, products):  # type: ignore[no-untyped-def]
    """
    Write strips of A' (of `rows` rows of B) and sign times the prior's part of x into out.

    products (h, 2) of each row: <x, out>, and <out, out> preconditioned.
    """
    _, high, wide = out.shape
    x, links, ease = x.reshape(-1), links.reshape(-1), ease.reshape(-1)
    begin, below = max(first, GUARD), np.zeros(3 * wide, np.float32)
    for y in range(begin - 1, min(end, high - GUARD)):
        counts = y >= begin  # the row before says what it does to the first
        if counts:
            _add_strips(y, strips, rows, out)
        _add_prior(y, counts, x, links, ease, sign, out, products, below)


@njit(cache=True, nogil=True, inline='always')
def _add_strips(y, strips, rows, out):  # type: ignore[no-untyped-def]
    """Write what strips say of row y."""
    count, _, depth, wide = strips.shape
    for c in range(3):
        for i in range(wide):
            out[c, y, i] = 0
        for k in range(count):
            j = y - np.int64(k) * rows // count
            if 0 <= j < depth:
                for i in range(wide):
                    out[c, y, i] += strips[k, c, j, i]
