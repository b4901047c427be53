"""The time between frames whose stamps jitter."""

from itertools import accumulate

from depth_deblur_ros.cadence import Cadence
import numpy as np
import pytest

# As they come from a real camera of 30 Hz.
JITTER = [0.0290, 0.0395, 0.0325, 0.0280, 0.0399, 0.0323, 0.0279, 0.0393, 0.0321, 0.0286, 0.0392]


def cadences(intervals):
    return list(accumulate(intervals, Cadence.later, initial=Cadence()))[1:]


def test_jitter_is_evened_out():
    found = cadences(JITTER)
    assert found[-1].usual == pytest.approx(1 / 30, rel=0.02)
    for cadence in found[3:]:
        assert cadence.even == pytest.approx(1 / 30, rel=0.05)
    assert 0 < found[-1].doubt < 0.02 < found[2].doubt


def test_even_stamps_leave_no_doubt():
    cadence = cadences([0.02] * 6)[-1]
    assert (cadence.even, cadence.doubt) == (pytest.approx(0.02), pytest.approx(0, abs=1e-12))


def test_frames_that_were_left_out_count():
    cadence = cadences([*JITTER[:5], 0.0671, 0.0330])[-2]
    assert cadence.even == pytest.approx(2 / 30, rel=0.03)


def test_another_rate_is_no_jitter():
    found = cadences([1 / 30] * 20 + [1 / 24] * 6)
    off = [abs(cadence.even * 24 - 1) for cadence in found[20:]]
    assert max(off) < 0.25 and off[2:] == pytest.approx([0] * 4)


def test_stamps_that_run_away_are_taken_as_they_are():
    rng = np.random.default_rng(0)
    intervals = list(0.033 * np.exp(0.5 * rng.standard_normal(30)))
    found = cadences(intervals)
    same = [c.even == i for c, i in zip(found, intervals, strict=True)]
    assert np.mean(same) > 0.7


def test_nothing_seen_is_no_error():
    assert Cadence().usual > 0 and Cadence().doubt == 0
