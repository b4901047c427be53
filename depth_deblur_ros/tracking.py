"""
What one frame tells the next: the sign of the motion, the exposure, where to start.

The same for a recording, which may look one frame ahead, and for a live camera, which may not.
A frame goes through these steps, docs/method.md (40) to (53):
1 between.py: the motion from the last frame to this one, and on to the following one if known
2 glide.py: these and the past give the velocity u at this frame, with its covariance
3 the solver finds the motion p in the blur, u times the exposure being a further start
4 joining.py: p against u tells the sign, and the exposure where nobody does (shutter.py); both
  together are the motion; the image is restored anew where that is another one
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
import statistics
import time
from typing import Any, Protocol, runtime_checkable

from depth_deblur_ros.between import Between, motion_between, View, view_of
from depth_deblur_ros.core.data import DeblurResult, Motion, Outcome, RgbdFrame
from depth_deblur_ros.core.geometry import blur_length
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.core.solver import deblur, restore_known
from depth_deblur_ros.glide import unknown_glide
from depth_deblur_ros.gyro import Gyro
from depth_deblur_ros.joining import Context, GUESS, join
from depth_deblur_ros.shutter import Exposure, Shutter
import numpy as np

GAP_S = 0.25  # frames farther apart are not neighbours
USUAL_S = 1 / 30  # frame interval before any is seen
OTHER_PX = 1.0  # px; motions less apart than this give the same image
REMEMBERED = 31  # frame intervals that tell how even the stamps are


class Solver(Protocol):
    """What solves one frame alone: deblur, or something that stands in for it."""

    def __call__(
        self, frame: RgbdFrame, params: SolverParams, /, *, start: Motion | None = None
    ) -> DeblurResult:
        """Find the motion, and the sharp image if params want it."""


@runtime_checkable
class Memory(Protocol):
    """A solver that remembers something from frame to frame: what it needs to go on."""

    def state(self) -> Any:
        """Give all that is remembered, as something that can be pickled."""

    def restore(self, state: Any) -> None:
        """Remember this, and nothing else."""


@dataclass(frozen=True, eq=False)
class Tracked:
    """A frame's result as its neighbours see it, and its exposure, told or tracked."""

    result: DeblurResult
    exposure: Exposure | None


@dataclass(frozen=True, eq=False)
class Seen:
    """A frame as it is tracked, when it was, and the way to it from the one before."""

    view: View
    stamp_ns: int
    way: Between | None
    seconds: float | None  # since the one before; None where they are not neighbours


