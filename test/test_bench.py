"""The scores: exact cases, another implementation, the official scorer."""

from dataclasses import astuple
import json
import subprocess
import sys

import cv2
from depth_deblur_ros import bench, cli
from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    DeblurResult,
    InputError,
    Motion,
    Outcome,
    RgbdFrame,
)
from depth_deblur_ros.core.params import SolverParams
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from skimage.metrics import structural_similarity

CAMERA = {'fx': 60.0, 'fy': 60.0, 'cx': 31.5, 'cy': 23.5, 'width': 64, 'height': 48}
TRUE = Motion([0.02, -0.03, 0.05], [0.01, 0.02, -0.03])
STILL = Motion(np.zeros(3), np.zeros(3))


def flat_frame(depth=2.0):
    size = (CAMERA['height'], CAMERA['width'])
    image = np.zeros((*size, 3), np.float32)
    return RgbdFrame(image, np.full(size, depth, np.float32), CameraIntrinsics(**CAMERA))


def write_case(folder, truth=True):
    rng = np.random.default_rng(len(folder.name))
    folder.mkdir(parents=True)
    camera = {**CAMERA, 'depth_scale': 5000, 'exposure': 0.02, 'transfer': 'srgb'}
    (folder / 'camera.json').write_text(json.dumps(camera))
    sharp = rng.integers(0, 256, (48, 64, 3), np.uint8)
    depth = rng.integers(5000, 15000, (48, 64), np.uint16)
    cv2.imwrite(str(folder / 'rgb.png'), cv2.blur(sharp, (3, 3)))
    cv2.imwrite(str(folder / 'depth.png'), depth)
    if truth:
        (folder / 'truth').mkdir()
        cv2.imwrite(str(folder / 'truth/sharp.png'), sharp)
        cv2.imwrite(str(folder / 'truth/depth.png'), depth)
        motion = {'theta': TRUE.theta.tolist(), 'v': TRUE.v.tolist(), 'mean_blur_px': 1.0}
        (folder / 'truth/motion.json').write_text(json.dumps(motion))
    return folder


def fake_deblur(frame, params):
    """Darken the image and report a motion that is not quite the true one."""
    motion = Motion(-1.1 * TRUE.theta, -1.1 * TRUE.v)
    image = np.float32(0.9) * frame.image
    return DeblurResult(image, frame.depth, motion, Outcome.SOLVED, False, 0.8, 3.0, 0.01)


def fake_restore(frame, motion, params):
    return DeblurResult(frame.image, frame.depth, motion, Outcome.SOLVED, True, 1.0, 3.0, 0.01)


@pytest.fixture
def fakes(monkeypatch):
    monkeypatch.setattr(bench, 'deblur', fake_deblur)
    monkeypatch.setattr(bench, 'restore_known', fake_restore)


images = st.integers(0, 2**32 - 1).map(
    lambda seed: np.random.default_rng(seed).integers(0, 256, (2, 21, 34, 3), np.uint8)
)


@given(pair=images, mix=st.floats(0, 1))
def test_ssim_is_that_of_scikit_image(pair, mix):
    a = pair[0]
    b = np.rint(mix * a + (1 - mix) * pair[1]).astype(np.uint8)
    assert bench.ssim(a, b) == pytest.approx(structural_similarity(a, b, channel_axis=-1))


def test_psnr_of_known_errors():
    a = np.zeros((8, 8, 3), np.uint8)
    assert bench.psnr(a, a) == bench.PSNR_LIMIT
    assert bench.psnr(a, a + np.uint8(255)) == pytest.approx(0)
    assert bench.psnr(a, a + np.uint8(51)) == pytest.approx(20 * np.log10(5))


def test_a_sideways_motion_has_the_flow_of_a_pinhole():
    sideways = Motion([0, 0, 0], [0.1, 0, 0])  # 60 px focal length: 6 px over the depth in metres
    assert bench.flow_error(flat_frame(2.1), sideways, STILL) == (pytest.approx(6 / 2.1), 0)
    assert bench.flow_error(flat_frame(1.9), sideways, STILL) == (pytest.approx(6 / 1.9), 100)


@pytest.mark.parametrize('sign', [1, -1])
def test_the_better_sign_counts(sign):
    found = Motion(sign * TRUE.theta, sign * TRUE.v)
    assert bench.flow_error(flat_frame(), TRUE, found) == (0, 0)


def test_holes_in_the_truth_do_not_count():
    frame = flat_frame()
    frame.depth[:10] = np.nan
    assert np.isfinite(bench.flow_error(frame, TRUE, STILL)[0])


