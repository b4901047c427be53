"""
Work on several threads: a kernel, or a function that lets numpy work.

Kernels run without the interpreter's lock, each thread on a share of the work. numba could do so
by itself, but compiles what runs side by side four times over, which took most of a first run.

To wake a thread takes longer than many a share. So a worker stays awake for a moment after each,
and what it has not begun when the caller is through, the caller has done itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from queue import Empty, SimpleQueue
from threading import local, Thread
from typing import Any, TypeVar

import cv2
from depth_deblur_ros.core.crew import Board, dismiss, empty_board, sched_yield
from numba import config, njit
from numba.core.compiler import Compiler
import numpy as np

Of = TypeVar('Of')
Result = TypeVar('Result')

ASKED, DONE = 0, 1  # places in a worker's turns: shares that it was given, that it did
PATIENCE = 400  # looks at the turns, about half a microsecond each, before it sleeps
HEAD_START = 16  # looks before it takes the interpreter's lock, so that its caller need not wait
PIECES = 2  # for each thread, so that a faster one does more


class _Apart(Compiler):
    """Compiles kernels on the promise that their arrays do not overlap, as numba's own threads."""

    def define_pipelines(self) -> Any:
        self.state.flags.noalias = True
        return super().define_pipelines()  # type: ignore[no-untyped-call]


# What `on_threads` calls is compiled with these.
SHARED: dict[str, Any] = {
    'cache': True,
    'nogil': True,
    'error_model': 'numpy',
    'pipeline_class': _Apart,
}


@njit(cache=True, nogil=True)
def _rest(turns):  # type: ignore[no-untyped-def]
    """Say that a share is done; return when the next is there, or after a while."""
    turns[DONE] += 1
    asked = 0
    for _ in range(PATIENCE):
        asked += turns[ASKED] != turns[DONE]
        if asked > HEAD_START:
            break
        sched_yield()


@njit(cache=True, nogil=True)
def _await(turns):  # type: ignore[no-untyped-def]
    """Return when the share is done, or after a while."""
    for _ in range(PATIENCE):
        if turns[ASKED] == turns[DONE]:
            break
        sched_yield()


class _Worker(Thread):
    """
    A thread that does share after share, each for whoever took it from `_idle`.

    What counts goes through the queues; the turns only tell when it is worth looking there.
    """

    def __init__(self) -> None:
        super().__init__(name='on_threads', daemon=True)
        self._shares: SimpleQueue[Callable[[], None]] = SimpleQueue()
        self._outcomes: SimpleQueue[BaseException | None] = SimpleQueue()
        self._turns = np.array([0, -2])
        for wait in (_rest, _await):  # compiled here: the end of the process cuts a worker off
            wait(self._turns)
        self.start()

    def run(self) -> None:
        while True:
            _rest(self._turns)
            self._outcomes.put(_outcome(self._shares.get()))

    def ask(self, share: Callable[[], None]) -> None:
        """Give it a share."""
        self._shares.put(share)
        self._turns[ASKED] += 1

    def outcome(self) -> BaseException | None:
        """Wait for the end of the share, unless it has not begun: then take it back."""
        try:
            self._shares.get_nowait()
        except Empty:
            _await(self._turns)
            return self._outcomes.get()
        self._turns[ASKED] -= 1
        return None


_idle: list[_Worker] = []
_here = local()  # sharing: whether this thread works on a share; limit: how many it may use


def _worker() -> _Worker:
    while _idle:
        worker = _idle.pop()
        if worker.is_alive():  # not after a fork
            return worker
    return _Worker()


def _outcome(share: Callable[[], None]) -> BaseException | None:
    try:
        share()
    except BaseException as error:
        return error
    return None


def _work(kernel: Callable[..., None], pieces: Iterator[tuple[int, Any]], data: Any) -> None:
    _here.sharing = True
    try:
        for first, end in pieces:
            kernel(first, end, *data)
    finally:
        _here.sharing = False


@contextmanager
def at_most(threads: int) -> Iterator[None]:
    """Let `on_threads` use so many threads here, and OpenCV; leave both as they were."""
    outer, of_opencv = getattr(_here, 'limit', None), cv2.getNumThreads()
    _here.limit = min(threads, cores())
    cv2.setNumThreads(threads)
    try:
        yield
    finally:
        _here.limit = outer
        cv2.setNumThreads(of_opencv)


def cores() -> int:
    """Give how many threads there may be at most: NUMBA_NUM_THREADS, or the cores."""
    return int(config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


def threads_here() -> int:
    """Give how many threads `on_threads` may use: one within a share, else up to the limit."""
    if getattr(_here, 'sharing', False):
        return 1
    return getattr(_here, 'limit', None) or cores()


def on_threads(kernel: Callable[..., None], count: int, *data: Any) -> None:
    """
    Call kernel(first, end, *data) on pieces of 0..count, on as many threads as may be.

    What the kernel raises is raised when all threads have ended. Any thread may call; what a share
    itself asks for, its own thread does alone.
    """
    threads = min(threads_here(), count)
    if threads < 2:
        kernel(0, count, *data)
        return
    many = min(threads * PIECES, count)
    pieces = iter([(k * count // many, (k + 1) * count // many) for k in range(many)])
    share = partial(_work, kernel, pieces, data)
    _together(share, share, threads)


def each(work: Callable[[Of], Result], items: Sequence[Of]) -> list[Result]:
    """Give work(item) of all items, which threads take one after the other."""
    found: dict[int, Result] = {}

    def some(first: int, end: int) -> None:
        found.update({k: work(items[k]) for k in range(first, end)})

    on_threads(some, len(items))
    return [found[k] for k in range(len(items))]


def both(one: Callable[[], Result], other: Callable[[], Of]) -> tuple[Result, Of]:
    """
    Give what two functions give, side by side if that may be: the first one here.

    So the memory of each comes and goes in the same thread's arena at every call.
    """
    found: dict[int, Any] = {}

    def do(k: int, work: Callable[[], Any]) -> None:
        found[k] = work()

    works = (0, one), (1, other)
    if threads_here() > 1:
        own, share = (partial(_work, do, iter([work]), ()) for work in works)
        _together(own, share, 2)
    for work in works:
        if work[0] not in found:  # there was no other thread, or it had not begun
            do(*work)
    return found[0], found[1]


def with_crew(loop: Callable[..., None], *data: Any) -> None:
    """
    Call loop(board, leads, *data) here, where it leads, and on the other threads there may be.

    A compiled loop that shares its work by a board (crew.py): the one that leads names what is to
    be done, the others return when all is over.
    """
    threads = threads_here()
    board: Board = empty_board(threads)

    def lead() -> None:
        try:
            loop(board, True, *data)
        finally:
            dismiss(board)

    _together(lead, partial(loop, board, False, *data), threads)


def _together(own: Callable[[], None], share: Callable[[], None], threads: int) -> None:
    """Do one's own while the other threads do a share each; raise what any of them raised."""
    workers = [_worker() for _ in range(1, threads)]
    for worker in workers:
        worker.ask(share)
    outcomes = [_outcome(own), *(worker.outcome() for worker in workers)]
    _idle.extend(workers)
    for error in filter(None, outcomes):
        raise error
