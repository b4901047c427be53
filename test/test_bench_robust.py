"""Each change of scripts/bench_robust.py does what its name says, and the table counts it."""

from dataclasses import replace
import json
import sys

import bench_robust
from bench_robust import Case, CHANGES
import cv2
from depth_deblur_ros import bench
from depth_deblur_ros.core.light import light_from_stored
from depth_deblur_ros.core.params import SolverParams
import numpy as np
import pytest

STILL = {'theta': [0, 0, 0], 'v': [0, 0, 0]}


@pytest.fixture
def case():
    rng = np.random.default_rng(1)
    sharp = cv2.resize(rng.integers(20, 250, (12, 16, 3), np.uint8), (160, 120))
    depth = rng.integers(5000, 9000, (120, 160), np.uint16)
    motion = {'theta': [0, 0.02, 0], 'v': [0, 0, 0]}
    return Case(cv2.blur(sharp, (9, 1)), sharp, depth, 'srgb', motion)


def same(a, b, but):
    """Tell whether two cases differ in nothing but the fields named."""
    kept = {'blurred', 'sharp', 'depth', 'transfer', 'motion'} - set(but)
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in kept)


@pytest.mark.parametrize(('name', 'share'), [('noise-1', 0.01), ('noise-2', 0.02)])
def test_noise_is_as_strong_as_it_says(case, name, share):
    grey = replace(case, blurred=np.full_like(case.blurred, 128))
    found = CHANGES[name](grey)
    assert same(found, grey, ['blurred'])
    assert found.blurred.std() / 255 == pytest.approx(share, rel=0.03)
    assert found.blurred.mean() == pytest.approx(128, abs=0.1)


@pytest.mark.parametrize('transfer', ['srgb', 'linear'])
def test_overexposure_doubles_the_light_of_both_pictures_and_clips(case, transfer):
    found = CHANGES['overexposed'](replace(case, transfer=transfer))
    assert same(found, replace(case, transfer=transfer), ['blurred', 'sharp'])
    for before, after in ((case.blurred, found.blurred), (case.sharp, found.sharp)):
        light, twice = (
            light_from_stored((pixels / 255).astype(np.float32), transfer)
            for pixels in (before, after)
        )
        np.testing.assert_allclose(twice, np.minimum(2 * light, 1), atol=0.005)  # 8 bit
        assert (after == 255).any()


def test_jpeg_costs_the_picture_a_little(case):
    found = CHANGES['jpeg'](case)
    assert same(found, case, ['blurred'])
    assert 25 < bench.psnr(found.blurred, case.blurred) < 45


def test_depth_moves_to_the_right_and_down_and_leaves_holes(case):
    found = CHANGES['depth-shift'](case)
    assert same(found, case, ['depth'])
    assert found.depth[53, 78] == case.depth[50, 70]
    assert not found.depth[:3].any()
    assert not found.depth[:, :8].any()


def test_sharp_pictures_have_no_motion(case):
    found = CHANGES['sharp'](case)
    assert same(found, case, ['blurred', 'motion'])
    assert (found.blurred is case.sharp, found.motion) == (True, STILL)


def test_the_table_has_a_row_for_each_change(case, tmp_path, monkeypatch, capsys):
    source = tmp_path / 'cases/small-one'
    (source / 'truth').mkdir(parents=True)
    camera = {'fx': 200, 'fy': 200, 'cx': 79.5, 'cy': 59.5, 'width': 160, 'height': 120}
    camera |= {'depth_scale': 5000, 'exposure': None, 'transfer': 'srgb'}
    (source / 'camera.json').write_text(json.dumps(camera))
    cv2.imwrite(str(source / 'truth/depth.png'), case.depth)
    bench_robust.write_case(tmp_path / 'cases/small-two', source, case)
    bench_robust.write_case(source, tmp_path / 'cases/small-two', case)
    line = ['bench_robust.py', str(tmp_path / 'cases'), '-o', str(tmp_path / 'out')]
    line += ['--changes', 'clean', 'sharp', '--mode', 'motion', '--threads', '1']
    monkeypatch.setattr(sys, 'argv', line)
    bench_robust.main()
    head, _, clean, sharp = capsys.readouterr().out.splitlines()
    cells = [cell.strip() for cell in clean.strip('|').split('|')]
    assert head.count('|') == clean.count('|') == sharp.count('|')
    assert cells[0] == 'clean'
    assert sum(map(int, cells[3].split('/'))) == 2
    table = json.loads((tmp_path / 'out/clean/table.json').read_text())['cases']
    epe = np.mean([row['score']['epe'] for row in table])
    assert float(cells[1]) == pytest.approx(epe, abs=0.006)
    assert sharp.split('|')[2].strip() == '0.00'  # motion zero is the truth there


def test_a_long_blur_stored_as_jpeg_is_found(data, tmp_path):
    """Of 45 px, refined at half the size; with 14 instants over them it ends 3 px off."""
    case = data / 'eval/paper-mb2006_Cloth1'
    (row,) = bench_robust.solved([case], 'jpeg', tmp_path, SolverParams())
    assert row.score.blur_px > 40
    assert (row.outcome, row.score.bad) == ('solved', 0.0)
    assert row.score.epe < 2.2
