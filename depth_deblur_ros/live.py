"""
What happens between a topic's callback and the solver, without ROS.

Callbacks only hand over; one worker solves; the newest pair wins. Whatever does not get through is
counted by its reason: arrived = published + dropped + waiting at any time.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import replace
import threading
from typing import Any, Generic, TypeVar

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, MAX_PIXELS, Motion, RgbdFrame
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.core.solver import deblur, restore_known
from depth_deblur_ros.frames import Pair
from depth_deblur_ros.messages import stamp_ns
from depth_deblur_ros.pairing import StampPairer
import numpy as np

T = TypeVar('T')

OVERTAKEN = 'overtaken by a newer pair while the solver was busy'
KEPT = 30  # frames that may wait for their depth: a second of 30 Hz
PATIENCE_NS = 2_000_000_000  # no depth comes later than that
KEPT_BYTES = 1 << 30  # of the frames that wait, and of the depths; two of each always may
MAX_BYTES = 4 * MAX_PIXELS  # of one message; larger ones are not taken
TOO_LARGE = f'a message of more than {MAX_BYTES} bytes'
KEPT_INFOS = 30
KEPT_EXPOSURES = 300
_SOLVING = threading.Lock()  # numba's plainest thread pool breaks when two threads call it


class Mailbox(Generic[T]):
    """One slot between threads: a new item displaces the one that waits."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._item: T | None = None
        self._busy = False
        self._closed = False

    def offer(self, item: T) -> T | None:
        """Put an item in; give the one that it displaces."""
        with self._changed:
            displaced, self._item = self._item, item
            self._changed.notify()
            return displaced

    def take(self) -> T | None:
        """Wait for an item and take it as being worked on; None when closed."""
        with self._changed:
            self._changed.wait_for(lambda: self._closed or self._item is not None)
            if self._closed:
                return None
            item, self._item, self._busy = self._item, None, True
            return item

    @property
    def busy(self) -> bool:
        """Whether an item is being worked on, and still counts."""
        return self._busy

    def finish(self) -> bool:
        """End the work on the item taken; give whether it still counts."""
        with self._changed:
            counts, self._busy = self._busy, False
            return counts

    def clear(self) -> int:
        """Forget the waiting item and void the one being worked on; give how many these were."""
        with self._changed:
            count = len(self)
            self._item, self._busy = None, False
            return count

    def close(self) -> None:
        """Let take() return."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def __len__(self) -> int:
        return (self._item is not None) + self._busy


class Worker(Generic[T]):
    """
    One thread that works on what comes into the mailbox; work and first must not raise.

    Of all workers of a process one works at a time. None keeps the process from ending.
    """

    def __init__(
        self, mailbox: Mailbox[T], work: Callable[[T], None], first: Callable[[], None]
    ) -> None:
        self._mailbox, self._work, self._first = mailbox, work, first
        self.ready = False
        self._thread = threading.Thread(target=self._run, name='solver', daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """Let the thread end after the work at hand, without waiting for it."""
        self._mailbox.close()

    def _run(self) -> None:
        with _SOLVING:
            self._first()
        self.ready = True
        while (item := self._mailbox.take()) is not None:
            with _SOLVING:
                self._work(item)


def end_work(patience_s: float) -> bool:
    """Let no worker begin anything any more; give whether all have ended within this time."""
    return _SOLVING.acquire(timeout=patience_s)


class InfoHistory:
    """The camera_info messages that came last, found by stamp; used from two threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._infos: deque[Any] = deque(maxlen=KEPT_INFOS)

    def push(self, info: Any) -> None:
        """Remember a camera_info."""
        with self._lock:
            self._infos.append(info)

    def at(self, stamp: int) -> Any:
        """Give the latest camera_info that is not newer than the stamp, else the oldest."""
        with self._lock:
            infos = list(self._infos)
        before = [info for info in infos if stamp_ns(info.header) <= stamp]
        if before:
            return max(before, key=lambda info: stamp_ns(info.header))
        return min(infos, key=lambda info: stamp_ns(info.header), default=None)

    def clear(self) -> None:
        """Keep only the newest to come, whatever its stamp."""
        with self._lock:
            while len(self._infos) > 1:
                self._infos.popleft()


