"""
The paper's motion step: p by Levenberg-Marquardt.

Notation: p (6,) motion; r(p) = A_p L - B; J = dr/dp; M the data weight, N and Q the forms of the
energy's terms in p (energy.py); g and H half the gradient and half the curvature. With t_i the
instants and F_i = J_i p the flow of what pixel x sees at t_i, (5) and (28) of docs/method.md,

    A_p L (x) = 1/N sum_i L(x - t_i F_i(x)),
    dA_p L (x) / dp = -1/N sum_i t_i dL(x - t_i F_i(x)) J_i(x).

dL is the slope of the bilinear interpolation itself, so J is exact, but where a sample crosses
from one cell to the next. What is seen at each instant stays as it was at the first p of a step.
[LM] Moré, Lecture Notes in Mathematics 630, 1978. [YR03] Yuille & Rangarajan, Neural Computation
15, 2003. [K75] Kaufman, BIT 15, 1975.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

from depth_deblur_ros.core.blur import BlurOperator
from depth_deblur_ros.core.data import Vector
from depth_deblur_ros.core.energy import data_weight, motion_term, smoothness_term
from depth_deblur_ros.core.threads import on_threads, SHARED
from numba import njit
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.floating]

FIRST_DAMPING, MAX_DAMPING = 1e-2, 1e8  # relative to the diagonal of H
GROW, SHRINK = 8.0, 0.1
STEP_SMALL = 1e-6  # of the length of p


class Stop(StrEnum):
    """Why the steps ended."""

    STEP_SMALL = 'step small'
    NO_DESCENT = 'no descent'
    STEP_LIMIT = 'step limit'


@dataclass(frozen=True, eq=False)
class Fit:
    """p (6,) found, the energy at the start and after each accepted step, and why it ended."""

    p: Vector
    energies: tuple[float, ...]
    stop: Stop


@dataclass(frozen=True)
class Steps:
    """How many steps, how long one may be (as N measures it), how far damping may rise."""

    count: int
    longest: float = np.inf
    max_damping: float = MAX_DAMPING


@dataclass(frozen=True, eq=False)
class Bowl:
    """A quadratic above the energy around p: value + 2 g h + h' H h for a step h (6,)."""

    value: float
    slope: Vector  # g (6,)
    curvature: Vector  # H (6, 6)


@dataclass(frozen=True, eq=False)
class MotionProblem:
    """What a motion step holds fixed: L (h, w, 3), B (H, W, 3), what is seen when, the forms."""

    latent: Array
    blurred: Array
    blur: BlurOperator
    norm: Vector  # N (6, 6)
    smoothness: Vector  # Q (6, 6)
    mu1: float

    def energy(self, p: Vector) -> float:
        """Give the terms of (23) that depend on p."""
        residual = blur_and_slope(p, self.latent, self.blur)[0] - self.blurred
        return self._total(p, float(np.vdot(residual, data_weight(residual))))

    def bowl(self, p: Vector, answering: int = 0) -> Bowl:
        """
        Give the quadratic of (29) at p; mu1 |p|^2, concave, lies below its tangent [YR03].

        answering: conjugate gradient steps in which L answers to a change of p, (30); 0: none.
        """
        value, slope = blur_and_slope(p, self.latent, self.blur)
        residual = value - self.blurred
        weighted = data_weight(residual)
        g = np.array([np.vdot(slope[..., k], weighted) for k in range(6)], np.float64)
        g = g + (self.mu1 * self.norm + self.smoothness) @ p
        seen = slope if answering == 0 else self._unanswered(slope, answering)
        h = _products(seen) * (slope.size / seen.size) + self.smoothness
        return Bowl(self._total(p, float(np.vdot(residual, weighted))), g, h)

    def _total(self, p: Vector, data: float) -> float:
        own = motion_term(p, self.norm, self.mu1) + smoothness_term(p, self.smoothness)
        return data + own

    def _unanswered(self, slope: Array, answering: int) -> Array:
        """Give the grey slope (H, W, 6) less what a change of L makes up for [K75], (30)."""
        grey = slope.mean(2)
        halves = [np.ascontiguousarray(grey[..., k : k + 3]) for k in (0, 3)]
        return np.concatenate([_leftover(h, self.blur, answering) for h in halves], -1)


def estimate_motion(p: Vector, problem: MotionProblem, count: int) -> Fit:
    """Lower the energy of a motion problem from p by at most `count` steps, L fixed."""
    return levenberg_marquardt(p, problem.bowl, problem.energy, problem.norm, Steps(count))


def levenberg_marquardt(
    p: Vector,
    bowl: Callable[[Vector], Bowl],
    energy: Callable[[Vector], float],
    norm: Vector,
    steps: Steps,
) -> Fit:
    """Lower an energy by damped steps; a step counts only when the energy falls."""
    here = bowl(p)
    energies, damping = [here.value], FIRST_DAMPING
    for k in range(steps.count):
        while damping <= steps.max_damping:
            step = _capped(damped_step(here, damping), norm, steps.longest)
            value = energy(p + step)
            if value < energies[-1]:
                break
            damping *= GROW
        else:
            return Fit(p, tuple(energies), Stop.NO_DESCENT)
        p, damping = p + step, max(SHRINK * damping, 1e-12)
        energies.append(value)
        if step @ norm @ step <= STEP_SMALL**2 * (p @ norm @ p):
            return Fit(p, tuple(energies), Stop.STEP_SMALL)
        if k + 1 < steps.count:
            here = bowl(p)
    return Fit(p, tuple(energies), Stop.STEP_LIMIT)


