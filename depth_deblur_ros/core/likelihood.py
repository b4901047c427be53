"""
How likely a motion makes the blurred image: the slope of the likelihood, and its curvature.

If the best latent images of two motions are compared, the shorter motion wins: blurred images
cost least. What counts is how likely the blurred image is over all latent images; the slope of
that in p is the slope of the data term, averaged over what the latent image may be [LWDF11]. The
average is taken over the best image and samples of what is left open about it, as three planes of
one image step, docs/method.md (16) to (18).

Notation: B blurred grey light; L = mu + s latent light, mu the best for p, s the rest,
s ~ N(0, sigma^2 (A' W A + R)^-1); R the prior's links (quadratic.py), W = 1 / l'^2;
J x = d (A_p x) / d p.

    g(p) = (<J mu, W (A mu - B)> + mean over s of <J s, W A s>) / sigma^2

[LWDF11] Levin, Weiss, Durand & Freeman, CVPR 2011. [K75] Kaufman, BIT 15, 1975.
[PY11] Papandreou & Yuille, ICCV 2011: samples by perturbing the data and the prior.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
import math

from depth_deblur_ros.core.blur import blur_operator, BlurOperator
from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, InputError, Motion, Vector
from depth_deblur_ros.core.descent import conjugate_gradients
from depth_deblur_ros.core.leaning import lean
from depth_deblur_ros.core.light import light_slope, stored_from_light
from depth_deblur_ros.core.quadratic import Quadratic, reweighted
from depth_deblur_ros.core.sums import add_noise, multiply, squares
from depth_deblur_ros.core.sweep import Sweep
from depth_deblur_ros.core.threads import on_threads
import numpy as np

REWEIGHTINGS = 4  # of the image step
PRIORS = (0.2, 60.0)  # where its weight stays
DOUBTED = 3.0  # sigma; what is missed by as much counts half
LEAST_COUNT = 1e-4
# Least sigma: for averaged values, as much as so few steps resolve; a real camera hides its noise,
# and more is unexplained there.
SIGMA_LEAST, SIGMA_MOST = {'linear': 0.002, 'srgb': 0.012}, 0.1
OWN_SPACING = 0.8  # px from instant to instant of a block's own blur, for each of Pace.spacing
AROUND = 64  # px of noise beyond a part of the frame, so that its margin may change


@dataclass(frozen=True)
class Scales:
    """Noise sigma [stored values] and the weight of the prior, as a part of the image has them."""

    sigma: float = 0.005
    prior: float = 2.7


@dataclass(frozen=True)
class Pace:
    """How finely the image step works: px from instant to instant, steps of a reweighting."""

    spacing: float = 1.0  # of the longest blur
    steps: int = 10  # conjugate gradients in each reweighting but the last
    # What so few steps leave undone changes its sign from one reweighting to the next, and the
    # motion with it.
    last: int = 15

    def __post_init__(self) -> None:
        if not self.spacing > 0 or min(self.steps, self.last) < 1:
            raise InputError(f'spacing must be > 0, steps and last >= 1, not {self}')


@dataclass(frozen=True, eq=False)
class Part:
    """A part of the frame: grey light and depth [m] (H, W), what counts of it, its own camera."""

    light: FloatImage
    counts: FloatImage  # (H, W): 0 where saturated, less than 1 where the model is wrong, else 1
    depth: FloatImage
    camera: CameraIntrinsics
    seed: int  # of its noise, which stays the same while the motion changes
    scales: Scales = Scales()
    pace: Pace = Pace()

    @cached_property
    def slope(self) -> FloatImage:
        """Give l' (H, W), by which noise of stored values becomes noise of light."""
        transfer = self.camera.transfer
        return light_slope(stored_from_light(self.light, transfer), transfer)

    @property
    def trust(self) -> FloatImage:
        """Give W (H, W)."""
        return np.asarray(self.counts / self.slope**2)


