"""The exposure from frame to frame."""

from depth_deblur_ros.shutter import agree, Exposure, Shutter
import numpy as np
import pytest


def run(values, doubt=0.1):
    shutter, found = Shutter(), []
    for value in values:
        shutter, now = shutter.later().measured(Exposure(value, doubt))
        found.append((shutter.exposure.seconds, now.seconds))
    return found


def test_noise_is_averaged_out():
    rng = np.random.default_rng(0)
    found = run(0.02 * np.exp(0.1 * rng.standard_normal(40)))
    assert np.abs(np.log([f[0] / 0.02 for f in found[10:]])).max() < 0.12


@pytest.mark.parametrize('after', [0.01, 0.013, 0.03, 0.04])
def test_a_step_is_followed_within_two_frames(after):
    found = run([0.02] * 8 + [after] * 2, doubt=0.08)
    assert found[-1][0] == pytest.approx(after, rel=0.05)


def test_one_wrong_frame_changes_nothing_but_itself():
    found = run([0.02] * 5 + [0.06] + [0.02] * 2, doubt=0.05)
    assert found[5][0] == pytest.approx(0.02)
    assert found[5][1] == pytest.approx(0.06)
    assert found[-1][0] == pytest.approx(0.02, rel=0.01)


def test_doubt_grows_with_time_and_over_gaps():
    shutter, _ = Shutter().measured(Exposure(0.02, 0.05))
    assert shutter.exposure.doubt < shutter.later().exposure.doubt
    assert shutter.later().exposure.doubt < shutter.later(gap=True).exposure.doubt
    assert Shutter().later() == Shutter()


def test_errors_that_are_alike_do_not_average_out():
    shutter = Shutter()
    for _ in range(50):
        shutter, _ = shutter.measured(Exposure(0.02, 0.1))
    assert shutter.exposure.doubt >= 0.03


def test_agreement_is_a_matter_of_doubt():
    assert agree(Exposure(0.02, 0.1), Exposure(0.025, 0.1))
    assert not agree(Exposure(0.02, 0.03), Exposure(0.025, 0.03))
