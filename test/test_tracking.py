"""What neighbouring frames tell: a camera that turns, a solver that knows all but the sign."""

from dataclasses import replace
import itertools
import pickle

from depth_deblur_ros import tracking
from depth_deblur_ros.core.data import InputError, Outcome
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.joining import _without_unseen
from depth_deblur_ros.tracking import Tracker
import numpy as np
import pytest
from turning import EXPOSURE, frame, Knowing, rate, START_NS, STEP_NS

MOTION = SolverParams(mode='motion')
COVERED = np.zeros((144, 192, 3), np.float32)


def followed(frames, *, ahead=False, solve=None, tracker=None):
    tracker = tracker or Tracker(solve or Knowing())
    following = [*frames[1:], None] if ahead else [None] * len(frames)
    return [tracker.follow(f, MOTION, n) for f, n in zip(frames, following, strict=True)]


def wrong(tracked, seconds):
    """Give how far the velocity is off, relative; 1 where none is told."""
    truth = rate(seconds)
    if not (tracked.exposure and tracked.result.sign_resolved):
        return 1.0
    found = tracked.result.motion.theta / tracked.exposure.seconds
    return float(np.linalg.norm(found - truth) / np.linalg.norm(truth))


def times(frames):
    return [(f.stamp_ns - START_NS) / 1e9 for f in frames]


@pytest.mark.parametrize('ahead', [False, True])
def test_sign_exposure_and_velocity_come_from_the_neighbours(ahead):
    frames = [frame(i) for i in range(14)]
    found = followed(frames, ahead=ahead)
    later = list(zip(found, times(frames), strict=True))[0 if ahead else 4 :]
    off = [wrong(tracked, seconds) for tracked, seconds in later]
    assert np.median(off) < (0.05 if ahead else 0.1)
    assert not ahead or max(off) < 0.25
    assert found[-1].exposure.seconds == pytest.approx(EXPOSURE, rel=0.06)
    assert found[-1].exposure.doubt < 0.15


def test_the_first_live_frame_has_no_sign():
    (found,) = followed([frame(0)])
    assert not found.result.sign_resolved and found.exposure is None


def test_an_exposure_that_is_told_stays():
    found = followed([frame(i, exposure=EXPOSURE) for i in range(5)])
    assert [(f.exposure.seconds, f.exposure.doubt) for f in found] == [(EXPOSURE, 0.0)] * 5
    assert found[-1].result.sign_resolved


def test_neighbours_can_be_ignored():
    tracker, solve = Tracker(Knowing()), Knowing()
    params = SolverParams(mode='motion', neighbours='ignore')
    for f in (frame(0), frame(1)):
        found = tracker.follow(f, params).result
        np.testing.assert_array_equal(found.motion.vector, solve(f, params).motion.vector)
        assert not found.sign_resolved


def test_the_solver_starts_where_the_neighbours_point():
    solve = Knowing()
    followed([frame(i) for i in range(6)], solve=solve, ahead=True)
    truth = EXPOSURE * rate(5 * STEP_NS / 1e9)
    np.testing.assert_allclose(solve.starts[5].theta, truth, atol=0.25 * np.linalg.norm(truth))
    assert Knowing().starts == []


def test_a_step_of_the_exposure_is_followed_within_two_frames():
    exposures = [0.01 if i < 4 else 0.022 for i in range(10)]
    frames = [frame(i, open_for=exposure) for i, exposure in enumerate(exposures)]
    solve = Knowing()
    tracker = Tracker(solve)
    for i, (f, n) in enumerate(itertools.pairwise(frames)):
        solve.exposure = exposures[i]
        found = tracker.follow(f, MOTION, n)
        if i not in (0, 4):
            assert found.exposure.seconds == pytest.approx(solve.exposure, rel=0.15), i


@pytest.mark.parametrize(
    'break_',
    [
        [],  # a gap alone
        [frame(5 + i, 0.165, image=COVERED) for i in range(9)],  # a covered lens
        [frame(5 + i, 0.165) for i in range(30)],  # a static second
    ],
    ids=['gap', 'covered', 'static'],
)
@pytest.mark.parametrize('ahead', [False, True])
def test_it_is_right_again_within_three_frames(break_, ahead):
    late = 40 * STEP_NS / 1e9
    moving = [frame(i) for i in range(5)]
    again = [frame(40 + i) for i in range(4)]
    standing = {f.stamp_ns for f in break_}

    def time(stamp):
        return np.pi / 12 if stamp in standing else (stamp - START_NS) / 1e9

    found = followed([*moving, *break_, *again], ahead=ahead, solve=Knowing(time=time))
    off = [wrong(f, late + i * STEP_NS / 1e9) for i, f in enumerate(found[-4:])]
    assert min(off[:3]) < 0.3, off


@pytest.mark.parametrize('ahead', [False, True])
def test_a_jump_back_in_time_starts_anew(ahead):
    frames = [frame(20 + i) for i in range(5)] + [frame(i) for i in range(4)]
    found = followed(frames, ahead=ahead)
    off = [wrong(f, t) for f, t in zip(found[5:8], times(frames[5:8]), strict=True)]
    assert min(off) < 0.3 and max(off[1:]) < 0.5


def test_the_stamp_means_what_is_said():
    long, short = 0.03, 0.006  # the middles of exposures that end evenly lie unevenly

    def exposure(number):
        return long if number % 3 else short

    def middle(stamp):
        number = (stamp - START_NS) // STEP_NS
        return (stamp - START_NS) / 1e9 - exposure(number) / 2

    off = {}
    for stamp_at in ('end', 'middle'):
        frames = [frame(i, middle(START_NS + i * STEP_NS), exposure(i)) for i in range(16)]
        tracker, missed = Tracker(Knowing(time=middle)), []
        params = SolverParams(mode='motion', stamp_at=stamp_at)
        tracker._solve.exposure = 1e-9  # only the neighbours tell
        for f, n in zip(frames, [*frames[1:], None], strict=True):
            found = tracker.follow(f, params, n).result.motion.theta / f.exposure
            missed.append(np.linalg.norm(found - rate(middle(f.stamp_ns))))
        off[stamp_at] = np.median(missed[4:])
    assert off['end'] < 0.5 * off['middle']