@dataclass(frozen=True, eq=False)
class Posterior:
    """What the latent image of a part may be under a motion: planes mu, s, s' (3, h, w)."""

    part: Part
    blur: BlurOperator
    problem: Quadratic
    latent: FloatImage


def settled(part: Part, p: Vector) -> Posterior:
    """As `posterior`, with noise and prior that follow what is left of the data and the image."""
    blur, sweep, latent = _unblurred(part, p)
    data, trust = _observed(part, sweep)
    missing = sweep.missing(data, latent)
    for k in reversed(range(REWEIGHTINGS)):
        sigma, steps = part.scales.sigma, part.pace.steps if k else part.pace.last
        problem = _weighted(part, sweep, trust, latent)
        push = problem.slope(trust * missing, latent)
        push[1:] += sigma * _prior_noise(problem, part.seed)
        latent = conjugate_gradients(problem, latent, push, steps)
        if k:
            missing = sweep.missing(data, latent, missing)
            missing[1:] -= data[1:]
            part = _followed(part, problem, latent, missing)
            data, trust = _observed(part, sweep)
            change = part.scales.sigma / sigma
            latent[1:] *= change
            missing[1:] = change * missing[1:] + data[1:]
    return Posterior(part, blur, problem, latent)


def posterior(part: Part, p: Vector) -> Posterior:
    """Find mu and two samples s for a motion p (9,), by rows."""
    blur, sweep, latent = _unblurred(part, p)
    data, trust = _observed(part, sweep)
    problem = _weighted(part, sweep, trust, latent)
    push = problem.slope(trust * sweep.missing(data, latent, sweep.taken), latent)
    noise = part.scales.sigma * _prior_noise(problem, part.seed)
    push[1:] += noise
    for k in reversed(range(REWEIGHTINGS)):
        steps = part.pace.steps if k else part.pace.last
        latent = conjugate_gradients(problem, latent, push, steps)
        if k:
            before, problem = problem, _weighted(part, sweep, trust, latent)
            push = problem.slope_after(before, push, latent)
            earlier, noise = noise, part.scales.sigma * _prior_noise(problem, part.seed)
            push[1:] += noise - earlier
    return Posterior(part, blur, problem, latent)


def _unblurred(part: Part, p: Vector) -> tuple[BlurOperator, Sweep, FloatImage]:
    """Lay out the blur of a motion, and what the planes begin with: the image, and no noise."""
    pace = part.pace
    blur = blur_operator(Motion.from_vector(p), part.depth, part.camera, pace.spacing)
    sweep = blur.thinned(OWN_SPACING * pace.spacing)
    none = np.zeros_like(part.light)
    return blur, sweep, sweep.widened(np.stack([part.light, none, none]))


def _weighted(part: Part, sweep: Sweep, trust: FloatImage, latent: FloatImage) -> Quadratic:
    """Weigh the prior as the present image does."""
    weight = np.float32(part.scales.prior * part.scales.sigma**2)
    return reweighted(latent[:1], sweep, part.camera.transfer, trust, weight)


def _observed(part: Part, sweep: Sweep) -> tuple[FloatImage, FloatImage]:
    """Give planes of the blurred light and twice the noise that it may have, and of W."""
    height, width = part.light.shape
    noise = _data_noise(part.seed, height, width)[:, :, :width]
    spread = part.scales.sigma * part.slope / np.sqrt(np.maximum(part.counts, LEAST_COUNT))
    data = np.stack([part.light, *(spread * noise)], 2).astype(np.float32)
    return sweep.blurred_planes(data), sweep.blurred_planes(part.trust[..., None])


def _followed(part: Part, problem: Quadratic, latent: FloatImage, missing: FloatImage) -> Part:
    """Give the part with scales by which data and prior cost what their numbers say, (18)."""
    sigma, prior = part.scales.sigma, part.scales.prior
    planes = np.array([1, 0.5, 0.5])
    data = np.square(missing) * problem.trust
    left = float(planes @ data.sum((1, 2), dtype=np.float64)) / max(part.counts.sum(), 1.0)
    rough = float(planes @ _roughness(problem, latent)) / sigma**2
    scales = Scales(
        float(np.clip(math.sqrt(left), SIGMA_LEAST[part.camera.transfer], SIGMA_MOST)),
        float(np.clip(prior / max(rough, 1e-9), *PRIORS)),
    )
    off = missing[0, :, : part.light.shape[1]] / (part.slope * np.float32(DOUBTED * sigma))
    counts = np.where(part.counts > 0, 1 / (1 + np.square(off)), np.float32(0))
    return replace(part, counts=counts, scales=scales)