class Tracker:
    """Follows one camera frame by frame; used by one thread."""

    def __init__(self, solve: Solver = deblur) -> None:
        self._solve = solve
        self.gyro = Gyro()
        self._glide = unknown_glide()
        self._shutter = Shutter()
        self._last: Seen | None = None
        self._ahead: Seen | None = None
        self._intervals: deque[float] = deque(maxlen=REMEMBERED)

    def state(self) -> Any:
        """Give all that is remembered, as something that can be pickled."""
        frames = (self._last, self._ahead, list(self._intervals))
        own = (self._glide, self._shutter, frames, self.gyro.trial)
        return own, self._solve.state() if isinstance(self._solve, Memory) else None

    def restore(self, state: Any) -> None:
        """Remember this, and nothing else."""
        own, inner = state
        self._glide, self._shutter, frames, self.gyro.trial = own
        self._last, self._ahead, intervals = frames
        self._intervals = deque(intervals, maxlen=REMEMBERED)
        if isinstance(self._solve, Memory):
            self._solve.restore(inner)

    def follow(
        self, frame: RgbdFrame, params: SolverParams, following: RgbdFrame | None = None
    ) -> Tracked:
        """
        Solve a frame with what its neighbours tell.

        following: the next frame, where it is there already. Raises InputError as the solver does.
        """
        told = Exposure(frame.exposure) if frame.exposure else None
        if params.neighbours == 'ignore':
            return Tracked(self._solve(frame, params), told)
        began = time.monotonic()
        context = self._context(frame, following, told, params)
        spent = time.monotonic() - began
        alone = self._alone(frame, params, context.expected())
        joined = join(alone, context, frame.camera)
        self._shutter = joined.shutter
        if joined.velocity:
            self._glide = self._glide.measured(*joined.velocity)
        result = self._restored(frame, params, alone, joined.result)
        return Tracked(replace(result, seconds=result.seconds + spent), joined.exposure)

    def _context(
        self,
        frame: RgbdFrame,
        following: RgbdFrame | None,
        told: Exposure | None,
        params: SolverParams,
    ) -> Context:
        """Go on to a frame, look at the following one, ask the gyro."""
        seen = self._arrive(frame, params)
        glide, known = self._glide, seen.way is not None
        self._ahead = self._seen(following, seen) if following else None
        if self._ahead and self._ahead.way and self._ahead.seconds:
            way = self._uneven(self._ahead.way, self._ahead.seconds)
            glide = glide.before(self._ahead.seconds, way.motion, way.covariance)
            known = True
        context = Context(glide, self._shutter, told, self._interval(), known)
        return self._turned(frame.stamp_ns, context, params)

    def _turned(self, stamp_ns: int, context: Context, params: SolverParams) -> Context:
        """Let the gyro tell the turn over the exposure."""
        seconds = context.exposure.seconds if context.exposure else GUESS * context.interval
        turn = self.gyro.measured(stamp_ns, seconds, params)
        if turn is None:
            return context
        self._glide = self._glide.measured(*turn)
        return replace(context, glide=context.glide.measured(*turn), seen=True)

    def _arrive(self, frame: RgbdFrame, params: SolverParams) -> Seen:
        """Take a frame in: the velocity is then that at its stamp."""
        seen = self._ahead
        if seen is None or seen.stamp_ns != frame.stamp_ns:
            seen = self._seen(frame, self._last)
        self._last, self._ahead = seen, None
        if seen.seconds is None:
            self._glide = unknown_glide()
            self._shutter = self._shutter.later(gap=True)
            return seen
        self._intervals.append(seen.seconds)
        self._shutter = self._shutter.later()
        if seen.way:
            way = self._uneven(seen.way, seen.seconds)
            self._glide = self._glide.moved(seen.seconds, way.motion, way.covariance)
        else:
            self._glide = self._glide.moved(seen.seconds, None, None)
        first_ns = frame.stamp_ns - round(1e9 * seen.seconds)
        self.gyro.compare(first_ns, seen.way, seen.seconds, params)
        return seen

    def _seen(self, frame: RgbdFrame, before: Seen | None) -> Seen:
        """Look at a frame, and track from the one before if they are neighbours."""
        view, way, seconds = view_of(frame), None, None
        if before and 0 < frame.stamp_ns - before.stamp_ns <= GAP_S * 1e9:
            seconds = (frame.stamp_ns - before.stamp_ns) / 1e9
            way = motion_between(before.view, view)
        return Seen(view, frame.stamp_ns, way, seconds)

    def _interval(self) -> float:
        """Give the usual time between frames [s]."""
        return statistics.median(self._intervals) if self._intervals else USUAL_S

    def _uneven(self, way: Between, seconds: float) -> Between:
        """Give a way with the doubt that uneven stamps bring, (44)."""
        usual = self._interval()
        off = [abs(s - usual * max(1, round(s / usual))) for s in self._intervals]
        jitter = 1.5 * statistics.median(off) if off else 0.0
        along = (jitter / seconds) ** 2 * np.outer(way.motion, way.motion)
        return replace(way, covariance=way.covariance + along)

    def _alone(self, frame: RgbdFrame, params: SolverParams, start: Motion | None) -> DeblurResult:
        """Solve the frame by itself, from a further start where there is one."""
        return self._solve(frame, params, start=start) if start else self._solve(frame, params)

    def _restored(
        self, frame: RgbdFrame, params: SolverParams, alone: DeblurResult, result: DeblurResult
    ) -> DeblurResult:
        """Restore the image anew where the motion that was settled is not the frame's own."""
        wanted = params.mode != 'motion' and result.outcome is Outcome.SOLVED
        if self._solve is not deblur or not wanted:
            return result
        own, settled = alone.motion.vector, result.motion.vector
        off = min(blur_length(settled + s * own, result.depth, frame.camera) for s in (1, -1))
        if off < OTHER_PX:
            return result
        known = restore_known(replace(frame, depth=result.depth), result.motion, params)
        return replace(result, image=known.image, seconds=result.seconds + known.seconds)