def test_a_case_without_truth_is_solved_without_scores(tmp_path, fakes):
    cases = [write_case(tmp_path / 'cases/a-1', truth=False)]
    (row,) = bench.solve_cases(cases, tmp_path / 'out', SolverParams())
    assert row.outcome == 'solved'
    assert row.score is None
    record = json.loads((tmp_path / 'out/a-1/motion.json').read_text())
    assert record['theta'] == pytest.approx(list(-1.1 * TRUE.theta))
    image = cv2.imread(str(tmp_path / 'out/a-1/deblurred.png'))
    blurred = cv2.imread(str(cases[0] / 'rgb.png'))
    np.testing.assert_allclose(image, 0.9 * blurred, atol=0.51)  # rounding to 8 bit


def test_a_broken_case_is_reported_and_the_others_go_on(tmp_path, fakes, capsys):
    for name in ('a-1', 'a-2', 'b-1'):
        write_case(tmp_path / 'cases' / name)
    (tmp_path / 'cases/a-1/depth.png').write_bytes(b'not a picture')
    assert cli.main(['bench', str(tmp_path / 'cases'), '-o', str(tmp_path / 'out')]) == 1
    shown = capsys.readouterr().out
    assert 'a-1' in shown and 'error: ' in shown and 'depth.png' in shown
    assert 'a MEAN (1)' in shown and 'b MEAN (1)' in shown
    table = json.loads((tmp_path / 'out/table.json').read_text())['cases']
    assert [row['outcome'] for row in table] == ['error', 'solved', 'solved']
    assert '| a MEAN (1) |' in (tmp_path / 'out/table.md').read_text()


def test_the_oracle_gets_the_true_motion(tmp_path, fakes):
    cases = [write_case(tmp_path / 'cases/a-1'), write_case(tmp_path / 'cases/a-2', truth=False)]
    known, unknown = bench.solve_cases(cases, tmp_path / 'out', SolverParams(), oracle=True)
    assert known.score.epe == 0
    assert known.score.psnr == known.score.psnr_in
    assert unknown.outcome == 'error' and 'truth/motion.json' in unknown.error


@pytest.mark.parametrize(
    'text', ['', '[]', '{"theta": [1, 2, 3]}', '{"theta": 1, "v": [0, 0, 0]}']
)
def test_a_truth_without_a_motion_is_refused(tmp_path, fakes, text):
    case = write_case(tmp_path / 'cases/a-1')
    (case / 'truth/motion.json').write_text(text)
    (row,) = bench.solve_cases([case], tmp_path / 'out', SolverParams())
    assert row.outcome == 'error'


def test_a_folder_without_cases_is_refused(tmp_path):
    with pytest.raises(InputError, match='holds no case'):
        bench.find_cases(tmp_path)
    with pytest.raises(InputError, match='is not a folder'):
        bench.find_cases(tmp_path / 'nowhere')


def test_the_mean_of_a_tier_counts_only_scores():
    good = bench.Score(1, 20, 30, 0.5, 0.8, 0.1, 5)
    better = bench.Score(3, 22, 34, 0.7, 0.9, 0.3, 7)
    rows = [
        bench.Row('a-1', 'solved', 1.0, good),
        bench.Row('a-2', 'failed', 3.0, better),
        bench.Row('a-3', 'error', error='no'),
    ]
    mean = bench.mean_row(rows)
    assert astuple(mean.score) == pytest.approx((2, 21, 32, 0.6, 0.85, 0.2, 6))
    assert mean.seconds == 2
    assert mean.outcome == '1 error, 1 failed, 1 solved'


def test_scores_are_those_of_the_official_scorer(data, tmp_path, fakes):
    scorer = data.parent / 'tools/score.py'
    if not scorer.exists():
        pytest.skip(f'{scorer} is not there')
    (tmp_path / 'cases').mkdir()
    names = ['camera-mb2006_Aloe', 'paperkitti-kitti_000046', 'still-mb2005_Dolls']
    for name in names:
        (tmp_path / 'cases' / name).symlink_to(data / 'eval' / name)
    cases = bench.find_cases(tmp_path / 'cases')
    rows = list(bench.solve_cases(cases, tmp_path / 'out', SolverParams()))
    command = [sys.executable, scorer, tmp_path / 'cases', tmp_path / 'out']
    subprocess.run([*command, '--json', tmp_path / 'official.json'], check=True)
    table = json.loads((tmp_path / 'official.json').read_text())
    for row, official in zip(rows, table, strict=True):
        assert row.case == official['case']
        for name in ('psnr_in', 'psnr', 'ssim_in', 'ssim', 'epe', 'bad'):
            assert getattr(row.score, name) == pytest.approx(official[name], abs=1e-6), name
        assert row.score.blur_px == pytest.approx(
            official['blur_px'], rel=1e-3
        )  # depth in 1/5000 m
