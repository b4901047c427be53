"""
Which mode keeps the solver within its deadline.

Down by one mode when most of the last frames were late; up again when the mode above can be
expected to be in time. What it costs is known from the step down: its time over that of the mode
below, each the median over some frames. Who falls back soon waits twice as long the next time.
"""

from __future__ import annotations

from collections import deque
from typing import Any

from depth_deblur_ros.core.data import DeblurResult, Outcome
from depth_deblur_ros.core.params import MODES
import numpy as np

LAST, LATE = 5, 3  # so many late ones among the last: down
WATCHED = 15  # frames in a mode before it may step up
LONGEST = 32 * WATCHED
ROOM = 0.75  # of the deadline that the mode above may be expected to need


class Pace:
    """The mode of each frame; deadline_s = 0: always the mode that was asked for."""

    def __init__(self, mode: str, deadline_s: float) -> None:
        self._ladder = MODES[MODES.index(mode) :]
        self._deadline_s = deadline_s
        self._step = 0
        self._times: deque[float] = deque(maxlen=WATCHED)
        self._frames = 0  # in this mode
        self._patience = WATCHED
        self._above = [0.0] * len(self._ladder)  # time of the mode above a step, when it was left
        self._cost = [0.0] * len(self._ladder)  # and over that of the step itself; 0 = unknown
        self.late = self.downs = self.ups = 0

    @property
    def mode(self) -> str:
        """The mode for the next frame."""
        return self._ladder[self._step]

    def note(self, mode: str, result: DeblurResult) -> None:
        """Learn from a frame; those without a motion say nothing, modes are alike for them."""
        if not self._deadline_s or mode != self.mode or result.outcome is not Outcome.SOLVED:
            return
        self._times.append(result.seconds)
        self._frames += 1
        self.late += result.seconds > self._deadline_s
        if self._frames == WATCHED:
            self._learn_cost()
        last = list(self._times)[-LAST:]
        if sum(t > self._deadline_s for t in last) >= LATE:
            self._down()
        elif self._has_room():
            self._go(-1)
            self.ups += 1

    def values(self) -> dict[str, Any]:
        """Give what is to be told: the mode in use and how often it changed."""
        if not self._deadline_s:
            return {'mode in use': self.mode}
        return {
            'mode in use': self.mode,
            'deadline [s]': f'{self._deadline_s:g}',
            'later than the deadline': self.late,
            'mode stepped down': self.downs,
            'mode stepped up': self.ups,
        }

    def _learn_cost(self) -> None:
        if not self._cost[self._step]:
            self._cost[self._step] = max(1.0, self._above[self._step] / self._median())

    def _down(self) -> None:
        if self._step + 1 == len(self._ladder):
            return
        self._learn_cost()
        soon = self.ups > 0 and self._frames < 2 * self._patience
        self._patience = min(2 * self._patience, LONGEST) if soon else WATCHED
        time = self._median()
        self._go(1)
        self._above[self._step], self._cost[self._step] = time, 0.0
        self.downs += 1

    def _has_room(self) -> bool:
        if self._step == 0 or self._frames < self._patience:
            return False
        return self._median() * self._cost[self._step] < ROOM * self._deadline_s

    def _go(self, steps: int) -> None:
        self._step += steps
        self._times.clear()
        self._frames = 0

    def _median(self) -> float:
        return max(float(np.median(self._times)), 1e-6)
