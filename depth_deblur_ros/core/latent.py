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

from dataclasses import dataclass

from depth_deblur_ros.core.blur import BlurOperator
from depth_deblur_ros.core.data import FloatImage
from depth_deblur_ros.core.light import light_from_stored, light_slope, stored_from_light
from numba import njit, prange
import numpy as np

SATURATED = 0.99  # stored values above may stand for any amount of light
EPSILON = 0.01  # stored units; differences below this count as noise
EXPONENT = 0.8  # alpha of the prior [KF09]
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


def restore_latent(
    blurred: FloatImage, blur: BlurOperator, transfer: str, sigma: float, steps: LatentSteps
) -> FloatImage:
    """Give the sharp image (H, W, 3), stored values, of one under a known blur."""
    light = light_from_stored(blurred, transfer)
    noise = 1 / np.square(light_slope(blurred, transfer))
    full = blurred >= SATURATED
    latent = blur.widen(light)
    weight = np.float32(steps.prior * max(sigma, SIGMA_FLOOR[transfer]) ** 2)
    for _ in range(steps.outer):
        missing = light - blur.apply(latent)
        # What is saturated says only "at least this": drop it where the model gives more.
        trust = np.where(full & (missing <= 0), np.float32(0), noise)
        problem = _reweighted(stored_from_light(latent, transfer), blur, transfer, trust, weight)
        latent = _conjugate_gradients(problem, latent, missing, steps.inner)
    return stored_from_light(blur.crop(latent), transfer)


@dataclass(frozen=True, eq=False)
class Quadratic:
    """(7) with the weights of one reweighting: 1/2 |A L - B|^2_trust + 1/2 <L, links L>."""

    blur: BlurOperator
    trust: FloatImage  # (H, W, 3)
    links: FloatImage  # (h, w, 4) weights to the neighbours right, below, below right, below left
    scale: FloatImage  # (h, w, 3) l'^2

    def smoothness(self, x: FloatImage) -> FloatImage:
        """Give the gradient of the prior's part."""
        out = np.empty_like(x)
        _apply_links(x, self.links, self.scale, out)
        return out

    def normal(self, x: FloatImage) -> FloatImage:
        """Apply the normal equations' matrix."""
        return self.blur.adjoint(self.trust * self.blur.apply(x)) + self.smoothness(x)


def _reweighted(
    stored: FloatImage, blur: BlurOperator, transfer: str, trust: FloatImage, weight: np.float32
) -> Quadratic:
    """Put the weights of (7) at the present image, stored values (h, w, 3)."""
    links = np.zeros((*stored.shape[:2], 4), np.float32)
    _link_weights(stored, weight, links)
    return Quadratic(blur, trust, links, np.square(light_slope(stored, transfer)))


def _conjugate_gradients(
    problem: Quadratic, latent: FloatImage, missing: FloatImage, limit: int
) -> FloatImage:
    """Solve from latent by `limit` steps, preconditioned with l'^2; missing = B - A latent."""
    r = problem.blur.adjoint(problem.trust * missing) - problem.smoothness(latent)
    z = problem.scale * r
    d, rz = z, float(np.vdot(r, z))
    for _ in range(limit):
        if rz <= 0:
            break
        q = problem.normal(d)
        step = np.float32(rz / float(np.vdot(d, q)))
        latent = np.asarray(latent + step * d, latent.dtype)
        r = r - step * q
        z = problem.scale * r
        rz, last = float(np.vdot(r, z)), rz
        d = z + np.float32(rz / last) * d
    return latent


@njit(cache=True, nogil=True, parallel=True, fastmath=True)
def _link_weights(stored, weight, links):  # type: ignore[no-untyped-def]
    """Weigh the links to the neighbours right, below, below right, below left: [IRLS]."""
    height, width = stored.shape[:2]
    for y in prange(height):
        for x in range(width):
            for k in range(4):
                yy, xx = y + (k > 0), x + (1 if k in (0, 2) else (-1 if k == 3 else 0))
                if yy >= height or xx >= width or xx < 0:
                    continue
                m = np.float32(0)
                for c in range(3):
                    d = stored[yy, xx, c] - stored[y, x, c]
                    m += d * d
                m = m / 3 + np.float32(EPSILON * EPSILON)
                # Diagonal links are longer: half the weight.
                share = weight if k < 2 else weight / 2
                links[y, x, k] = share * m ** np.float32(EXPONENT / 2 - 1)


@njit(cache=True, nogil=True, parallel=True, fastmath=True)
def _apply_links(u, links, scale, out):  # type: ignore[no-untyped-def]
    """Apply the prior's quadratic form: sum of weight (u - u(neighbour)) / slope^2."""
    height, width = u.shape[:2]
    for y in prange(height):
        for x in range(width):
            for c in range(3):
                out[y, x, c] = 0
            for k in range(8):
                back = k >= 4
                dy = (k % 4 > 0) * (-1 if back else 1)
                dx = (1 if k % 4 in (0, 2) else (-1 if k % 4 == 3 else 0)) * (-1 if back else 1)
                yy, xx = y + dy, x + dx
                if yy < 0 or yy >= height or xx < 0 or xx >= width:
                    continue
                w = links[yy, xx, k % 4] if back else links[y, x, k]
                for c in range(3):
                    steep = max(scale[y, x, c], scale[yy, xx, c])
                    out[y, x, c] += w * (u[y, x, c] - u[yy, xx, c]) / steep
