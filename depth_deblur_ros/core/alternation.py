"""
The paper's method on one page: motion and image by turns, coarse to fine.

1 uniform kernels give the first motion (uniform.py)
2 from level to level (pyramid.py), in turns: the image step (primal_dual.py) finds L for p, the
  motion step (motion.py) a p that lowers the energy (energy.py) of both
3 the image step at full size; or nothing, where the energy speaks against the motion

Notation: E_L(p) = min over L of the terms of (23) but for mu1 |p|^2; R(p) = E_L(p) / |p|^(2 rho).
What the numbers of the paper mean in our units: (34) to (36) of docs/method.md.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
import math

from depth_deblur_ros.core.blur import blur_operator, BlurOperator
from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    EnergyStep,
    FloatImage,
    Motion,
    Outcome,
    Vector,
)
from depth_deblur_ros.core.energy import (
    difference_term,
    edge_weights,
    EdgeWeights,
    intensity_term,
    motion_norm,
    smoothness_form,
    smoothness_term,
    variation_term,
)
from depth_deblur_ros.core.geometry import blur_length
from depth_deblur_ros.core.motion import Bowl, levenberg_marquardt, MotionProblem, Steps
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.core.primal_dual import PrimalDualSteps, restore_by_primal_dual
from depth_deblur_ros.core.pyramid import build_pyramid, Level
from depth_deblur_ros.core.uniform import motions_of_flow, streak, uniform_kernel
import numpy as np

GREY_LEVELS = 255.0  # the paper's values; ours span 0..1
REWARD_MU1, REWARD = -20.0, 0.75  # the paper's mu1, and the share of E_L(p) that it gives back
KERNEL_LEVELS = range(8)  # where uniform kernels propose a motion
STRETCHES = (1.0, 0.75, 1.3, 1.6)  # of the best proposal
SHORTEST = 4.0  # px; the uniform start takes lens blur for shorter motion
VISIBLE = 5.0  # px of blur at a level: below, it does not show the motion
TURN_STEPS = 10  # primal-dual steps of the image step within a turn
LEGIBLE = 16.0  # px of blur: finer levels cost much and add nothing
ANSWERING = 8  # conjugate gradient steps by which L answers in the motion step
LONGEST_STEP = 2.0  # px
MOST_DAMPING = 10.0
SETTLED = 0.005  # relative gain in R of a level that changes nothing any more
AGAINST = 12.0  # E_L(p) / E_L(0) of a motion that does not explain the image


@dataclass(frozen=True, eq=False)
class Found:
    """The motion p (6,), zero unless solved; its doubt E_L(p) / E_L(0); energies on the way."""

    p: Vector
    outcome: Outcome
    doubt: float
    trace: tuple[EnergyStep, ...]

    @property
    def quality(self) -> float:
        """Give 0..1, the trust in the motion."""
        return max(0.0, 1 - self.doubt / AGAINST)


@dataclass(frozen=True, eq=False)
class State:
    """A motion p (6,) with the image that answers to it, and the terms of E_L [light^2]."""

    p: Vector
    blur: BlurOperator
    latent: FloatImage
    terms: Mapping[str, float]

    @property
    def energy(self) -> float:
        """E_L(p)."""
        return sum(self.terms.values())


def alternate(
    light: FloatImage, depth: FloatImage, camera: CameraIntrinsics, params: SolverParams
) -> Found:
    """Find the motion that blurred light (H, W, 3), with its filled depth (H, W) [m]."""
    levels = build_pyramid(Level(light, depth, camera), params.levels, params.scale_factor)
    p = first_motion(levels, params)
    if blur_length(p, depth, camera) < SHORTEST:
        return Found(np.zeros(6), Outcome.SHARP, 0.0, ())
    trace: list[EnergyStep] = []
    still = 0
    for index, level in enumerate(levels):
        problem = LevelProblem.at(level, params)
        if problem.length(p) < VISIBLE and index + 1 < len(levels):
            continue
        if trace and problem.length(p) > LEGIBLE:
            break
        p, gain = problem.take_turns(p, index, trace)
        still = still + 1 if gain < SETTLED else 0
        if still == 2:
            break
    doubt = problem.answer(p).energy / problem.answer(np.zeros(6)).energy
    if doubt > AGAINST:
        return Found(np.zeros(6), Outcome.FAILED, doubt, tuple(trace))
    return Found(p, Outcome.SOLVED, doubt, tuple(trace))


def restore(
    light: FloatImage,
    depth: FloatImage,
    camera: CameraIntrinsics,
    p: Vector,
    params: SolverParams,
) -> FloatImage:
    """Give the latent light (H, W, 3) of blurred light under the motion p (6,): the image step."""
    problem = LevelProblem.at(Level(light, depth, camera), params)
    state = problem.answer(p, params.primal_dual_steps)
    return state.blur.crop(state.latent)


def first_motion(levels: tuple[Level, ...], params: SolverParams) -> Vector:
    """
    Give the best p (6,), by R, of those that uniform kernels at several levels propose.

    A kernel of so many pixels holds longer blurs at coarse levels and shows shorter ones at fine.
    """
    finest = levels[-1]
    proposals = []
    for level in [levels[k] for k in KERNEL_LEVELS if k < len(levels)]:
        u = streak(uniform_kernel(level.image.mean(2), params.kernel_size))
        proposals.append(motions_of_flow(u, level.depth, level.camera))
    lengths = [blur_length(turn, finest.depth, finest.camera) for turn, _ in proposals]
    needed = VISIBLE / max(float(np.median(lengths)), VISIBLE) * finest.camera.width
    level = next(one for one in levels if one.camera.width >= needed)
    problem = LevelProblem.at(level, params)
    best = min(proposals, key=lambda one: problem.merit_of(one[0]))
    # Faint ends of a streak are lost in the kernel, and ringing adds to it.
    return min((s * p for p in best for s in STRETCHES), key=problem.merit_of)


@dataclass(frozen=True, eq=False)
class LevelProblem:
    """What one level of the pyramid holds fixed."""

    level: Level
    norm: Vector  # N (6, 6)
    smoothness: Vector  # Q (6, 6) [light^2]
    params: SolverParams

    @classmethod
    def at(cls, level: Level, params: SolverParams) -> LevelProblem:
        """Gather the forms of a level."""
        weights = EdgeWeights(params.mu2, params.mu3, params.sigma_b, params.sigma_d)
        cost = edge_weights(level.image, level.depth, weights)
        # (34): grey levels to light, and a mean over the pixels as the data's mean over samples.
        share = level.image.size / level.depth.size / GREY_LEVELS**2
        form = share * smoothness_form(cost, level.depth, level.camera)
        return cls(level, motion_norm(level.depth, level.camera), form, params)

    def length(self, p: Vector) -> float:
        """Give the root mean square length of the flow [px]."""
        return math.sqrt(float(p @ self.norm @ p))

    def merit(self, state: State) -> float:
        """Give R(p): the lower, the better the motion explains the image for its length, (36)."""
        length = max(self.length(state.p), 1e-6)
        return state.energy / math.pow(length, 2 * self.share)

    def merit_of(self, p: Vector) -> float:
        """Give R of a motion that no image answers to yet."""
        return self.merit(self.answer(p))

    def answer(self, p: Vector, count: int | None = None) -> State:
        """Find the image for a motion, started at the blurred one: the image step, (31)."""
        params, light = self.params, self.level.image
        blur = blur_operator(Motion.from_vector(p), self.level.depth, self.level.camera)
        mu4, gamma = params.mu4 / GREY_LEVELS, params.gamma * GREY_LEVELS
        steps = PrimalDualSteps(mu4, params.eta, gamma, count or TURN_STEPS)
        latent = restore_by_primal_dual(blur.widen(light), light, blur, steps)
        residual = blur.apply(latent) - light
        terms = {
            'intensities': intensity_term(residual),
            'differences': difference_term(residual),
            'smoothness': smoothness_term(p, self.smoothness),
            'variation': variation_term(latent, mu4),
        }
        return State(p, blur, latent, terms)

    def take_turns(self, p: Vector, index: int, trace: list[EnergyStep]) -> tuple[Vector, float]:
        """Give the motion after the turns of this level, and the relative gain in R."""
        state = self.answer(p)
        first = self.merit(state)
        for turn in range(1, self.params.alternations + 1):
            mu1 = self.reward(state)
            new = self.lowered(state, mu1)
            if new is None:
                break
            for name, one in (('before', state), ('after', new)):
                trace.append(self.record(one, mu1, index, f'{name} turn {turn}'))
            state = new
        return state.p, first / self.merit(state) - 1

    @property
    def share(self) -> float:
        """Give rho: a motion is rewarded with rho E_L(p), (35)."""
        return REWARD * self.params.mu1 / REWARD_MU1

    def reward(self, state: State) -> float:
        """Give mu1 in units of E_L per px^2: mu1 |p|^2 = -rho E_L(p), (35)."""
        return -self.share * state.energy / self.length(state.p) ** 2

    def lowered(self, state: State, mu1: float) -> State | None:
        """Take one motion step after which the image answers; None when no step lowers (23)."""
        blurred = self.level.image
        problem = MotionProblem(state.latent, blurred, state.blur, self.norm, self.smoothness, mu1)
        tried: list[State] = [state]

        def total(one: State) -> float:
            return one.energy + mu1 * self.length(one.p) ** 2

        def energy(p: Vector) -> float:
            tried.append(self.answer(p))
            return total(tried[-1])

        def bowl(p: Vector) -> Bowl:
            return replace(problem.bowl(p, ANSWERING), value=total(state))

        steps = Steps(1, LONGEST_STEP, MOST_DAMPING)
        fit = levenberg_marquardt(state.p, bowl, energy, self.norm, steps)
        return tried[-1] if len(fit.energies) > 1 else None

    def record(self, state: State, mu1: float, index: int, step: str) -> EnergyStep:
        """Write down the terms of (23) in the paper's units."""
        terms = {**state.terms, 'motion': mu1 * self.length(state.p) ** 2}
        unit = GREY_LEVELS**2 / self.level.image.size
        return EnergyStep(index, step, {name: unit * value for name, value in terms.items()})
