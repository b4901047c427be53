"""
How the camera moves from frame to frame: velocity and acceleration, as a Gaussian estimate.

The scene's velocity u (6,) [rad/s, m/s] in the camera's frame changes by an acceleration that
forgets itself within MEMORY; what is measured is the way c between two frames, and u itself,
docs/method.md (43) to (45). Motion over an exposure T is T u.
[S70] Singer, IEEE Trans. AES 6, 1970: the model. [RTS65] Rauch, Tung & Striebel: looking ahead.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

from depth_deblur_ros.core.data import Vector
import numpy as np

MEMORY = 0.1  # s
RESTLESS = np.array([16.0, 5.0])  # rad/s^2, m/s^2; of a hand that shakes
CALMEST, WILDEST = RESTLESS / 2, 4 * RESTLESS
CALM_DOWN, STIR_UP = 0.1, 0.3  # powers of how far a way missed the expected one
FAST = np.repeat([3.0, 1.5], 3)  # rad/s, m/s; what a velocity may be before anything is seen
POINTS = 16  # of the integral for the noise


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

    def measured(self, velocity: Vector, covariance: Vector) -> Glide:
        """Take a measured velocity (6,) with its covariance (6, 6) in."""
        look = np.eye(6, 12)
        return self._updated(look, velocity - self.velocity, covariance)

    def moved(self, seconds: float, way: Vector | None, covariance: Vector | None) -> Glide:
        """Go on in time, over a way (6,) that was measured or not."""
        go, noise = _steps(seconds, self.unrest)
        mean, spread = go @ self.mean, go @ self.covariance @ go.T + noise
        unrest = self.unrest
        if way is not None and covariance is not None:
            miss, expected = way - mean[:6], spread[:6, :6] + covariance
            unrest = _stirred(unrest, miss, expected)
            gain = spread[:, :6] @ np.linalg.inv(expected)
            mean = mean + gain @ miss
            spread = spread - gain @ spread[:6]
        return Glide(mean[6:], _even(spread[6:, 6:]), unrest)

    def before(self, seconds: float, way: Vector, covariance: Vector) -> Glide:
        """Learn about now from the way (6,) that will be gone in the time ahead [RTS65]."""
        go, noise = _steps(seconds, self.unrest)
        look = go[:6]
        return self._updated(look, way - look @ self.mean, covariance + noise[:6, :6])

    def _updated(self, look: Vector, miss: Vector, covariance: Vector) -> Glide:
        seen = self.covariance @ look.T
        gain = seen @ np.linalg.inv(look @ seen + covariance)
        spread = self.covariance - gain @ seen.T
        return replace(self, mean=self.mean + gain @ miss, covariance=_even(spread))


def unknown_glide() -> Glide:
    """Give what is known of a camera before anything is seen."""
    spread = np.concatenate([FAST, np.repeat(RESTLESS, 3)])
    return Glide(np.zeros(12), np.diag(spread**2), RESTLESS)


def _stirred(unrest: Vector, miss: Vector, expected: Vector) -> Vector:
    """Fit the unrest to how far turn and shift missed what was expected, (45)."""
    parts = (slice(0, 3), slice(3, 6))
    off = [miss[k] @ np.linalg.solve(expected[k, k], miss[k]) / 3 for k in parts]
    ratio = np.clip(off, 0.1, 25)
    power = np.where(ratio > 1, STIR_UP, CALM_DOWN)
    return np.asarray(np.clip(unrest * ratio**power, CALMEST, WILDEST))


def _steps(seconds: float, unrest: Vector) -> tuple[Vector, Vector]:
    """Give what takes (u, a) to (c, u, a) `seconds` later, (18, 12), and its noise (18, 18)."""
    way, speed, keep = _effect(seconds)
    eye, zero = np.eye(6), np.zeros((6, 6))
    go = np.block([[seconds * eye, way * eye], [eye, speed * eye], [zero, keep * eye]])
    times = (np.arange(POINTS) + 0.5) * seconds / POINTS
    effect = np.array([_effect(float(t)) for t in times])
    noise = 2 / MEMORY * seconds / POINTS * effect.T @ effect
    return go, np.kron(noise, np.diag(np.repeat(unrest**2, 3)))


def _effect(seconds: float) -> tuple[float, float, float]:
    """Give what an acceleration of 1 does after some time: way, speed, what is left of it."""
    keep = math.exp(-seconds / MEMORY)
    speed = MEMORY * (1 - keep)
    return MEMORY * (seconds - speed), speed, keep


def _even(covariance: Vector) -> Vector:
    return np.asarray((covariance + covariance.T) / 2)
