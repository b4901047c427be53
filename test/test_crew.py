"""A crew: each piece is done once, whoever comes, and nobody takes a piece of other work."""

from depth_deblur_ros.core import threads
from depth_deblur_ros.core.crew import all_done, await_more, begin, hand_in, take
from depth_deblur_ros.core.threads import with_crew
from numba import njit
import numpy as np
import pytest

ROUNDS, ROWS = 300, 37


@njit
def work(kind, piece, count, rows):
    for y in range(piece * ROWS // count, (piece + 1) * ROWS // count):
        # Every kind needs what its neighbours were after the kind before.
        if kind == 0:
            rows[1, y] = rows[0, y] + rows[0, ROWS - 1 - y]
        else:
            rows[0, y] = (rows[1, y] + rows[1, (y + 1) % ROWS]) % 1009
        rows[2, y] += 1


@njit
def loop(board, leads, rows):
    turn = count = 0
    while True:
        kind, piece, of = take(board)
        if kind >= 0:
            work(kind, piece, of, rows)
            hand_in(board)
        elif not leads:
            if not await_more(board):
                return
        elif all_done(board, count):
            if turn == ROUNDS:
                return
            count = begin(board, turn % 2, ROWS)
            turn += 1


def alone(board, leads, rows):
    if leads:
        loop(board, leads, rows)


def worked(how=loop):
    rows = np.zeros((3, ROWS), np.int64)
    rows[0] = np.arange(ROWS)
    with_crew(how, rows)
    return rows


@pytest.fixture
def use(monkeypatch):
    """Give what says how many threads may be used, even on a machine of one core."""
    return lambda n: monkeypatch.setattr(threads, 'cores', lambda: n)


@pytest.mark.parametrize('number', [2, 3, 5])
def test_any_number_of_threads_does_each_piece_once_and_in_order(use, number):
    use(1)
    by_one = worked()
    assert (by_one[2] == ROUNDS).all()
    use(number)
    for _ in range(5):
        np.testing.assert_array_equal(worked(), by_one)


def test_nobody_waits_for_who_does_not_come(use):
    use(1)
    by_one = worked()
    use(3)
    np.testing.assert_array_equal(worked(alone), by_one)


def test_a_loop_that_fails_lets_the_others_go(use):
    def fail(board, leads, rows):
        if leads:
            raise ValueError('lost')
        loop(board, leads, rows)

    use(3)
    with pytest.raises(ValueError, match='lost'):
        with_crew(fail, np.zeros((3, ROWS), np.int64))
    assert (worked()[2] == ROUNDS).all()
