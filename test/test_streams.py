"""How streams with known motion are scored."""

from bench_streams import right_again, score, velocities
from break_streams import AFTER
from make_streams import streams
import numpy as np
import pytest

EXPOSURE = 0.01
TWISTS = np.tile([0.5, -1.0, 0.2, 0.1, 0.3, -0.2], (20, 1))


def record(twist, exposure=EXPOSURE, sign=True):
    """Give what an estimates file says of a frame with that velocity."""
    motion = -EXPOSURE * np.array(twist)
    theta, v = motion[:3].tolist(), motion[3:].tolist()
    return {'theta': theta, 'v': v, 'exposure': exposure, 'sign_resolved': sign}


def test_what_is_right_has_no_error():
    found = score([record(twist) for twist in TWISTS], TWISTS, np.full(20, EXPOSURE))
    assert (found.exposure, found.sign, found.told) == (0, 1, 1)
    assert found.turn == pytest.approx(0, abs=1e-12)
    assert str(found) == '| 0.0 % | 0.000 | 0.000 | 100 | 100 | 0.000 | 0.000 |'


def test_a_frame_that_tells_nothing_counts_as_still():
    silent = [record(twist, sign=k % 4 > 0) for k, twist in enumerate(TWISTS)]
    found = score(silent, TWISTS, np.full(20, EXPOSURE))
    assert found.told == 0.75
    assert found.turn == found.shift == pytest.approx(0.5)
    assert found.told_turn == pytest.approx(0, abs=1e-12)
    assert np.isnan(velocities(silent)).any(axis=1).sum() == 5
    unknown = [record(twist, exposure=None) for twist in TWISTS]
    assert score(unknown, TWISTS, np.full(20, EXPOSURE)).exposure == 1


def test_the_first_right_frame_after_a_break_is_told():
    records = [record(twist) for twist in TWISTS]
    assert right_again(records, TWISTS) == f'| 1 | {AFTER} of {AFTER} |'
    records[-AFTER] = record(1.3 * TWISTS[0])
    records[-AFTER + 1] = record(TWISTS[0], sign=False)
    assert right_again(records, TWISTS) == f'| 3 | {AFTER - 2} of {AFTER} |'
    wrong = [record(-twist) for twist in TWISTS]
    assert right_again(wrong, TWISTS) == f'| none | 0 of {AFTER} |'


def test_other_seeds_give_other_streams_of_the_same_kinds():
    one, two = streams(0), streams(1)
    assert one.keys() == two.keys()
    for name in one:
        assert one[name].scene_seed != two[name].scene_seed
        assert not np.allclose(one[name].path.phase, two[name].path.phase)
        assert one[name].exposure(30) == two[name].exposure(30)