def test_a_camera_that_stands_still_has_no_motion():
    frames = [frame(i, 0.1) for i in range(6)]
    found = followed(frames, solve=Knowing(exposure=1e-6), ahead=True)
    for tracked in found:
        assert tracked.result.outcome is Outcome.SHARP
        assert not tracked.result.motion.vector.any()


def test_a_frame_that_fails_takes_the_motion_of_its_neighbours():
    tracker, solve = Tracker(Knowing()), Knowing()
    frames = [frame(i, exposure=EXPOSURE) for i in range(6)]
    followed(frames[:5], tracker=tracker)
    failing = Knowing(exposure=1e-9)
    tracker._solve = failing
    found = tracker.follow(frames[5], MOTION)
    assert found.result.outcome is Outcome.SOLVED and found.result.sign_resolved
    assert wrong(found, times(frames)[5]) < 0.4
    assert solve.starts == []


def test_a_motion_that_is_not_believed_leaves_nothing_of_itself():
    """One across what the neighbours tell, with rows that see different turns."""
    tracker = Tracker(Knowing())
    frames = [frame(i, exposure=EXPOSURE) for i in range(6)]
    followed(frames[:5], tracker=tracker)

    def astray(one, params, *, start=None):
        found = Knowing()(one, params)
        across = np.cross(found.motion.theta, [0, 0, 1])
        return replace(found, motion=replace(found.motion, theta=across, rolling=0.1 * across))

    tracker._solve = astray
    found = tracker.follow(frames[5], MOTION)
    assert found.result.sign_resolved
    assert wrong(found, times(frames)[5]) < 0.4
    assert not found.result.motion.rolling.any()


def test_a_refused_frame_does_not_disturb_the_others():
    def refuse(frame, params, *, start=None):
        raise InputError('no')

    tracker, plain = Tracker(Knowing()), Tracker(Knowing())
    frames = [frame(i) for i in range(6)]
    followed(frames[:3], tracker=tracker)
    followed(frames[:3], tracker=plain)
    knowing, tracker._solve = tracker._solve, refuse
    with pytest.raises(InputError):
        tracker.follow(frames[3], MOTION)
    tracker._solve = knowing
    (found,) = followed(frames[4:5], tracker=tracker)
    assert found.result.sign_resolved


def test_what_is_remembered_can_be_saved():
    frames = [frame(i) for i in range(7)]
    tracker, solve = Tracker(Knowing()), Knowing()
    followed(frames[:4], tracker=tracker)
    state = pickle.loads(pickle.dumps(tracker.state()))
    solve.rng = pickle.loads(pickle.dumps(tracker._solve.rng))
    other = Tracker(solve)
    other.restore(state)
    for one, two in zip(
        followed(frames[4:], tracker=tracker), followed(frames[4:], tracker=other), strict=True
    ):
        np.testing.assert_array_equal(one.result.motion.vector, two.result.motion.vector)
        assert one.exposure == two.exposure


def test_the_image_is_restored_once_under_the_motion_that_was_settled(monkeypatch):
    """The frame's own, or its neighbours' where it fails by itself; in mode motion never."""
    knowing, restored = Knowing(exposure=0.01), []

    def solve(frame, params, *, start=None, restore=True):
        assert not restore
        return knowing(frame, params, start=start)

    def restore(frame, motion, params):
        restored.append(motion.vector)
        return replace(knowing(frame, params), image=1 - frame.image, seconds=0.5)

    monkeypatch.setattr(tracking, 'deblur', solve)
    monkeypatch.setattr(tracking, 'restore_known', restore)
    tracker, frames = Tracker(solve), [frame(i, exposure=0.01) for i in range(6)]
    tracker.follow(frames[0], SolverParams(mode='motion'), frames[1])
    assert not restored
    for f, n in itertools.pairwise(frames[1:]):
        found = tracker.follow(f, SolverParams(mode='fast'), n).result
        np.testing.assert_array_equal(found.image, 1 - f.image)
        own = 0.01 * rate(knowing.time(f.stamp_ns))
        off = min(np.linalg.norm(restored[-1][:3] + s * own) for s in (1, -1))
        assert off < 0.15 * np.linalg.norm(own)
    assert len(restored) == 4
    knowing.exposure = 1e-9  # the last frame fails by itself
    found = tracker.follow(frames[5], SolverParams(mode='fast')).result
    assert len(restored) == 5
    np.testing.assert_allclose(found.motion.vector, restored[-1], atol=1e-4)
    np.testing.assert_array_equal(found.image, 1 - frames[5].image)
    assert found.seconds >= 0.5


def test_a_shift_that_nobody_has_seen_is_not_told():
    p, seconds = np.array([0.01, 0.02, 0, 0.03, 0, 0.01]), 0.02
    seen, unseen = (np.diag([1e-4] * 3 + [(sd * seconds) ** 2] * 3) for sd in (0.1, 1.4))
    told, covariance = _without_unseen(p, seen, seconds)
    assert told is p and covariance is seen
    told, covariance = _without_unseen(p, unseen, seconds)
    np.testing.assert_array_equal(told, [0.01, 0.02, 0, 0, 0, 0])
    assert (np.diag(covariance)[3:] >= np.diag(unseen)[3:] + np.square(p[3:])).all()
