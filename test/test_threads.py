"""Work on several threads: the same on any number of them, from anywhere; at rest afterwards."""

from concurrent.futures import ThreadPoolExecutor
from functools import partial
import subprocess
import sys
import threading
import time

from depth_deblur_ros.core import threads
from depth_deblur_ros.core.threads import on_threads, SHARED
from numba import njit
import numpy as np
import pytest

COUNT = 41


@pytest.fixture
def use(monkeypatch):
    """Give what says how many threads may be used, even on a machine of one core."""
    return lambda n: monkeypatch.setattr(threads, 'cores', lambda: n)


@pytest.fixture
def both(use):
    """Give a place where each of two threads waits for the other."""
    use(2)
    return threading.Barrier(2, timeout=20)


@njit(**{**SHARED, 'cache': False})
def take_roots(first, end, out):
    for k in range(first, end):
        x = np.float64(k)
        for _ in range(1000):
            x = np.sqrt(x + k)
        out[k] += x


def roots():
    out = np.zeros(COUNT)
    on_threads(take_roots, COUNT, out)
    return out


ROOTS = np.array([(1 + np.sqrt(1 + 4 * k)) / 2 if k else 0 for k in range(COUNT)])


@pytest.mark.parametrize('number', [1, 2, 3])
def test_any_number_of_threads_gives_the_same(use, number):
    use(1)
    alone = roots()
    np.testing.assert_allclose(alone, ROOTS, rtol=1e-12)
    use(number)
    for _ in range(100):
        np.testing.assert_array_equal(roots(), alone)


@pytest.mark.parametrize('count', [0, 1, 2, 3, COUNT])
def test_each_place_is_worked_on_once(use, count):
    seen = []
    use(3)
    on_threads(lambda first, end: seen.extend(range(first, end)), count)
    assert sorted(seen) == list(range(count))


def test_two_threads_work_at_once_also_after_a_pause(both):
    for pause in (0, 0, 0.1):
        time.sleep(pause)
        on_threads(lambda *_: both.wait(), 2)


def test_what_the_worker_has_not_begun_the_caller_does(use, monkeypatch):
    go_on, seen = threading.Event(), []
    monkeypatch.setattr(threads, '_idle', [])
    monkeypatch.setattr(threads._Worker, 'run', lambda self: go_on.wait(20))
    use(2)
    on_threads(lambda first, end: seen.extend(range(first, end)), COUNT)
    go_on.set()
    assert seen == list(range(COUNT))


@pytest.mark.parametrize('failing', [0, 1])
def test_what_a_share_raises_comes_when_the_others_have_ended(both, failing):
    ended = []

    def work(first, end):
        both.wait()
        if first == failing:
            raise ValueError(f'share {first}')
        time.sleep(0.05)
        ended.append(first)

    with pytest.raises(ValueError, match=f'share {failing}'):
        on_threads(work, 2)
    assert ended == [1 - failing]
    np.testing.assert_allclose(roots(), ROOTS, rtol=1e-12)


def test_what_a_share_asks_for_its_own_thread_does(both):
    found, inside = [], []

    def work(first, end):
        both.wait()
        on_threads(lambda *_: inside.append(threading.get_ident()), 8)
        found.append((threading.get_ident(), roots()))

    on_threads(work, 2)
    callers, values = zip(*found, strict=True)
    assert sorted(inside) == sorted(callers)
    np.testing.assert_allclose(values, [ROOTS, ROOTS], rtol=1e-12)
    on_threads(lambda *_: both.wait(), 2)  # and shares again afterwards


def test_two_functions_run_side_by_side_and_each_has_its_answer(both):
    def at_its_end(answer):
        both.wait()  # nobody gets on alone
        return answer

    assert threads.both(lambda: at_its_end(1), lambda: at_its_end('two')) == (1, 'two')


@pytest.mark.parametrize('number', [1, 2])
def test_of_two_functions_the_first_runs_here_and_none_twice(use, number):
    use(number)
    calls = []
    for k in range(100):
        where, _ = threads.both(threading.get_ident, partial(calls.append, k))
        assert where == threading.get_ident()
    assert calls == list(range(100))


def test_many_may_ask_at_once(use):
    use(3)
    with ThreadPoolExecutor(4) as pool:
        found = list(pool.map(lambda _: roots(), range(400)))
    np.testing.assert_allclose(found, [ROOTS] * 400, rtol=1e-12)


AFTERWARDS = """
import multiprocessing, time
from depth_deblur_ros.core import threads
threads.cores = lambda: 2

def use():
    met = threads.SimpleQueue()
    for _ in range(100):
        threads.on_threads(lambda first, end: met.put(first), 4)
    assert met.qsize() == 400

use()
time.sleep(0.1)
before = time.process_time()
time.sleep(1)
print(time.process_time() - before)
child = multiprocessing.get_context('fork').Process(target=use)
child.start()
child.join(20)
print(child.exitcode)
use()  # and ends while the worker may still be awake
"""


def test_afterwards_it_rests_forks_and_ends():
    command = [sys.executable, '-W', 'ignore::DeprecationWarning', '-c', AFTERWARDS]
    done = subprocess.run(command, check=True, capture_output=True, text=True, timeout=60)
    spent, code = done.stdout.split()
    assert float(spent) < 0.02
    assert code == '0'
    assert done.stderr == ''