class Intake:
    """Pairs what comes on the topics and offers each pair to the worker; used by one thread."""

    def __init__(self, slop_s: float) -> None:
        self.mailbox: Mailbox[Pair] = Mailbox()
        self.infos = InfoHistory()
        self._exposures: deque[tuple[int, float | None]] = deque(maxlen=KEPT_EXPOSURES)
        self.arrived = self.pairs = 0
        self._dropped: Counter[str] = Counter()
        self._pairer: StampPairer[Pair, Any] = StampPairer(round(slop_s * 1e9), KEPT)

    def push_colour(self, msg: Any, came_ns: int) -> None:
        """Take a colour message that came at this time."""
        self.arrived += 1
        if not self._has_room(msg):
            self._dropped[TOO_LARGE] += 1
            return
        pair = Pair(msg, None, None, None, came_ns)
        self._offer(self._pairer.push_colour(stamp_ns(msg.header), pair))

    def push_depth(self, msg: Any) -> None:
        """Take a depth message."""
        if self._has_room(msg):
            self._offer(self._pairer.push_depth(stamp_ns(msg.header), msg))
        else:
            self._pairer.unused_depths += 1

    def push_exposure(self, exposure: float | None, came_ns: int) -> None:
        """Take an exposure time [s] for what comes later; None: unknown from then on."""
        self._exposures.append((came_ns, exposure))

    def settle(self, came_before_ns: int) -> None:
        """Wait no longer for a nearer depth of the colour messages that came before this time."""
        found = self._pairer.settle(
            lambda pair: pair.log_ns <= came_before_ns,
            lambda pair: pair.log_ns <= came_before_ns - PATIENCE_NS,
        )
        self._offer(found)

    def change_slop(self, slop_s: float) -> None:
        """Pair by another slop from now on."""
        self._pairer.slop_ns = round(slop_s * 1e9)

    def clear(self, reason: str) -> None:
        """Drop all that waits or is being solved, for this reason."""
        self._pairer.clear(reason)
        self.infos.clear()
        self._exposures.clear()
        if count := self.mailbox.clear():
            self._dropped[reason] += count

    def drop(self, reason: str) -> None:
        """Count a pair that was taken from the mailbox and could not be published."""
        self._dropped[reason] += 1

    @property
    def dropped(self) -> Counter[str]:
        """Colour messages that were not published, by reason."""
        return self._dropped + self._pairer.dropped

    @property
    def unused_depths(self) -> int:
        """Depth messages that no colour message took."""
        return self._pairer.unused_depths

    @property
    def waiting(self) -> int:
        """Colour messages whose lot is not known yet."""
        return self._pairer.waiting + len(self.mailbox)

    @property
    def undecided(self) -> bool:
        """Whether a colour message waits for its depth."""
        return self._pairer.waiting > 0

    @property
    def gap_s(self) -> float | None:
        """The smallest gap between colour and depth stamps that was too wide for a pair."""
        miss = self._pairer.nearest_miss_ns
        return None if miss is None else miss / 1e9

    def _has_room(self, msg: Any) -> bool:
        """Whether a message may wait; of large ones only a few may."""
        size = len(msg.data)
        self._pairer.keep = max(2, min(KEPT, KEPT_BYTES // max(1, size)))
        return size <= MAX_BYTES

    def _offer(self, found: list[tuple[Pair, Any]]) -> None:
        for colour, depth in found:
            self.pairs += 1
            before = (e for came_ns, e in reversed(self._exposures) if came_ns <= colour.log_ns)
            pair = replace(colour, depth=depth, exposure=next(before, None))
            if self.mailbox.offer(pair) is not None:
                self._dropped[OVERTAKEN] += 1


def compile_kernels() -> None:
    """Solve a small frame, so that the first real one need not wait for what is made once."""
    noise = np.random.default_rng(0).random((144, 192, 3), np.float32)
    image = np.asarray(cv2.blur(noise, (21, 7)), np.float32)  # what is sharp is not searched
    camera = CameraIntrinsics(160.0, 160.0, 95.5, 71.5, 192, 144)
    frame = RgbdFrame(image, np.ones((144, 192), np.float32), camera)
    deblur(frame, SolverParams(mode='motion'))
    turn = Motion(np.array([0.0, 0.05, 0.0]), np.zeros(3))
    for mode in ('fast', 'full'):
        restore_known(frame, turn, SolverParams(mode=mode))
