"""
How long the shutter is open, where nobody tells: a slowly changing estimate that follows steps.

Each frame with a known velocity measures it as the length of its blur over that velocity,
docs/method.md (47) to (50). Auto exposure changes it slowly or in steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
import math

DRIFT = 0.03  # of log exposure, standard deviation from one frame to the next
FORGET = 0.2  # the same over a gap
FAR = 3.0  # standard deviations; exposures farther apart differ
UNEVEN = 0.03  # least standard deviation of log exposure: errors of neighbours are alike
RECENT = 4  # frames that may speak for a step


@dataclass(frozen=True)
class Exposure:
    """An exposure [s] and its relative standard deviation, 0 where it was told."""

    seconds: float
    doubt: float = 0.0


@dataclass(frozen=True)
class Miss:
    """What one frame measured, and how far off the expected that was, in standard deviations."""

    found: Exposure
    off: float


@dataclass(frozen=True)
class Shutter:
    """The exposure as it seems, and how the last frames missed it."""

    exposure: Exposure | None = None
    misses: tuple[Miss, ...] = ()

    def measured(self, found: Exposure) -> tuple[Shutter, Exposure]:
        """Take one frame's exposure in; give what now seems and what counts for that frame."""
        found = Exposure(found.seconds, max(found.doubt, UNEVEN))
        if self.exposure is None:
            return Shutter(found), found
        miss = Miss(found, _apart(found, self.exposure))
        misses = (*self.misses, miss)[-RECENT:]
        for count in range(2, len(misses) + 1):
            last = misses[-count:]
            side = math.copysign(1, miss.off)
            # Each must be off to the same side by itself: their mean is the new exposure.
            if all(side * m.off > 1 for m in last) and _sum(last) > FAR * math.sqrt(count):
                stepped = _mean([m.found for m in last])
                return Shutter(stepped), stepped
        if abs(miss.off) > FAR:
            return Shutter(self.exposure, misses), found
        met = _mean([self.exposure, found])
        return Shutter(met, misses), met

    def later(self, gap: bool = False) -> Shutter:
        """Give what is known of the next frame's exposure."""
        if self.exposure is None:
            return self
        doubt = math.hypot(self.exposure.doubt, FORGET if gap else DRIFT)
        return Shutter(Exposure(self.exposure.seconds, doubt), self.misses)


def agree(one: Exposure, other: Exposure) -> bool:
    """Tell whether two exposures may be the same."""
    return abs(_apart(one, other)) <= FAR


def _apart(one: Exposure, other: Exposure) -> float:
    """Give how much longer one exposure is than the other, in standard deviations."""
    return math.log(one.seconds / other.seconds) / math.hypot(one.doubt, other.doubt)


def _sum(misses: Sequence[Miss]) -> float:
    return abs(sum(m.off for m in misses))


def _mean(exposures: Sequence[Exposure]) -> Exposure:
    """Give the weighted mean."""
    weights = [1 / max(e.doubt, 1e-6) ** 2 for e in exposures]
    logs = [math.log(e.seconds) for e in exposures]
    log = sum(w * x for w, x in zip(weights, logs, strict=True)) / sum(weights)
    return Exposure(math.exp(log), max(1 / math.sqrt(sum(weights)), UNEVEN))
