"""
The paper's image step: L for a known motion, by primal-dual steps.

Notation: L (h, w, 3) latent light; B (H, W, 3) blurred light; A the blur; M = 1 + d' d the data
weight, d differences (energy.py); q (2, h, w, 3) dual field, |q| <= 1 at each pixel.
Minimises, (31) of docs/method.md,

    <A L - B, M (A L - B)> + mu4 |d L|_1.

[CP11] Chambolle & Pock, J. Math. Imaging Vis. 40, 2011, Algorithm 1.
"""

from __future__ import annotations

from dataclasses import dataclass

from depth_deblur_ros.core.blur import BlurOperator
from depth_deblur_ros.core.data import FloatImage, InputError
from depth_deblur_ros.core.energy import (
    data_weight,
    differences,
    differences_adjoint,
    variation_term,
)
import numpy as np

DIFFERENCES_NORM = 8.0  # |d|^2 is below
INNER = 3  # conjugate gradient steps that solve each primal step, started at the last one's answer


@dataclass(frozen=True)
class PrimalDualSteps:
    """TV weight mu4, primal step eta, dual step gamma, and how many steps."""

    mu4: float
    eta: float
    gamma: float
    count: int
    inner: int = INNER

    def __post_init__(self) -> None:
        bound = self.eta * self.gamma * self.mu4 * DIFFERENCES_NORM
        if bound > 1:
            raise InputError(
                f'eta gamma mu4 must lie in [0, {1 / DIFFERENCES_NORM}] for steps to converge, '
                f'got {bound / DIFFERENCES_NORM:g}'
            )


def restore_by_primal_dual(
    latent: FloatImage, blurred: FloatImage, blur: BlurOperator, steps: PrimalDualSteps
) -> FloatImage:
    """Lower the energy of the latent image, from `latent` on; nothing gained gives it back."""
    u = ahead = latent
    q = np.zeros((2, *latent.shape), latent.dtype)
    target = 2 * blur.adjoint(data_weight(blurred))
    eta, mu4 = latent.dtype.type(steps.eta), latent.dtype.type(steps.mu4)
    for _ in range(steps.count):
        q = q + latent.dtype.type(steps.gamma) * differences(ahead)  # (32)
        q = q / np.maximum(1, np.sqrt(np.square(q).sum(0)))
        centre = (u - eta * mu4 * differences_adjoint(q)).astype(latent.dtype)
        new = _nearest(u, centre / eta + target, blur, eta, steps.inner)  # (33)
        u, ahead = new, 2 * new - u
    return (
        u
        if image_energy(u, blurred, blur, steps.mu4)
        < image_energy(latent, blurred, blur, steps.mu4)
        else latent
    )


def image_energy(latent: FloatImage, blurred: FloatImage, blur: BlurOperator, mu4: float) -> float:
    """Give the terms of the energy that depend on L, (31)."""
    residual = blur.apply(latent) - blurred
    data = float(np.sum(residual * data_weight(residual), dtype=np.float64))
    return data + variation_term(latent, mu4)


def _nearest(
    u: FloatImage, right: FloatImage, blur: BlurOperator, eta: np.floating, limit: int
) -> FloatImage:
    """Solve (2 A' M A + 1 / eta) u = right by conjugate gradients from u."""

    def normal(x: FloatImage) -> FloatImage:
        return 2 * blur.adjoint(data_weight(blur.apply(x))) + x / eta

    r = right - normal(u)
    d, rr = r, float(np.vdot(r, r))
    for _ in range(limit):
        if rr <= 0:
            break
        s = normal(d)
        step = u.dtype.type(rr / float(np.vdot(d, s)))
        u, r = u + step * d, r - step * s
        rr, last = float(np.vdot(r, r)), rr
        d = r + u.dtype.type(rr / last) * d
    return u
