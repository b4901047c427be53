"""Whether a shutter rolls and what stamps mean shows in the ways between frames."""

from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.tracking import Tracker
import numpy as np
import pytest
from turning import EXPOSURE, frame, Knowing, picture, rate, START_NS, STEP_NS

MOTION = SolverParams(mode='motion')
STEP = STEP_NS / 1e9
STRIP = 8  # rows


def rolled(seconds, readout):
    """Give what a camera sees that reads its rows one after the other."""
    found = np.empty((144, 192, 3), np.float32)
    for first in range(0, 144, STRIP):
        late = readout * ((first + STRIP / 2 - 0.5 - 71.5) / 144)
        found[first : first + STRIP] = picture(seconds + late)[first : first + STRIP]
    return found


def followed(seconds, stamps=None, readout=0.0):
    """Let a tracker follow frames taken at these times with these stamps [s]."""
    stamps = seconds if stamps is None else stamps
    taken = {START_NS + round(1e9 * s): t for s, t in zip(stamps, seconds, strict=True)}
    tracker, off = Tracker(Knowing(time=lambda stamp: taken[stamp])), []
    frames = [frame(0, t, EXPOSURE, rolled(t, readout) if readout else None) for t in seconds]
    for f, stamp in zip(frames, taken, strict=True):
        object.__setattr__(f, 'stamp_ns', stamp)
    for f, n in zip(frames, [*frames[1:], None], strict=True):
        found = tracker.follow(f, MOTION, n).result
        truth = rate(taken[f.stamp_ns])
        off.append(np.linalg.norm(found.motion.theta / EXPOSURE - truth))
    return tracker._habits, np.array(off)


@pytest.mark.parametrize('readout', [0.0, 0.02, -0.02])
def test_a_rolling_shutter_is_found_and_allowed_for(readout):
    habits, off = followed(STEP * np.arange(24), readout=readout)
    assert habits.readout * STEP == pytest.approx(readout, abs=0.006)
    assert np.sqrt(np.square(off[6:]).mean()) < 0.12


def test_jitter_is_told_from_frames_that_are_uneven():
    rng = np.random.default_rng(2)
    even = STEP * np.arange(24)
    jittered = even + rng.choice([-0.003, 0, 0.003], 24)
    habits, off = followed(even, jittered)
    assert habits.evenness > 0.9 and np.median(off[6:]) < 0.1
    habits, off = followed(jittered)
    assert habits.evenness < 0.1 and np.median(off[6:]) < 0.1


def test_even_stamps_may_mean_either():
    habits, _ = followed(STEP * np.arange(8))
    assert habits.evenness == pytest.approx(0.5, abs=1e-6)
