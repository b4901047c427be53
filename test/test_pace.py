"""The mode that meets the deadline, without ROS and without a clock."""

from dataclasses import replace
from itertools import pairwise

from depth_deblur_ros.core.data import DeblurResult, Motion, Outcome
from depth_deblur_ros.pace import LATE, LONGEST, Pace, WATCHED
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest

NOTHING = np.zeros((0, 0), np.float32)
STILL = Motion(np.zeros(3), np.zeros(3))
SOLVED = DeblurResult(NOTHING, NOTHING, STILL, Outcome.SOLVED, False, 1.0, 5.0, 0.0)
TIMES = {'full': 0.3, 'fast': 0.1, 'motion': 0.05}


def run(pace, frames, times=TIMES, slower=1.0, outcome=Outcome.SOLVED):
    """Solve frames; give the mode of each."""
    modes = []
    for _ in range(frames):
        modes.append(pace.mode)
        seconds = slower * times[modes[-1]]
        pace.note(modes[-1], replace(SOLVED, outcome=outcome, seconds=seconds))
    return modes


def changes(modes):
    return sum(a != b for a, b in pairwise(modes))


@pytest.mark.parametrize(
    ('deadline', 'mode'),
    [(0.0, 'full'), (0.4, 'full'), (0.2, 'fast'), (0.08, 'motion'), (0.01, 'motion')],
)
def test_it_ends_in_the_best_mode_that_is_in_time_and_stays(deadline, mode):
    pace = Pace('full', deadline)
    run(pace, 50)
    assert set(run(pace, 1000)) == {mode}


def test_it_steps_down_by_one_mode_after_some_late_frames():
    modes = run(Pace('full', 0.08), 2 * LATE + 1)
    assert modes == ['full'] * LATE + ['fast'] * LATE + ['motion']


def test_one_late_frame_now_and_then_changes_nothing():
    pace = Pace('full', 0.4)
    for _ in range(50):
        run(pace, 4)
        run(pace, 1, slower=5)
    assert (pace.mode, pace.late, pace.downs) == ('full', 50, 0)


def test_it_steps_up_again_when_there_is_room():
    pace = Pace('full', 0.5)
    run(pace, 50, slower=20)  # the machine is busy
    assert pace.mode == 'motion'
    assert run(pace, 10 * WATCHED)[-1] == 'full'
    assert (pace.downs, pace.ups) == (2, 2)


def test_it_never_exceeds_what_was_asked_for():
    pace = Pace('fast', 10.0)
    assert set(run(pace, 200)) == {'fast'}


def test_a_mode_that_falls_back_is_tried_more_and_more_seldom():
    pace = Pace('full', 0.2)
    run(pace, 40, slower=0.9)
    modes = []
    for _ in range(100):  # at ease in fast, too slow in full, whatever was learnt
        pace._cost = [1.0, 1.0, 1.0]
        modes += run(pace, 40)
    assert modes.count('full') < 60
    assert changes(modes) < 4 * np.log2(LONGEST / WATCHED) + 2 * len(modes) / LONGEST


def test_frames_without_a_motion_and_of_another_mode_say_nothing():
    pace = Pace('full', 0.2)
    run(pace, 100, outcome=Outcome.FAILED)
    for _ in range(10):
        pace.note('motion', replace(SOLVED, seconds=9.0))
    assert (pace.mode, pace.late) == ('full', 0)


@given(
    st.lists(st.floats(0.001, 10), min_size=100, max_size=300),
    st.floats(0.02, 0.5),
)
def test_it_never_changes_from_frame_to_frame(loads, deadline):
    pace = Pace('full', deadline)
    modes = [mode for load in loads for mode in run(pace, 1, slower=load)]
    turns = [i for i in range(1, len(modes)) if modes[i] != modes[i - 1]]
    order = ['full', 'fast', 'motion']
    for before, after in zip([0, *turns], turns, strict=False):
        up = order.index(modes[after]) < order.index(modes[after - 1])
        assert after - before >= (WATCHED if up else LATE)
    assert len(modes) / max(1, len(turns)) > LATE


def test_it_tells_what_it_does():
    pace = Pace('full', 0.2)
    run(pace, 10)
    assert pace.values() == {
        'mode in use': 'fast',
        'deadline [s]': '0.2',
        'later than the deadline': 3,
        'mode stepped down': 1,
        'mode stepped up': 0,
    }
    assert Pace('full', 0.0).values() == {'mode in use': 'full'}
