"""A crew: each piece is done once, whoever comes, and nobody takes a piece of other work."""

from depth_deblur_ros.core import threads
from depth_deblur_ros.core.crew import await_all, await_more, begin, hand_in, take
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
def follow(board, rows):
    while await_more(board):
        kind, piece, count = take(board)
        if kind >= 0:
            work(kind, piece, count, rows)
            hand_in(board)


@njit
def lead(board, rows):
    for k in range(ROUNDS):
        count = begin(board, k % 2, ROWS)
        while True:
            kind, piece, of = take(board)
            if kind < 0:
                break
            work(kind, piece, of, rows)
            hand_in(board)
        await_all(board, count)


@njit
def absent(board, rows):
    pass


def worked(helper=follow):
    rows = np.zeros((3, ROWS), np.int64)
    rows[0] = np.arange(ROWS)
    with_crew(lead, helper, rows)
    return rows


@pytest.fixture
def use(monkeypatch):
    """Give what says how many threads may be used, even on a machine of one core."""
    return lambda n: monkeypatch.setattr(threads, 'cores', lambda: n)


@pytest.mark.parametrize('number', [2, 3, 5])
def test_any_number_of_threads_does_each_piece_once_and_in_order(use, number):
    use(1)
    alone = worked()
    assert (alone[2] == ROUNDS).all()
    use(number)
    for _ in range(5):
        np.testing.assert_array_equal(worked(), alone)


def test_nobody_waits_for_who_does_not_come(use):
    use(1)
    alone = worked()
    use(3)
    np.testing.assert_array_equal(worked(absent), alone)


def test_a_loop_that_fails_lets_the_others_go(use):
    def fail(board, rows):
        raise ValueError('lost')

    use(3)
    with pytest.raises(ValueError, match='lost'):
        with_crew(fail, follow, np.zeros((3, ROWS), np.int64))
    assert (worked()[2] == ROUNDS).all()
