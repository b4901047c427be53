"""Shots of scripts/calibrate.py hold their truth, and errors are counted in deviations."""

import sys

import calibrate
from calibrate import AXES, CAMERA, Shot
from depth_deblur_ros.core.data import DeblurResult, Motion, Outcome, RgbdFrame
from depth_deblur_ros.core.geometry import blur_length
import numpy as np
import pytest

DEPTH = np.full((240, 320), 2, np.float32)
FRAME = RgbdFrame(np.zeros((240, 320, 3), np.float32), DEPTH, CAMERA)


@pytest.fixture(scope='module')
def shot():
    return calibrate.take(3)


def found(motion, outcome=Outcome.SOLVED):
    return DeblurResult(FRAME.image, DEPTH, motion, outcome, False, 0.9, 4.0, 0.1)


def test_a_shot_is_the_same_each_time_and_as_blurred_as_asked(shot):
    again = calibrate.take(3)
    np.testing.assert_array_equal(shot.frame.image, again.frame.image)
    np.testing.assert_array_equal(shot.motion.vector, again.motion.vector)
    low, high = calibrate.BLURS
    assert 0.8 * low < shot.blur < 1.25 * high


@pytest.mark.parametrize('sign', [1, -1])
def test_errors_are_counted_in_deviations_whatever_the_sign(sign):
    true = Motion.from_vector([0.02, 0.01, 0, 0, 0, 0])
    deviations = np.array([1e-3, 2e-3, 1e-3, 1e-2, 1e-2, 1e-2])
    off = np.array([1e-3, -1e-3, 0, 0, 2e-2, 0])
    motion = Motion.from_vector(sign * true.vector + off, np.diag(deviations**2))
    error, miss = calibrate.deviations(Shot(FRAME, true, 5.0), found(motion))
    np.testing.assert_allclose(error, off / deviations)
    assert miss == pytest.approx(blur_length(off, DEPTH, CAMERA))


def test_the_tables_count_what_each_mode_said(shot, tmp_path, monkeypatch, capsys):
    truth = shot.motion.vector
    spread = np.diag(np.square(0.1 * np.abs(truth) + 1e-6))

    def solved(frame, params):
        off = 1.05 if params.mode == 'full' else 1.2
        return found(Motion.from_vector(off * truth, spread))

    monkeypatch.setattr(calibrate, 'take', lambda number, blurs, camera: shot)
    monkeypatch.setattr(calibrate, 'deblur', solved)
    plot, keep = tmp_path / 'plot.svg', tmp_path / 'kept.jsonl'
    line = ['calibrate.py', '--frames', '2', '--plot', str(plot), '--keep', str(keep)]
    monkeypatch.setattr(sys, 'argv', line)
    calibrate.main()
    lines = capsys.readouterr().out.splitlines()
    full, motion = (
        lines.index(f'mode {m}: 0 sharp, 2 solved, 0 failed') for m in ('full', 'motion')
    )
    for k, name in enumerate(AXES):
        assert (
            lines[full + 3 + k].split()
            == f'{name} within 1 sigma 100.0 %, within 3 sigma 100.0 %'.split()
        )
        assert (
            lines[motion + 3 + k].split()
            == f'{name} within 1 sigma 0.0 %, within 3 sigma 100.0 %'.split()
        )
    assert 'mode motion' in plot.read_text()
    monkeypatch.setattr(calibrate, 'take', lambda *_: pytest.fail('rendered again'))
    calibrate.main()
    assert capsys.readouterr().out.splitlines() == lines
