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

    look (..., n, 12): it is look @ (c, b), of the way c and the mean acceleration b meanwhile; the
    first six are c but for a rolling shutter.
    """

    motion: Vector
    covariance: Vector
    look: Vector


@dataclass(frozen=True, eq=False)
class Glide:
    """
    Velocity u and acceleration at one time: mean (12,) and covariance (12, 12).

    Or several side by side, (..., 12) and (..., 12, 12), which `foreseen` takes on together.
    """

    mean: Vector
    covariance: Vector
    unrest: Vector  # (..., 2) standard deviation of the acceleration, of turns and of shifts

    @property
    def velocity(self) -> Vector:
        """Give u (6,)."""
        return self.mean[:6]

    @property
    def spread(self) -> Vector:
        """Give the covariance (6, 6) of u."""
        return self.covariance[:6, :6]

    def measured(self, velocity: Vector, covariance: Vector) -> Glide:
        """Take in a measured velocity (6,) with its covariance (6, 6)."""
        look = np.eye(6, 12)
        return self._updated(look, velocity - look @ self.mean, covariance)

    def moved(self, seconds: float, way: Way | None) -> Glide:
        """Go on in time, over a way that was measured or not."""
        return self.foreseen(seconds, way)[0]

    def foreseen(self, seconds: float, way: Way | None) -> tuple[Glide, Vector]:
        """Go on in time as moved; give also the log-likelihood (...) of the way."""
        go, noise = _steps(seconds, self.unrest)
        mean, spread = self.mean @ go.T, go @ self.covariance @ go.T + noise
        if way is None:
            return _ended(mean, spread, self.unrest), np.zeros(mean.shape[:-1])
        look = np.zeros((*way.look.shape[:-1], 24))
        look[..., ENDS] = way.look
        seen = spread @ _transposed(look)
        miss, expected = way.motion - _times(look, mean), look @ seen + way.covariance
        off = (miss * _solved(expected, miss)).sum(-1)
        missed, gain = _missed(miss, expected), seen @ np.linalg.inv(expected)
        mean, spread = mean + _times(gain, miss), spread - gain @ _transposed(seen)
        found = _ended(mean, spread, _stirred(self.unrest, missed))
        known = self.covariance[..., 0, 0] < FAST[0] ** 2  # anything was seen of the velocity yet
        jumped = known & (missed.max(-1) > JUMP)
        if jumped.any():
            fresh, _ = unknown_glide().foreseen(seconds, way)
            found = _either(jumped, fresh, found)
        return found, -(off + np.linalg.slogdet(expected)[1]) / 2

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


def _ended(mean: Vector, spread: Vector, unrest: Vector) -> Glide:
    """Forget the way, and the acceleration on it."""
    return Glide(mean[..., 6:18], _even(spread[..., 6:18, 6:18]), unrest)


def _either(first: Vector, one: Glide, other: Glide) -> Glide:
    """Choose the first of two glides where that is said (...)."""
    here = first[..., None]
    return Glide(
        np.where(here, one.mean, other.mean),
        np.where(here[..., None], one.covariance, other.covariance),
        np.where(here, one.unrest, other.unrest),
    )


def _times(matrix: Vector, vector: Vector) -> Vector:
    return np.asarray((matrix @ vector[..., None])[..., 0])


def _solved(matrix: Vector, vector: Vector) -> Vector:
    return np.asarray(np.linalg.solve(matrix, vector[..., None])[..., 0])


def _missed(miss: Vector, expected: Vector) -> Vector:
    """Give how far turn and shift missed what was expected, (..., 2) mean squared, 1 as that."""
    parts = [
        (miss[..., k] * _solved(expected[..., k, k], miss[..., k])).sum(-1) / 3
        for k in (slice(0, 3), slice(3, 6))
    ]
    return np.stack(parts, -1)


def _stirred(unrest: Vector, missed: Vector) -> Vector:
    """Fit the unrest to how far turn and shift missed what was expected, (45)."""
    ratio = np.clip(missed, 0.1, 25)
    power = np.where(ratio > 1, STIR_UP, CALM_DOWN)
    return np.asarray(np.clip(unrest * ratio**power, CALMEST, WILDEST))


def _steps(seconds: float, unrest: Vector) -> tuple[Vector, Vector]:
    """Give what takes (u, a) to (c, u, a, b) later, (24, 12), and its noise (..., 24, 24)."""
    go, effect = _effects(seconds)
    size = np.repeat(unrest**2, 3, axis=-1)[..., None] * np.eye(6)
    noise = effect[:, None, :, None] * size[..., None, :, None, :]
    return go, noise.reshape(*unrest.shape[:-1], 24, 24)


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
    return np.asarray((covariance + _transposed(covariance)) / 2)


def _transposed(matrix: Vector) -> Vector:
    return matrix.swapaxes(-1, -2)
