"""
What one frame tells the next: the sign of the motion, the exposure, where to start.

The same for a recording, which may look one frame ahead, and for a live camera, which may not.
A frame goes through these steps, docs/method.md (40) to (58):
1 between.py: the motion from the last frame to this one, and on to the following one if known
2 glide.py: these and the past give the velocity u at this frame, with its covariance, seen
  through a shutter that may roll and stamps that may jitter (habits.py, cadence.py)
3 the solver finds the motion p in the blur, u times the exposure being a further start
4 joining.py: p against u tells the sign, and the exposure where nobody does (shutter.py), as
  changes of sharpness do (softening.py); both together are the motion; the image is restored
  anew where that is another one
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math
import time
from typing import Any, Protocol, runtime_checkable

from depth_deblur_ros.between import Between, motion_between, View, view_of
from depth_deblur_ros.cadence import Cadence
from depth_deblur_ros.core.data import DeblurResult, Motion, Outcome, RgbdFrame, Vector
from depth_deblur_ros.core.geometry import blur_length
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.core.solver import deblur, restore_known
from depth_deblur_ros.core.threads import at_most
from depth_deblur_ros.glide import Glide, unknown_glide, Way
from depth_deblur_ros.gyro import Gyro
from depth_deblur_ros.habits import Habits
from depth_deblur_ros.joining import Context, GUESS, join, Joined, LONGEST
from depth_deblur_ros.shutter import Exposure, Shutter
from depth_deblur_ros.softening import exposure_from_softness

GAP_S = 0.25  # frames farther apart are not neighbours
SHORTEST_NS = 1_000_000  # between frames
AFTER = {'start': 0.5, 'middle': 0.0, 'end': -0.5}  # exposures from a stamp to mid-exposure
OTHER_PX = 1.0  # px; motions less apart than this give the same image


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
    """A frame as it is tracked, its stamp and middle, and the way to it from the one before."""

    view: View
    stamp_ns: int
    middle_ns: int
    between: Between | None
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
        self._past: tuple[View, Vector] | None = None  # the frame before that, and its velocity
        self._cadence, self._habits = Cadence(), Habits()

    def state(self) -> Any:
        """Give all that is remembered, as something that can be pickled."""
        frames = (self._last, self._ahead, self._past, self._cadence, self._habits)
        own = (self._glide, self._shutter, frames, self.gyro.trial)
        return own, self._solve.state() if isinstance(self._solve, Memory) else None

    def restore(self, state: Any) -> None:
        """Remember this, and nothing else."""
        own, inner = state
        self._glide, self._shutter, frames, self.gyro.trial = own
        self._last, self._ahead, self._past, self._cadence, self._habits = frames
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
        with at_most(params.threads):
            context = self._context(frame, following, told, params)
        spent = time.monotonic() - began
        alone = self._alone(frame, params, context.expected())
        joined = join(alone, context, frame.camera)
        self._shutter = joined.shutter
        if joined.velocity:
            self._glide = self._glide.measured(*joined.velocity)
        result = self._restored(frame, params, alone, joined)
        return Tracked(replace(result, seconds=result.seconds + spent), joined.exposure)

    def _context(
        self,
        frame: RgbdFrame,
        following: RgbdFrame | None,
        told: Exposure | None,
        params: SolverParams,
    ) -> Context:
        """Go on to a frame, look at the following one, ask the gyro."""
        before = self._last, self._glide
        seen = self._arrive(frame, params)
        glide, known = self._glide, seen.between is not None
        self._ahead = self._seen(following, seen, params) if following else None
        if self._ahead and self._ahead.between and self._ahead.seconds:
            cadence = self._cadence.later(self._ahead.seconds)
            glide = glide.before(*self._way(self._ahead.between, cadence))
            known = True
        if told is None:
            self._compare(before, seen, glide.velocity if self._ahead else None)
        heights = frame.camera.fy / frame.camera.height  # from a row to that at yn + 1
        reading = self._habits.readout * self._cadence.usual * heights
        context = Context(glide, self._shutter, told, self._cadence.usual, known, reading)
        return self._turned(frame.stamp_ns, context, params)

    def _compare(self, before: tuple[Seen | None, Glide], seen: Seen, now: Vector | None) -> None:
        """
        Let the change of sharpness tell the exposure, (58).

        Of this frame against the last one where its velocity (6,) now is known from both sides,
        else of the last one against the one before that.
        """
        last, glide = before
        past, self._past = self._past, None
        if last is None or seen.between is None:
            return
        then = glide.before(*self._way(seen.between, self._cadence)).velocity
        self._past = here = (last.view, then)
        if now is not None:
            ends, way = (here, (seen.view, now)), seen.between.motion
        elif past and last.between:
            ends, way = (past, here), last.between.motion
        else:
            return
        longest = LONGEST * self._cadence.usual
        found = exposure_from_softness(*ends, way, known=self._shutter.exposure, longest=longest)
        if found:
            self._shutter = self._shutter.measured(found)[0]

    def _turned(self, stamp_ns: int, context: Context, params: SolverParams) -> Context:
        """Let the gyro tell the turn over the exposure."""
        seconds = context.exposure.seconds if context.exposure else GUESS * context.interval
        turn = self.gyro.measured(_middle_ns(stamp_ns, seconds, params), seconds, params)
        if turn is None:
            return context
        self._glide = self._glide.measured(*turn)
        return replace(context, glide=context.glide.measured(*turn), seen=True)

    def _arrive(self, frame: RgbdFrame, params: SolverParams) -> Seen:
        """Take a frame in: the velocity is then that at its stamp."""
        seen = self._ahead
        if seen is None or seen.stamp_ns != frame.stamp_ns:
            seen = self._seen(frame, self._last, params)
        self._last, self._ahead = seen, None
        if seen.seconds is None:
            self._glide, self._habits = unknown_glide(), self._habits.parted()
            self._shutter = self._shutter.later(gap=True)
            return seen
        self._cadence = self._cadence.later(seen.seconds)
        self._habits = self._habits.moved(self._cadence, seen.between)
        self._shutter = self._shutter.later()
        seconds, way = self._seconds(self._cadence)[0], None
        if seen.between:
            seconds, way = self._way(seen.between, self._cadence)
        self._glide = self._glide.moved(seconds, way)
        first_ns = seen.middle_ns - round(1e9 * seconds)
        self.gyro.compare(first_ns, seen.between, seconds, params)
        return seen

    def _seen(self, frame: RgbdFrame, before: Seen | None, params: SolverParams) -> Seen:
        """Look at a frame, and track from the one before if they are neighbours."""
        view, way, seconds = view_of(frame), None, None
        middle_ns = _middle_ns(frame.stamp_ns, frame.exposure or 0.0, params)
        if before and 0 < frame.stamp_ns - before.stamp_ns <= GAP_S * 1e9:
            way = motion_between(before.view, view)
            seconds = max(middle_ns - before.middle_ns, SHORTEST_NS) / 1e9
        return Seen(view, frame.stamp_ns, middle_ns, way, seconds)

    def _seconds(self, cadence: Cadence) -> tuple[float, float]:
        """Give the time between the last two frames of a cadence, and its relative doubt, (44)."""
        stamped, even = cadence.intervals[-1], cadence.even
        share = self._habits.evenness
        seconds = stamped + share * (even - stamped)
        either = math.sqrt(share * (1 - share)) * (even - stamped) / seconds
        return seconds, math.hypot(either, share * cadence.doubt)

    def _way(self, between: Between, cadence: Cadence) -> tuple[float, Way]:
        """Give the time between the last two frames of a cadence, and the way that was gone."""
        seconds, doubt = self._seconds(cadence)
        return seconds, between.way(seconds, self._habits.readout * cadence.usual, doubt)

    def _alone(self, frame: RgbdFrame, params: SolverParams, start: Motion | None) -> DeblurResult:
        """Solve the frame by itself, from a further start where there is one; see `_restored`."""
        if self._solve is deblur:
            return deblur(frame, params, start=start, restore=False)
        return self._solve(frame, params, start=start) if start else self._solve(frame, params)

    def _restored(
        self, frame: RgbdFrame, params: SolverParams, alone: DeblurResult, joined: Joined
    ) -> DeblurResult:
        """Restore the image under the frame's own motion, or the settled one if that differs."""
        result, motion = joined.result, alone.motion
        wanted = params.mode != 'motion' and result.outcome is Outcome.SOLVED
        if self._solve is not deblur or not wanted:
            return result
        if joined.seen is not None:
            own, settled = motion.vector, joined.seen.vector
            apart = (settled + s * own for s in (1, -1))
            off = min(blur_length(p, result.depth, frame.camera) for p in apart)
            motion = joined.seen if off >= OTHER_PX else motion
        if motion is alone.motion and alone.outcome is not Outcome.SOLVED:
            return result
        known = restore_known(replace(frame, depth=result.depth), motion, params)
        return replace(result, image=known.image, seconds=result.seconds + known.seconds)


def _middle_ns(stamp_ns: int, exposure: float, params: SolverParams) -> int:
    """Give the middle of an exposure [s]."""
    return stamp_ns + round(1e9 * AFTER[params.stamp_at] * exposure)
