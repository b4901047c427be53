"""What happens between a callback and the solver: nothing is lost uncounted, the newest wins."""

import threading
from types import SimpleNamespace

from depth_deblur_ros.core.evidence import template_table
from depth_deblur_ros.live import (
    compile_kernels,
    InfoHistory,
    Intake,
    Mailbox,
    OVERTAKEN,
    PATIENCE_NS,
    Worker,
)
from depth_deblur_ros.pairing import NO_DEPTH
from hypothesis import given
from hypothesis import strategies as st

MS = 1_000_000


def message(stamp):
    """Give a message with a header of this stamp [ms]."""
    sec, ms = divmod(stamp, 1000)
    stamp = SimpleNamespace(sec=sec, nanosec=ms * MS)
    header = SimpleNamespace(stamp=stamp, frame_id='camera')
    return SimpleNamespace(header=header, data=b'')


def test_a_newer_item_displaces_the_one_that_waits():
    box = Mailbox()
    assert [box.offer(n) for n in (1, 2, 3)] == [None, 1, 2]
    assert (box.take(), len(box), box.busy) == (3, 1, True)
    assert box.offer(4) is None  # 3 is being worked on
    assert (box.finish(), len(box)) == (True, 1)


def test_clearing_voids_the_work_at_hand_and_what_waits():
    box = Mailbox()
    box.offer(1)
    box.take()
    box.offer(2)
    assert box.clear() == 2
    assert not box.finish()
    box.offer(3)
    assert (box.take(), box.finish()) == (3, True)


def test_a_worker_prepares_works_and_stops():
    box, done, seen = Mailbox(), threading.Event(), []

    def work(item):
        seen.append(item)
        done.set()

    worker = Worker(box, work, lambda: seen.append('first'))
    box.offer('item')
    assert done.wait(5)
    worker.stop()
    assert worker.ready and seen == ['first', 'item']


def test_a_stopped_worker_is_not_waited_for_and_the_next_begins_when_it_has_ended():
    go, seen = threading.Event(), []
    busy, done = threading.Event(), threading.Event()

    def work(item):
        busy.set()
        seen.append(f'begin {item}')
        assert go.wait(5)
        seen.append(f'end {item}')
        if item == 2:
            done.set()

    boxes = [Mailbox(), Mailbox()]
    old = Worker(boxes[0], work, lambda: None)
    boxes[0].offer(1)
    assert busy.wait(5)
    old.stop()
    new = Worker(boxes[1], work, lambda: None)
    boxes[1].offer(2)
    assert not done.wait(0.1) and not new.ready
    go.set()
    assert done.wait(5)
    new.stop()
    assert seen == ['begin 1', 'end 1', 'begin 2', 'end 2']


def test_the_camera_info_of_an_image_is_the_latest_that_is_not_newer():
    infos = InfoHistory()
    assert infos.at(0) is None
    later, early = message(200), message(100)
    for info in (later, early):
        infos.push(info)
    assert infos.at(50 * MS) is early  # the oldest, where all are newer
    assert infos.at(100 * MS) is early
    assert infos.at(199 * MS) is early
    assert infos.at(10_000 * MS) is later
    infos.clear()
    assert infos.at(0) is early  # what came last survives a jump of time


actions = st.lists(
    st.tuples(
        st.sampled_from(['colour', 'depth', 'take', 'finish', 'settle', 'clear']),
        st.integers(0, 2000),
    ),
    max_size=120,
)


@given(actions)
def test_at_any_time_all_that_arrived_is_accounted_for(steps):
    intake, published, now = Intake(0.02), 0, 0
    for action, stamp in steps:
        now += 5 * MS
        if action == 'colour':
            intake.push_colour(message(stamp), now)
        elif action == 'depth':
            intake.push_depth(message(stamp))
        elif action == 'settle':
            intake.settle(now - 20 * MS)
        elif action == 'clear':
            intake.clear('told to')
        elif action == 'take' and len(intake.mailbox) and not intake.mailbox.busy:
            intake.mailbox.take()
        elif action == 'finish':
            published += intake.mailbox.finish()
        assert intake.arrived == published + intake.dropped.total() + intake.waiting
    assert intake.arrived == sum(action == 'colour' for action, _ in steps)


