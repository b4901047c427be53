"""
The live node without ROS: messages come in by role, one worker solves, results go to an outlet.

Two locks: _gate guards the counts and is held shortly, so that callbacks never wait; _sending is
held while a result goes out, so that whoever stops the work leaves none half sent.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
import threading
import time
from typing import Any, Protocol

from depth_deblur_ros.core.data import check_exposure, InputError
from depth_deblur_ros.frames import Pair, solve_anyhow, SolvedPair
from depth_deblur_ros.health import Health, Stream
from depth_deblur_ros.live import Intake, Worker
from depth_deblur_ros.messages import Fields, stamp_ns
from depth_deblur_ros.pace import Pace
from depth_deblur_ros.settings import Settings
from depth_deblur_ros.tracking import Solver, Tracker


class Outlet(Protocol):
    """Where results go; all is called by the worker's thread, warn by others too."""

    def wants_pictures(self) -> bool:
        """Whether anybody looks at the images, or at the motion alone."""

    def publish(self, solved: SolvedPair) -> float:
        """Send what is said about a pair; give its age then [s]."""

    def warn(self, text: str) -> None:
        """Tell the user."""


class Pipeline:
    """From messages to results; `settings` may be replaced at any time, for the next frame."""

    def __init__(
        self, settings: Settings, outlet: Outlet, solve: Solver, first: Callable[[], None]
    ) -> None:
        self._settings = settings
        self._outlet, self._tracker = outlet, Tracker(solve)
        self._gate, self._sending = threading.Lock(), threading.Lock()
        self._intake = Intake(settings.node.sync_slop_s)
        self._health = Health(self._intake)
        self._pace = _pace(settings)
        self._first = first
        self._worker = Worker(self._intake.mailbox, self._work, self._prepare)

    def use(self, settings: Settings) -> None:
        """Take settings for the next frame."""
        before, self._settings = self._settings, settings
        deadlines = {s.node.deadline_ms for s in (before, settings)}
        if before.solver != settings.solver or len(deadlines) > 1:
            self._pace = _pace(settings)
        self._intake.change_slop(settings.node.sync_slop_s)

    def begin(self) -> None:
        """Count silence from now on."""
        self._health.began = time.monotonic()

    def stream(self, role: str, topic: str, needed: bool) -> Stream:
        """Give what is counted of the messages of a role, now from this topic."""
        return self._health.stream(role, topic, needed)

    def take(self, role: str, msg: Any, came_ns: int | None = None) -> None:
        """Take a message in that came at this time since 1970 [ns]; None: now."""
        came_ns = came_ns or time.time_ns()
        with self._gate:
            if role == 'colour':
                self._intake.push_colour(msg, came_ns)
            elif role == 'depth':
                self._intake.push_depth(msg)
            elif role == 'imu':
                self._tracker.gyro.take(msg)
            elif role == 'camera_info':
                self._intake.infos.push(msg)
            else:
                self._take_exposure(float(msg.data), came_ns)
            self._health.arrived(role, time.monotonic())

    def count_publishers(self, count: Callable[[str], int]) -> None:
        """Let count tell how many publish on each topic."""
        for stream in self._health.streams.values():
            stream.publishers = count(stream.topic)

    def settle(self) -> bool:
        """Pair what has waited long enough with the depth there is; give whether any waits."""
        with self._gate:
            slop_ns = round(self._settings.node.sync_slop_s * 1e9)
            self._intake.settle(time.time_ns() - slop_ns)
            return self._intake.undecided

    @property
    def undecided(self) -> bool:
        """Whether a colour message waits for its depth."""
        return self._intake.undecided

    def clear(self, reason: str) -> None:
        """Drop all that waits or is being solved; nothing of it goes out after this."""
        with self._sending, self._gate:
            self._intake.clear(reason)

    def stop(self) -> None:
        """Let the worker end; the frame at hand is not waited for and does not go out."""
        self.clear('the node was stopped')
        self._worker.stop()

    def status(self, name: str, state: str) -> Fields:
        """Give the DiagnosticStatus; state says why the node is not at work."""
        if not state and not self._worker.ready:
            state = 'preparing the solver'
        with self._gate:
            fields = self._health.status(name, state, self._settings, time.monotonic())
        told = [{'key': key, 'value': str(value)} for key, value in self._pace.values().items()]
        return {**fields, 'values': [*told, *fields['values']]}

    def _take_exposure(self, exposure: float, came_ns: int) -> None:
        known: float | None = exposure
        try:
            check_exposure(exposure)
        except InputError as error:
            known = None
            self._outlet.warn(str(error))
        self._intake.push_exposure(known, came_ns)

    def _prepare(self) -> None:
        try:
            self._first()
        except Exception as error:  # each frame will tell, too
            self._outlet.warn(f'the solver cannot be prepared: {type(error).__name__}: {error}')

    def _work(self, pair: Pair) -> None:
        """Solve a pair and send what came of it; whatever happens, the next one has its turn."""
        try:
            solved = self._solve(pair)
            with self._sending:
                if self._intake.mailbox.busy:
                    age = self._outlet.publish(solved)
                    self._count(solved, age)
        except Exception as error:
            with self._gate:
                counts = self._intake.mailbox.finish()
                if counts:
                    self._intake.drop(f'not published: {type(error).__name__}')
            if counts:
                self._outlet.warn(f'a result was not published: {error}')

    def _solve(self, pair: Pair) -> SolvedPair:
        settings, pace = self._settings, self._pace
        mode = pace.mode if self._outlet.wants_pictures() else 'motion'
        params = replace(settings.solver, mode=mode)
        pair = replace(pair, info=self._intake.infos.at(stamp_ns(pair.colour.header)))
        solved = solve_anyhow(pair, settings.given, params, self._tracker)
        pace.note(mode, solved.result)
        if solved.reason:
            self._outlet.warn(solved.trace or solved.reason)
        return solved

    def _count(self, solved: SolvedPair, age: float) -> None:
        with self._gate:
            self._intake.mailbox.finish()
            self._health.count(solved, age, time.monotonic())


def _pace(settings: Settings) -> Pace:
    return Pace(settings.solver.mode, settings.node.deadline_ms / 1000)
