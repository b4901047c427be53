"""
One frame's blur beside what its neighbours say: sign, exposure, and the motion of both together.

Notation: p (6,) motion over the exposure from the blur, C its covariance; u (6,) velocity from the
neighbours, P its covariance; T the exposure. docs/method.md (47) to (53).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

from depth_deblur_ros.core.data import CameraIntrinsics, DeblurResult, Motion, Outcome, Vector
from depth_deblur_ros.core.evidence import motion_axes
from depth_deblur_ros.core.geometry import blur_length
from depth_deblur_ros.glide import Glide
from depth_deblur_ros.shutter import agree, Exposure, Shutter
import numpy as np

SURE = 6.0  # log-odds at which the sign is told
CLEAR = 16.0  # squared distance from zero at which neighbours may claim a motion
TINY = 1e-12
ODD = 40.0  # squared distance in 5 dimensions beyond which p and u do not belong together
GUESS = 0.5  # exposures per frame interval, before any is known; and how doubtful that is
LONGEST = 1.15  # exposures per frame interval that are possible
REAL = 2.0  # times the solver's covariance: lenses, shutters and paths are not ideal
FLOOR_PX = 0.3  # px; standard deviation of p along each of its axes that stays
INEXACT_PX = 0.4  # px; that of the length of a blur
TOLD_DOUBT = 0.1  # relative; how exact an exposure is that is told
VISIBLE_PX = 0.1  # px; least blur that neighbours may claim where the image alone shows none
SHARP_PX, SHARP_DOUBT = 2.0, 0.25  # px, relative; blur of a picture that looks sharp
CLAIM_PX = 4.0  # px; most blur that they may claim where the image looks sharp
VAGUE = 0.6  # doubt of an exposure beyond which nothing can be claimed
UNSEEN = 0.75  # m/s; standard deviation of a shift that only its prior tells
WORD = 0.5  # quality of a motion that only the neighbours tell


@dataclass(frozen=True, eq=False)
class Context:
    """
    What the neighbours tell: velocity, exposure, frame interval [s], and whether they saw.

    reading: s from one row's exposure to that of the row whose yn is larger by 1.
    """

    glide: Glide
    shutter: Shutter
    told: Exposure | None
    interval: float
    seen: bool
    reading: float
    now: Exposure | None = None  # of this frame alone, where it differs from the shutter's

    @property
    def exposure(self) -> Exposure | None:
        """Give the exposure as far as it is known."""
        return self.told or self.now or self.shutter.exposure

    def expected(self) -> Motion | None:
        """Give the motion over the exposure that the neighbours lead to expect."""
        if not self.seen:
            return None
        seconds = self.exposure.seconds if self.exposure else GUESS * self.interval
        return self.blur(seconds)

    def over(self, seconds: float) -> tuple[Vector, Vector]:
        """Give the motion (6,) over a time, and its covariance (6, 6)."""
        return seconds * self.glide.velocity, seconds**2 * self.glide.spread

    def blur(self, seconds: float) -> Motion:
        """Give the motion that the blur of an exposure shows."""
        p, spread = self.over(seconds)
        rolling = seconds * self.reading * self.glide.mean[6:9]
        return Motion.from_vector(np.concatenate([p, rolling]), spread)


@dataclass(frozen=True, eq=False)
class Joined:
    """
    A frame's result and exposure, and what its blur tells of the shutter and the velocity.

    seen: the motion that its blur shows.
    """

    result: DeblurResult
    exposure: Exposure | None
    shutter: Shutter
    seen: Motion | None = None
    velocity: tuple[Vector, Vector] | None = None  # (6,) and (6, 6)


def join(result: DeblurResult, context: Context, camera: CameraIntrinsics) -> Joined:
    """Put a frame's result beside its neighbours."""
    if result.sign_resolved or not context.seen:
        return Joined(result, context.exposure, context.shutter)
    if result.outcome is not Outcome.SOLVED:
        return _claimed(result, _shortened(result, context, camera), camera)
    axes = motion_axes(result.depth, camera)[:6, :6]
    covariance = REAL * result.motion.covariance + FLOOR_PX**2 * axes @ axes.T
    found = _measured(result.motion.vector, covariance, context)
    if found is None:
        return _claimed(result, context, camera)
    if found.seconds < 0:
        result = replace(result, motion=_reverse(result.motion))
    motion = result.motion.vector
    doubt = math.hypot(found.doubt, INEXACT_PX / result.blur_px)
    length = Exposure(abs(found.seconds), doubt)
    shutter, exposure = context.shutter, context.told
    if exposure is None:
        shutter, exposure = shutter.measured(length)
    elif not agree(replace(exposure, doubt=TOLD_DOUBT), length):
        return Joined(_signed(result, result.motion), exposure, shutter)
    along = np.outer(motion, motion) * exposure.doubt**2
    velocity = (motion / exposure.seconds, (covariance + along) / exposure.seconds**2)
    context = replace(context, glide=context.glide.measured(*velocity))
    p, spread = context.over(exposure.seconds)
    settled = replace(result.motion, theta=p[:3], v=p[3:], covariance=spread)
    joined = replace(_signed(result, settled), blur_px=blur_length(p, result.depth, camera))
    return Joined(joined, exposure, shutter, context.blur(exposure.seconds), velocity)


