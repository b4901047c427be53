"""The live node without ROS."""

import threading
import time

from depth_deblur_ros.core.data import DeblurResult, Motion, Outcome
from depth_deblur_ros.pipeline import Pipeline
from depth_deblur_ros.settings import settings_from
import numpy as np
import pytest
from test_frames import CAMERA, info_of, pair_of


class Outlet:
    """Takes what is published; may refuse."""

    def __init__(self):
        self.published, self.warnings = [], []
        self.pictures, self.refuses = True, False
        self.something = threading.Event()

    def wants_pictures(self):
        return self.pictures

    def publish(self, solved):
        if self.refuses:
            raise RuntimeError('the context is gone')
        self.published.append(solved)
        self.something.set()
        return 0.5

    def warn(self, text):
        self.warnings.append(text)
        self.something.set()


class Solver:
    """Waits to be let go; notes the modes it was told."""

    def __init__(self):
        self.go, self.busy, self.modes = threading.Event(), threading.Event(), []
        self.go.set()
        self.outcome = Outcome.SHARP

    def __call__(self, frame, params):
        self.modes.append(params.mode)
        self.busy.set()
        assert self.go.wait(5)
        still = Motion(np.zeros(3), np.zeros(3))
        depth = frame.depth
        return DeblurResult(frame.image, depth, still, self.outcome, True, 1.0, 0.0, 0.1)


@pytest.fixture
def line():
    outlet, solver = Outlet(), Solver()
    made = Pipeline(settings_from({}), outlet, solver, lambda: None)
    for role in ('colour', 'depth', 'camera_info', 'exposure'):
        made.stream(role, role, role != 'exposure')
    made.begin()
    made.outlet, made.solver = outlet, solver
    yield made
    solver.go.set()
    made.stop()


def send(line, stamp):
    pair = pair_of(info_of(CAMERA))
    for message in (pair.colour, pair.depth):
        message.header.stamp.nanosec = stamp
    line.take('camera_info', pair.info)
    line.take('depth', pair.depth)
    line.take('colour', pair.colour)


def values(line):
    return {entry['key']: entry['value'] for entry in line.status('n', '')['values']}


def until(condition):
    end = time.monotonic() + 5
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.005)


def test_a_pair_is_solved_and_counted(line):
    send(line, 1)
    until(lambda: values(line)['published'] == '1')
    assert line.outlet.published[0].pair.colour.header.stamp.nanosec == 1
    assert values(line)['latency p50 [s]'] == '0.5000'
    assert values(line)['waiting'] == '0'


def test_settings_count_from_the_next_frame_on(line):
    send(line, 1)
    until(lambda: len(line.outlet.published) == 1)
    line.use(settings_from({'mode': 'fast'}))
    send(line, 2)
    until(lambda: len(line.outlet.published) == 2)
    line.outlet.pictures = False  # nobody looks: the motion is enough
    send(line, 3)
    until(lambda: len(line.outlet.published) == 3)
    assert line.solver.modes == ['full', 'fast', 'motion']


def test_a_missed_deadline_steps_the_mode_down(line):
    line.solver.outcome = Outcome.SOLVED
    line.use(settings_from({'deadline_ms': 50.0}))  # it says that it takes 100
    for stamp in range(1, 8):
        send(line, stamp)
        until(lambda stamp=stamp: len(line.outlet.published) == stamp)
    assert line.solver.modes == ['full'] * 3 + ['fast'] * 3 + ['motion']
    assert (values(line)['mode'], values(line)['mode in use']) == ('full', 'motion')
    line.use(settings_from({'deadline_ms': 0.0}))
    send(line, 8)
    until(lambda: len(line.outlet.published) == 8)
    assert line.solver.modes[-1] == 'full'


def test_what_is_being_solved_when_all_is_cleared_does_not_go_out(line):
    line.solver.go.clear()
    send(line, 1)
    assert line.solver.busy.wait(5)
    send(line, 2)
    line.clear('told to')
    assert values(line)['dropped: told to'] == '2'
    line.solver.go.set()
    send(line, 3)
    until(lambda: line.outlet.published)
    stamps = [s.pair.colour.header.stamp.nanosec for s in line.outlet.published]
    assert stamps == [3]
    assert values(line)['arrived'] == '3'


def test_a_result_that_cannot_be_sent_is_counted(line):
    line.outlet.refuses = True
    send(line, 1)
    until(lambda: values(line).get('dropped: not published: RuntimeError') == '1')
    line.outlet.refuses = False
    send(line, 2)
    until(lambda: values(line)['published'] == '1')
    assert line.outlet.warnings == ['a result was not published: the context is gone']


@pytest.mark.parametrize('exposure', [float('nan'), 0.0, -1.0, 1e9])
def test_an_exposure_that_is_none_is_told_and_forgotten(line, exposure):
    class Float:
        data = exposure

    line.take('exposure', Float)
    assert line.outlet.warnings[0].startswith('exposure must lie in')
    send(line, 1)
    until(lambda: line.outlet.published)
    assert line.outlet.published[0].frame.exposure is None


def test_a_stop_does_not_wait_for_the_frame_at_hand_which_stays_unsaid(line):
    line.solver.go.clear()
    send(line, 1)
    assert line.solver.busy.wait(5)
    line.stop()
    line.solver.go.set()
    until(lambda: values(line)['dropped: the node was stopped'] == '1')
    time.sleep(0.05)
    assert line.outlet.published == line.outlet.warnings == []


def test_a_solver_that_cannot_be_prepared_is_told_and_tried_all_the_same():
    def first():
        raise OSError('no cache')

    line = Pipeline(settings_from({}), Outlet(), Solver(), first)
    line.outlet = line._outlet
    for role in ('colour', 'depth', 'camera_info'):
        line.stream(role, role, True)
    send(line, 1)
    until(lambda: line.outlet.published)
    line.stop()
    assert line.outlet.warnings == ['the solver cannot be prepared: OSError: no cache']


def test_status_says_that_the_solver_is_not_ready_yet():
    ready = threading.Event()
    line = Pipeline(settings_from({}), Outlet(), Solver(), lambda: ready.wait(5) and None)
    try:
        line.stream('colour', '/c', True)
        assert line.status('n', '')['message'] == 'preparing the solver'
    finally:
        ready.set()
        line.stop()
