"""
How much time really lies between frames whose stamps jitter.

Cameras expose at even intervals, but many stamps are taken when an image has come through, some
milliseconds early or late. Between frames d seconds apart by their stamps lie n usual intervals
with n = round(d / usual), unless the stamps run away from that; docs/method.md (44).
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import accumulate
import math
import statistics

USUAL_S = 1 / 30  # frame interval before any is seen
REMEMBERED = 31  # intervals
ODD = 0.25  # share of the usual interval; stamps farther off are no jitter
RECENT = 4  # intervals over which jitter must cancel out


@dataclass(frozen=True)
class Cadence:
    """The intervals between the stamps of neighbouring frames that came last [s]."""

    intervals: tuple[float, ...] = ()

    def later(self, interval: float) -> Cadence:
        """Take one more interval in."""
        return Cadence((*self.intervals, interval)[-REMEMBERED:])

    @property
    def usual(self) -> float:
        """Give the usual interval [s]."""
        if not self.intervals:
            return USUAL_S
        middle = statistics.median(self.intervals)
        return sum(self.intervals) / sum(_times(d, middle) for d in self.intervals)

    @property
    def even(self) -> float:
        """Give the time between the last two frames, if frames are taken evenly [s]."""
        last, usual = self.intervals[-1], self.usual
        late = accumulate(_off(d, usual) for d in reversed(self.intervals[-RECENT:]))
        return usual * _times(last, usual) if max(map(abs, late)) < ODD * usual else last

    @property
    def doubt(self) -> float:
        """Give the relative standard deviation of the usual interval that jitter leaves."""
        usual = self.usual
        off = [min(abs(_off(d, usual)) / usual, ODD) for d in self.intervals]
        return math.hypot(*off) / math.sqrt(len(off)) / len(off) if off else 0.0


def _times(interval: float, usual: float) -> int:
    return max(1, round(interval / usual))


def _off(interval: float, usual: float) -> float:
    """Give how far an interval is from the nearest multiple of the usual one [s]."""
    return interval - usual * _times(interval, usual)
