"""Pairing against the nearest match over all messages."""

from depth_deblur_ros.pairing import DUPLICATE, LATE, NO_DEPTH, StampPairer
from hypothesis import given
from hypothesis import strategies as st
import pytest

SLOP = 20
stamps = st.lists(st.integers(0, 400), max_size=30, unique=True).map(sorted)


def brute_force(colour, depth, slop=SLOP):
    pairs = []
    for c in colour:
        near = [(abs(d - c), d) for d in depth if abs(d - c) <= slop]
        if near:
            pairs.append((c, min(near)[1]))
    return pairs


def push_all(pairer, messages):
    pairs = []
    for is_colour, stamp in messages:
        push = pairer.push_colour if is_colour else pairer.push_depth
        pairs += push(stamp, stamp)
    return pairs + pairer.flush()


@given(colour=stamps, depth=stamps, random=st.randoms(use_true_random=False))
def test_any_interleaving_gives_the_nearest_depth_of_all(colour, depth, random):
    kinds = [True] * len(colour) + [False] * len(depth)
    random.shuffle(kinds)
    streams = {True: iter(colour), False: iter(depth)}
    pairer = StampPairer(SLOP)
    pairs = push_all(pairer, [(kind, next(streams[kind])) for kind in kinds])
    assert pairs == brute_force(colour, depth)
    assert pairer.dropped[NO_DEPTH] == pairer.dropped.total() == len(colour) - len(pairs)


@given(
    messages=st.lists(st.tuples(st.booleans(), st.integers(0, 400)), max_size=80),
    keep=st.integers(1, 5),
)
def test_any_disorder_loses_no_colour_frame_uncounted(messages, keep):
    pairer = StampPairer(SLOP, keep)
    pairs = push_all(pairer, messages)
    colours = [stamp for is_colour, stamp in messages if is_colour]
    given_out = [c for c, _ in pairs]
    assert given_out == sorted(set(given_out))
    assert all(abs(c - d) <= SLOP for c, d in pairs)
    assert len(pairs) + pairer.dropped.total() == len(colours)


def test_a_colour_frame_waits_for_the_nearer_depth():
    pairer = StampPairer(SLOP)
    assert pairer.push_depth(90, 'before') == []
    assert pairer.push_colour(100, 'c') == []
    assert pairer.push_depth(103, 'after') == [('c', 'after')]


def test_one_depth_serves_several_colour_frames():
    pairer = StampPairer(SLOP)
    messages = [(True, 90), (False, 100), (True, 110), (True, 119)]
    assert push_all(pairer, messages) == [(90, 100), (110, 100), (119, 100)]


def test_the_reasons_of_dropped_frames_are_told_apart():
    pairer = StampPairer(SLOP)
    messages = [(True, 100), (True, 100), (False, 100), (True, 100), (True, 90), (True, 131)]
    assert push_all(pairer, messages) == [(100, 100)]
    assert pairer.dropped == {DUPLICATE: 2, LATE: 1, NO_DEPTH: 1}
    assert pairer.nearest_miss_ns == 31


def test_a_jump_back_in_time_starts_again():
    second = 10**9
    pairer = StampPairer(SLOP)
    assert pairer.push_colour(50 * second, 'old') == []
    assert pairer.push_depth(50 * second - 5, 'old') == []
    assert pairer.push_colour(second, 'new') == [('old', 'old')]
    assert pairer.push_depth(second, 'new') == [('new', 'new')]
    assert pairer.dropped.total() == 0


@pytest.mark.parametrize('kind', ['push_colour', 'push_depth'])
def test_memory_is_bounded(kind):
    pairer = StampPairer(SLOP, keep=4)
    for i in range(1000):
        getattr(pairer, kind)(100 * i, i)
    assert len(pairer._colour) <= 4
    assert len(pairer._depth) <= 4


def test_the_pairs_of_a_real_recording_are_its_association_file(data):
    lines = (data / 'tum_fr1_rpy/associations_windows.txt').read_text().splitlines()
    rows = [line.split() for line in lines if not line.startswith('#')]
    truth = [(_ns(row[0]), _ns(row[2])) for row in rows]
    messages = [(True, c) for c, _ in truth] + [(False, d) for d in {d for _, d in truth}]
    pairs = push_all(StampPairer(20_000_000), sorted(messages, key=lambda m: (m[1], m[0])))
    assert pairs == truth


def _ns(text):
    seconds, fraction = text.split('.')
    return int(seconds) * 10**9 + int(fraction.ljust(9, '0'))
