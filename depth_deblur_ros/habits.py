"""
What a camera's frames show of the camera itself: whether its shutter rolls, what its stamps mean.

Some assumptions about both are followed side by side, each with the velocity that the ways between
frames tell under it; the better a way was foreseen, the likelier is the assumption,
docs/method.md (46). A shutter that rolls from the last row to the first has a readout below zero.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import product

from depth_deblur_ros.between import Between
from depth_deblur_ros.cadence import Cadence
from depth_deblur_ros.core.data import Vector
from depth_deblur_ros.glide import Glide, unknown_glide
import numpy as np

STEP = 0.3
# Of all rows, in frame intervals; none is longer than one.
READOUTS: Vector = STEP * np.arange(-4.0, 5.0)
EVEN = (0.0, 1.0)  # whether frames are taken evenly, whatever their stamps say
ASSUMED = np.array(list(product(READOUTS, EVEN)))
PLAIN = 3.0  # log-odds of a shutter that does not roll, before anything is seen
UNLIKELY = 200.0  # log-odds; no assumption is ever less likely


@dataclass(frozen=True, eq=False)
class Habits:
    """
    The velocity under each assumption, and how likely it is: logs (n,), the best 0.

    glides: of all readouts side by side, for each of EVEN.
    """

    glides: tuple[Glide, ...] = (unknown_glide(),) * len(EVEN)
    logs: Vector = field(default_factory=lambda: -PLAIN * (ASSUMED[:, 0] != 0))

    @property
    def readout(self) -> float:
        """Give how long the shutter takes from the first row to the last, in frame intervals."""
        logs = np.logaddexp.reduce(self.logs.reshape(len(READOUTS), len(EVEN)), axis=1)
        best = int(np.clip(np.argmax(logs), 1, len(READOUTS) - 2))
        before, top, after = logs[best - 1 : best + 2]
        peak = (before - after) / 2 / (before - 2 * top + after)  # of a parabola, in steps
        plain = np.exp(logs[len(READOUTS) // 2] - np.logaddexp.reduce(logs))
        return float(np.clip((1 - plain) * (READOUTS[best] + STEP * peak), -1, 1))

    @property
    def evenness(self) -> float:
        """Give how likely it is that frames are taken evenly, whatever their stamps say."""
        weights = np.exp(self.logs - self.logs.max())
        return float(weights @ ASSUMED[:, 1] / weights.sum())

    def parted(self) -> Habits:
        """Go on after a gap."""
        return Habits(logs=self.logs)

    def moved(self, cadence: Cadence, between: Between | None) -> Habits:
        """Go on to the next frame."""
        glides, logs, readouts = [], [], READOUTS * cadence.usual
        for glide, even in zip(self.glides, EVEN, strict=True):
            seconds = cadence.even if even else cadence.intervals[-1]
            way = between.way(seconds, readouts, 0.0) if between else None
            moved, likely = glide.foreseen(seconds, way)
            glides.append(moved)
            logs.append(np.broadcast_to(likely, len(READOUTS)))
        summed = self.logs + np.stack(logs, 1).ravel()
        return Habits(tuple(glides), np.maximum(summed - summed.max(), -UNLIKELY))