def damped_step(here: Bowl, damping: float) -> Vector:
    """Solve (H + damping diag H) h = -g, (29)."""
    scale = np.diag(here.curvature)
    damped = here.curvature + damping * np.diag(np.maximum(scale, 1e-12 * scale.max()))
    return np.asarray(-np.linalg.solve(damped, here.slope))


def _capped(step: Vector, norm: Vector, longest: float) -> Vector:
    length = float(np.sqrt(step @ norm @ step))
    return step if length <= longest else step * (longest / length)


def _products(columns: Array) -> Vector:
    """Give the form (n, n) of columns (..., n) under the data weight M."""
    flat = [np.ascontiguousarray(columns[..., k]) for k in range(columns.shape[-1])]
    weighted = [data_weight(c) for c in flat]
    return np.array([[np.vdot(a, b) for b in flat] for a in weighted], np.float64)


def _leftover(columns: Array, blur: BlurOperator, limit: int) -> Array:
    """Give three columns (H, W, 3) less their best fit by A z, z by `limit` CG steps from zero."""
    r = blur.adjoint(data_weight(columns))
    z, d = np.zeros_like(r), r
    rr = np.square(r).sum((0, 1))
    for _ in range(limit):
        s = blur.adjoint(data_weight(blur.apply(d)))
        a = rr / np.maximum((d * s).sum((0, 1)), np.finfo(r.dtype).tiny)
        z, r = z + a * d, r - a * s
        rr, last = np.square(r).sum((0, 1)), rr
        d = r + rr / np.maximum(last, np.finfo(r.dtype).tiny) * d
    return columns - blur.apply(z)


def blur_and_slope(p: Vector, latent: Array, blur: BlurOperator) -> tuple[Array, Array]:
    """Give A_p L (H, W, 3) and its slope (H, W, 3, 6) in p (6,); the rest stays as in blur."""
    shape = (*blur.inverse_depth.shape[:2], 3)
    value, slope = np.empty(shape, latent.dtype), np.empty((*shape, 6), latent.dtype)
    focal, rolling = np.split(blur.motion[6:].astype(np.float64), [2])
    whole = np.concatenate([p, rolling])
    told = latent, blur.inverse_depth, blur.ray, whole, focal, blur.margin
    on_threads(_blur_and_slope, len(value), *told, value, slope)
    return value, slope


@njit(**SHARED)
def _blur_and_slope(first, end, latent, seen, ray, p, focal, margin, value, slope):  # type: ignore[no-untyped-def]
    width = seen.shape[1]
    for y in range(first, end):
        for x in range(width):
            xn, yn = np.float64(ray[x]), np.float64(ray[width + y])
            tx, ty, tz = p[0] + yn * p[6], p[1] + yn * p[7], p[2] + yn * p[8]
            flow = (
                focal[0] * (-xn * yn * tx + (1 + xn * xn) * ty - yn * tz),
                focal[1] * (-(1 + yn * yn) * tx + xn * yn * ty + xn * tz),
                focal[0] * (p[3] - xn * p[5]),
                focal[1] * (p[4] - yn * p[5]),
            )
            leans = _gather(latent, seen[y, x], x + margin, y + margin, flow)
            for c in range(3):
                lean = leans[c]
                gx, hx = focal[0] * lean[1], focal[0] * lean[2]
                gy, hy = focal[1] * lean[3], focal[1] * lean[4]
                value[y, x, c] = lean[0]
                slope[y, x, c, 0] = -xn * yn * gx - (1 + yn * yn) * gy
                slope[y, x, c, 1] = (1 + xn * xn) * gx + xn * yn * gy
                slope[y, x, c, 2] = -yn * gx + xn * gy
                slope[y, x, c, 3] = hx
                slope[y, x, c, 4] = hy
                slope[y, x, c, 5] = -xn * hx - yn * hy


@njit(cache=True, nogil=True, inline='always')
def _gather(latent, near, x, y, flow):  # type: ignore[no-untyped-def]
    """
    Average L and its slope over the instants, along the flow (a, then b) of one pixel.

    Of each channel: value, then minus dL times t and t w down each axis.
    """
    high, wide = latent.shape[0] - 1.001, latent.shape[1] - 1.001
    samples = near.shape[0]
    r = g = b = (0.0, 0.0, 0.0, 0.0, 0.0)
    share = 1.0 / samples
    for i in range(samples):
        t, w = (i + 0.5) * share - 0.5, np.float64(near[i])
        px, py = x - t * (flow[0] + w * flow[2]), y - t * (flow[1] + w * flow[3])
        # Beyond the rim L goes on evenly: no slope.
        tx = t * share if 0 < px < wide else 0.0
        ty = t * share if 0 < py < high else 0.0
        px, py = min(max(px, 0.0), wide), min(max(py, 0.0), high)
        x0, y0 = np.uintp(px), np.uintp(py)
        place, weights = (y0, x0, px - x0, py - y0), (share, tx, ty, w)
        r = _leant(r, latent, place, 0, weights)
        g = _leant(g, latent, place, 1, weights)
        b = _leant(b, latent, place, 2, weights)
    return r, g, b


@njit(cache=True, nogil=True, inline='always')
def _leant(lean, latent, place, c, weights):  # type: ignore[no-untyped-def]
    """Add what one instant shows of a channel."""
    y, x, u, v = place
    share, tx, ty, w = weights
    one = np.uintp(1)
    top, below = latent[y, x, c], latent[y + one, x, c]
    dt, db = latent[y, x + one, c] - top, latent[y + one, x + one, c] - below
    across, down = (1 - v) * dt + v * db, below + u * db - top - u * dt
    value, dx, dy = share * (top + u * dt + v * down), tx * across, ty * down
    return lean[0] + value, lean[1] - dx, lean[2] - w * dx, lean[3] - dy, lean[4] - w * dy
