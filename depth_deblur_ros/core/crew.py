"""
Several threads in one compiled loop that goes from kernel to kernel.

To call in other threads for each kernel takes some thirty microseconds, as long as a kernel on a
small part of a frame. So a loop of many short kernels calls them in once, `threads.with_crew`:
its leader names a kind of work on the board, and everybody takes piece after piece of it. Who
comes late, or is put to sleep by the system, is waited for only with a piece in hand.

The board, int64: what is worked on, in how many pieces, and the next of them, in one number, so
that nobody takes a piece of other work than it thinks; how many pieces are done; the threads.
"""

from __future__ import annotations

from typing import Any

from numba import njit, types
from numba.extending import intrinsic
import numpy as np
import numpy.typing as npt

Board = npt.NDArray[np.int64]

WORK, DONE, THREADS = 0, 8, 16  # places on the board, a line of the cache apart
KINDS, MOST = 8, 1 << 16  # kinds of work, pieces of one
OVER = -(1 << 62)
EACH = 4  # pieces for each thread, so that a faster one does more
_instruction: Any = intrinsic
sched_yield = types.ExternalFunction('sched_yield', types.int32())


def _place(context: Any, builder: Any, signature: Any, values: Any) -> Any:
    array = context.make_array(signature.args[0])(context, builder, value=values[0])
    return builder.gep(array.data, [values[1]])


def _changing(operation: str) -> Any:
    @_instruction  # type: ignore[untyped-decorator]
    def change(typing: Any, board: Any, index: Any, value: Any) -> Any:
        def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
            place = _place(context, builder, signature, values)
            return builder.atomic_rmw(operation, place, values[2], 'seq_cst')

        return types.int64(board, types.intp, types.int64), build

    return change


_add, _put = _changing('add'), _changing('xchg')


@_instruction  # type: ignore[untyped-decorator]
def _look(typing: Any, board: Any, index: Any) -> Any:
    def build(context: Any, builder: Any, signature: Any, values: Any) -> Any:
        return builder.load_atomic(_place(context, builder, signature, values), 'seq_cst', 8)

    return types.int64(board, types.intp), build


def empty_board(threads: int) -> Board:
    """Give the board of so many threads."""
    board = np.zeros(THREADS + 1, np.int64)
    board[THREADS] = threads
    return board


@njit(cache=True, nogil=True)
def begin(board, kind, rows):  # type: ignore[no-untyped-def]
    """Let everybody work on rows of one kind, 0 to KINDS - 1; give how many pieces they are."""
    threads = board[THREADS]
    count = min(rows, EACH * threads) if threads > 1 else 1
    turn = _look(board, WORK) // (KINDS * MOST * MOST) + 1
    _put(board, DONE, np.int64(0))
    _put(board, WORK, ((turn * KINDS + kind) * MOST + count) * MOST)
    return count


@njit(cache=True, nogil=True)
def take(board):  # type: ignore[no-untyped-def]
    """Take a piece: its kind, its number, and of how many; kind -1 where there is none to take."""
    work = _look(board, WORK)
    if work >= 0 and work % MOST < work // MOST % MOST:
        work = _add(board, WORK, np.int64(1))
        piece, count = work % MOST, work // MOST % MOST
        if work >= 0 and piece < count:
            return work // (MOST * MOST) % KINDS, piece, count
    return -1, 0, 0


@njit(cache=True, nogil=True)
def hand_in(board):  # type: ignore[no-untyped-def]
    """Say that a piece is done."""
    _add(board, DONE, np.int64(1))


@njit(cache=True, nogil=True)
def all_done(board, count):  # type: ignore[no-untyped-def]
    """Say whether so many pieces are done; if not, let others work."""
    if _look(board, DONE) >= count:
        return True
    sched_yield()
    return False


@njit(cache=True, nogil=True)
def await_more(board):  # type: ignore[no-untyped-def]
    """Let others work; say whether there may be more to do."""
    sched_yield()
    return _look(board, WORK) >= 0


@njit(cache=True, nogil=True)
def dismiss(board):  # type: ignore[no-untyped-def]
    """Say that all is over."""
    _put(board, WORK, np.int64(OVER))