def test_a_busy_solver_gets_the_newest_pair_whole():
    intake = Intake(0.02)
    for stamp in (0, 33, 66):
        intake.push_depth(message(stamp))
        intake.push_colour(message(stamp), 0)
    pair = intake.mailbox.take()
    assert pair.colour.header.stamp.nanosec == pair.depth.header.stamp.nanosec == 66 * MS
    assert intake.dropped == {OVERTAKEN: 2}
    assert intake.unused_depths == 0


def test_after_the_slop_an_older_depth_is_good_enough():
    intake = Intake(0.02)
    intake.push_depth(message(100))
    intake.push_colour(message(110), came_ns=0)
    assert intake.undecided and intake.pairs == 0
    intake.settle(came_before_ns=-1)
    assert intake.pairs == 0  # the slop has not passed
    intake.settle(came_before_ns=0)
    assert intake.pairs == 1 and not intake.undecided


def test_without_a_depth_near_enough_the_slop_changes_nothing():
    intake = Intake(0.02)
    intake.push_depth(message(50))
    intake.push_colour(message(110), came_ns=0)
    intake.settle(came_before_ns=0)
    assert intake.undecided and intake.pairs == 0
    intake.push_depth(message(111))
    assert intake.pairs == 1
    intake.push_colour(message(143), came_ns=0)
    intake.push_depth(message(144))
    assert (intake.pairs, intake.unused_depths) == (2, 1)  # the one at 50


def test_a_colour_frame_does_not_wait_for_ever():
    intake = Intake(0.02)
    intake.push_depth(message(50))
    intake.push_colour(message(110), came_ns=0)
    intake.settle(came_before_ns=PATIENCE_NS - 1)
    assert intake.waiting == 1
    intake.settle(came_before_ns=PATIENCE_NS)
    assert (intake.waiting, intake.dropped) == (0, {NO_DEPTH: 1})
    intake.push_depth(message(110))  # far too late
    assert intake.pairs == 0


def test_an_exposure_belongs_to_the_images_after_it():
    intake = Intake(0.02)
    seen = []
    for number in range(3):
        intake.push_colour(message(40 * number), came_ns=10 * number)
        intake.push_exposure(number / 100, came_ns=10 * number - 1)  # comes first, is read later
        intake.push_exposure(9.0, came_ns=10 * number + 5)
        intake.push_depth(message(40 * number))
        seen.append(intake.mailbox.take().exposure)
    assert seen == [0.0, 0.01, 0.02]
    intake.clear('told to')
    intake.push_colour(message(200), came_ns=40)
    intake.push_depth(message(200))
    assert intake.mailbox.take().exposure is None


def test_the_slop_may_change_on_the_way():
    intake = Intake(0.02)
    intake.push_colour(message(0), 0)
    intake.change_slop(0.1)
    intake.push_depth(message(90))
    assert intake.pairs == 1


def test_preparing_the_solver_leaves_nothing_to_make_once():
    template_table.cache_clear()
    compile_kernels()
    assert template_table.cache_info().currsize == 1


def test_large_messages_that_wait_stay_within_a_gigabyte():
    intake, held = Intake(0.02), range(1 << 28)  # its length is a quarter of a gigabyte
    for number in range(20):
        colour = message(40 * number)
        colour.data = range(250_000_000)
        intake.push_colour(colour, number)
    assert intake.waiting <= 5
    assert intake.arrived == intake.dropped.total() + intake.waiting
    colour = message(1000)
    colour.data = held
    intake.push_colour(colour, 1000)
    assert intake.dropped['a message of more than 256000000 bytes'] == 1
    assert intake.arrived == intake.dropped.total() + intake.waiting
