"""
How the camera moves from frame to frame: velocity and acceleration, as a Gaussian estimate.

The scene's velocity u (6,) [rad/s, m/s] in the camera's frame changes by an acceleration that
forgets itself within MEMORY; what is measured is the way c between two frames, and u itself,
docs/method.md (43) to (45). Motion over an exposure T is T u.
[S70] Singer, IEEE Trans. AES 6, 1970: the model. [RTS65] Rauch, Tung & Striebel: looking ahead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
import math

from depth_deblur_ros.core.data import Vector
import numpy as np

MEMORY = 0.1  # s
RESTLESS = np.array([16.0, 5.0])  # rad/s^2, m/s^2; of a hand that shakes
CALMEST, WILDEST = RESTLESS / 2, 4 * RESTLESS
CALM_DOWN, STIR_UP = 0.1, 0.3  # powers of how far a way missed the expected one
FAST = np.repeat([3.0, 1.5], 3)  # rad/s, m/s; what a velocity may be before anything is seen
JUMP = 9.0  # times the expected squared miss, beyond which a velocity has jumped
ENDS = np.r_[:6, 18:24]  # what a way shows of (c, u, a, b)
POINTS = 16  # of the integral for the noise


@dataclass(frozen=True, eq=False)
class Way:
    """
    What was measured from one frame to the next, (n,), and its covariance (n, n).

    look (n, 12): it is look @ (c, b), of the way c and the mean acceleration b meanwhile; the
    first six are c but for a rolling shutter.
    """

    motion: Vector
    covariance: Vector
    look: Vector


@dataclass(frozen=True, eq=False)
class Glide:
    """Velocity u and acceleration at one time: mean (12,) and covariance (12, 12)."""

    mean: Vector
    covariance: Vector
    unrest: Vector  # (2,) standard deviation of the acceleration, of turns and of shifts

    @property
    def velocity(self) -> Vector:
        """Give u (6,)."""
        return self.mean[:6]

    @property
    def spread(self) -> Vector:
        """Give the covariance (6, 6) of u."""
        return self.covariance[:6, :6]

    @property
    def known(self) -> bool:
        """Tell whether anything was seen of the velocity yet."""
        return bool(self.spread[0, 0] < FAST[0] ** 2)

    def measured(self, velocity: Vector, covariance: Vector) -> Glide:
        """Take in a measured velocity (6,) with its covariance (6, 6)."""
        look = np.eye(6, 12)
        return self._updated(look, velocity - look @ self.mean, covariance)

    def moved(self, seconds: float, way: Way | None) -> Glide:
        """Go on in time, over a way that was measured or not."""
        return self.foreseen(seconds, way)[0]

    def foreseen(self, seconds: float, way: Way | None) -> tuple[Glide, float]:
        """Go on in time as moved; give also the log-likelihood of the way."""
        go, noise = _steps(seconds, self.unrest)
        mean, spread = go @ self.mean, go @ self.covariance @ go.T + noise
        unrest, likely = self.unrest, 0.0
        if way is not None:
            look = np.zeros((len(way.motion), 24))
            look[:, ENDS] = way.look
            seen = spread @ look.T
            miss, expected = way.motion - look @ mean, look @ seen + way.covariance
            off = float(miss @ np.linalg.solve(expected, miss))
            likely = -(off + float(np.linalg.slogdet(expected)[1])) / 2
            missed = _missed(miss, expected)
            if self.known and missed.max() > JUMP:
                return unknown_glide().foreseen(seconds, way)[0], likely
            unrest = _stirred(unrest, missed)
            gain = seen @ np.linalg.inv(expected)
            mean, spread = mean + gain @ miss, spread - gain @ seen.T
        return Glide(mean[6:18], _even(spread[6:18, 6:18]), unrest), likely

    def before(self, seconds: float, way: Way) -> Glide:
        """Learn about now from the way that will be gone in the time ahead [RTS65]."""
        go, noise = _steps(seconds, self.unrest)
        rest = way.look @ noise[np.ix_(ENDS, ENDS)] @ way.look.T
        look = way.look @ go[ENDS]
        return self._updated(look, way.motion - look @ self.mean, way.covariance + rest)

    def _updated(self, look: Vector, miss: Vector, covariance: Vector) -> Glide:
        seen = self.covariance @ look.T
        gain = seen @ np.linalg.inv(look @ seen + covariance)
        spread = self.covariance - gain @ seen.T
        return replace(self, mean=self.mean + gain @ miss, covariance=_even(spread))


def unknown_glide() -> Glide:
    """Give what is known of a camera before anything is seen."""
    spread = np.concatenate([FAST, np.repeat(RESTLESS, 3)])
    return Glide(np.zeros(12), np.diag(spread**2), RESTLESS)


def _missed(miss: Vector, expected: Vector) -> Vector:
    """Give how far turn and shift missed what was expected, (2,) mean squared, 1 as expected."""
    parts = (slice(0, 3), slice(3, 6))
    return np.array([miss[k] @ np.linalg.solve(expected[k, k], miss[k]) / 3 for k in parts])


def _stirred(unrest: Vector, missed: Vector) -> Vector:
    """Fit the unrest to how far turn and shift missed what was expected, (45)."""
    ratio = np.clip(missed, 0.1, 25)
    power = np.where(ratio > 1, STIR_UP, CALM_DOWN)
    return np.asarray(np.clip(unrest * ratio**power, CALMEST, WILDEST))


def _steps(seconds: float, unrest: Vector) -> tuple[Vector, Vector]:
    """Give what takes (u, a) to (c, u, a, b) `seconds` later, (24, 12), and its noise (24, 24)."""
    go, effect = _effects(seconds)
    size = np.diag(np.repeat(unrest**2, 3))
    return go, (effect[:, None, :, None] * size[:, None, :]).reshape(24, 24)


@lru_cache(maxsize=16)
def _effects(seconds: float) -> tuple[Vector, Vector]:
    """Give what takes (u, a) on, (24, 12), and the noise of one axis of unrest 1, (4, 4)."""
    way, speed, keep = _effect(seconds)
    parts = np.array([[seconds, way], [1, speed], [0, keep], [0, speed / seconds]])
    times = (np.arange(POINTS) + 0.5) * seconds / POINTS
    effect = np.array([_effect(float(t)) for t in times])
    effect = np.c_[effect, effect[:, 1] / seconds]
    noise = 2 / MEMORY * seconds / POINTS * effect.T @ effect
    return np.kron(parts, np.eye(6)), noise


def _effect(seconds: float) -> tuple[float, float, float]:
    """Give what an acceleration of 1 does after some time: way, speed, what is left of it."""
    keep = math.exp(-seconds / MEMORY)
    speed = MEMORY * (1 - keep)
    return MEMORY * (seconds - speed), speed, keep


def _even(covariance: Vector) -> Vector:
    return np.asarray((covariance + covariance.T) / 2)