def _shortened(result: DeblurResult, context: Context, camera: CameraIntrinsics) -> Context:
    """Take it for a short exposure where the image stays sharp in spite of the motion, (52)."""
    u, exposure = context.glide.velocity, context.exposure
    sure = float(u @ np.linalg.solve(context.glide.spread, u)) > CLEAR
    if context.told or not sure or result.outcome is not Outcome.SHARP:
        return context
    rate = blur_length(u, result.depth, camera)  # px/s
    longest = exposure.seconds if exposure else context.interval
    if rate * longest >= CLAIM_PX:
        now = Exposure(SHARP_PX / rate, SHARP_DOUBT)
        return replace(context, shutter=context.shutter.measured(now)[0], now=now)
    guess = Exposure(min(SHARP_PX / rate, GUESS * context.interval), GUESS)
    return context if exposure else replace(context, now=guess)


def _measured(p: Vector, covariance: Vector, context: Context) -> Exposure | None:
    """Give T of p = T u, negative where p is the reverse; None where they do not match, (47)."""
    known, shown = context.exposure, context.blur(1.0)
    seconds, u = known.seconds if known else GUESS * context.interval, shown.vector
    weight = np.linalg.inv(covariance + seconds**2 * shown.covariance)
    information = float(u @ weight @ u)
    length = float(p @ weight @ u) / max(information, TINY)
    miss = p - length * u
    if float(miss @ weight @ miss) > ODD or abs(length) > LONGEST * context.interval:
        return None
    spread = 1 / math.sqrt(max(information, TINY))
    expected = known.seconds if known and known.doubt < VAGUE else abs(length) / 2
    if 2 * abs(length) * expected < SURE * spread**2:
        return None
    return Exposure(length, spread / abs(length))


def _signed(result: DeblurResult, motion: Motion) -> DeblurResult:
    return replace(result, motion=motion, sign_resolved=True)


def _reverse(motion: Motion) -> Motion:
    return Motion.from_vector(-motion.by_rows, motion.covariance)


def _without_unseen(p: Vector, covariance: Vector, seconds: float) -> tuple[Vector, Vector]:
    """Tell no shift where nobody has seen one, as where a gyro alone tells the turn."""
    if np.sqrt(np.trace(covariance[3:, 3:]) / 3) < UNSEEN * seconds:
        return p, covariance
    shift = np.concatenate([np.zeros(3), p[3:]])
    return p - shift, covariance + np.outer(shift, shift)


def _claimed(result: DeblurResult, context: Context, camera: CameraIntrinsics) -> Joined:
    """Give a frame that shows no motion by itself the one its neighbours tell, if any, (53)."""
    exposure = context.exposure
    unclaimed = Joined(result, exposure, context.shutter)
    if exposure is None or exposure.doubt > VAGUE:
        return unclaimed
    p, covariance = _without_unseen(*context.over(exposure.seconds), exposure.seconds)
    blur_px = blur_length(p, result.depth, camera)
    most = CLAIM_PX if result.outcome is Outcome.SHARP else math.inf
    sure = float(p @ np.linalg.solve(covariance, p)) > CLEAR
    if not (sure and VISIBLE_PX <= blur_px <= most):
        return unclaimed
    covariance = covariance + exposure.doubt**2 * np.outer(p, p)
    claimed = replace(result, outcome=Outcome.SOLVED, quality=WORD, blur_px=blur_px)
    seen = context.blur(exposure.seconds)
    told = _signed(claimed, Motion.from_vector(p, covariance))
    return Joined(told, exposure, context.shutter, seen)