def _roughness(problem: Quadratic, latent: FloatImage) -> Vector:
    """Give x' R x per pixel of each plane (3,)."""
    sums = np.empty((latent.shape[1], 3))
    on_threads(squares, len(sums), latent, problem.links, problem.ease[0], sums)
    return np.asarray(sums.sum(0) / latent[0].size)


def _prior_noise(problem: Quadratic, seed: int) -> FloatImage:
    """Give R^(1/2) n for two fields of unit noise n (2, h, w), laid out from the part's corner."""
    _, height, width = problem.ease.shape
    out = np.zeros((2, height, width), np.float32)
    room = problem.sweep.room
    first = max(AROUND - room, 0)
    noise = _link_noise(seed, max(height - 2 * room + 2 * AROUND, height), width + 2 * AROUND)
    noise = noise[:, :, first : first + height, first : first + width]
    add_noise(noise, problem.links, problem.ease[0], out)
    return out


@lru_cache(maxsize=8)
def _link_noise(seed: int, height: int, width: int) -> FloatImage:
    """Give unit noise (4, 2, height, at least width) of the links."""
    return np.array(_noise(seed, height, width)[:-1])  # a copy: the rest is not kept


@lru_cache(maxsize=8)
def _data_noise(seed: int, height: int, width: int) -> FloatImage:
    """Give unit noise (2, height, at least width) of the data."""
    return np.array(_noise(seed, height, width)[-1])


def _noise(seed: int, height: int, width: int) -> FloatImage:
    rng = np.random.default_rng(seed)
    return rng.standard_normal((5, 2, height, -(-width // 128) * 128), np.float32)


def slope_of(found: Posterior) -> tuple[Vector, FloatImage]:
    """Give g (9,), (16), and J mu (6, H, W'), where rows see no other turn."""
    blur, sweep = found.blur, found.problem.sweep
    light = np.zeros(sweep.blurred_shape, np.float32)
    light[0, :, : found.part.light.shape[1]] = found.part.light
    weight = np.array([1, 0.5, 0.5], np.float32)[:, None, None] * found.problem.trust
    slope, force = lean(blur, sweep, found.latent, light, weight)
    force, yn = force.astype(np.float64), blur.ray[-len(force) :].astype(np.float64)
    g = np.concatenate([force.sum(0), yn @ force[:, :3]])
    return g / found.part.scales.sigma**2, slope


def curvature_of(found: Posterior, slope: FloatImage) -> Vector:
    """Give <J, W (J - A z)> / sigma^2 (9, 9), z how mu answers to a change of p [K75], (17)."""
    problem, sweep = found.problem, found.problem.sweep
    rest = np.empty_like(slope)
    for half in (slice(0, 3), slice(3, 6)):
        push = sweep.adjoint(problem.trust * slope[half])
        z = conjugate_gradients(problem, np.zeros_like(push), push, found.part.pace.steps)
        sweep.missing(slope[half], z, rest[half])
    by_row = np.empty((slope.shape[1], 6, 6))
    on_threads(multiply, len(by_row), slope, problem.trust[0], rest, by_row)
    # Over the length of a blur yn hardly changes: what it weighs is answered alike.
    yn = found.blur.ray[-len(by_row) :].astype(np.float64)
    even, once, twice = (np.einsum('y,yij', yn**k, by_row) for k in range(3))
    h = np.block([[even, once[:, :3]], [once[:3], twice[:3, :3]]])
    return np.asarray((h + h.T) / 2) / found.part.scales.sigma**2
