"""The paper's method as a whole: one flag, known motion, energies that only fall."""

from dataclasses import replace
import json
from pathlib import Path

from depth_deblur_ros.cli import main
from depth_deblur_ros.core import alternation
from depth_deblur_ros.core.alternation import alternate, LevelProblem, restore
from depth_deblur_ros.core.blur import blur_operator
from depth_deblur_ros.core.data import CameraIntrinsics, InputError, Motion, Outcome, RgbdFrame
from depth_deblur_ros.core.energy import TERMS
from depth_deblur_ros.core.geometry import blur_length, flow
from depth_deblur_ros.core.params import params_from_mapping, SolverParams
from depth_deblur_ros.core.pyramid import Level
from depth_deblur_ros.core.solver import deblur, restore_known
import numpy as np
from pictures import texture
import pytest
import yaml

PAPER = Path(__file__).resolve().parents[1] / 'config/paper.yaml'
CAMERA = CameraIntrinsics(250.0, 250.0, 119.5, 89.5, 240, 180, transfer='linear')
DEPTH = np.linspace(1.5, 2.5, 240, dtype=np.float32) * np.ones((180, 1), np.float32)
TRUE = np.array([0.02, -0.035, 0.025, 0, 0.01, 0])  # 10 px, rolling by up to 3 px
QUICK = SolverParams(method='paper', levels=4, alternations=2, kernel_size=17)


def blurred_picture():
    """Give sharp and blurred light, both by the package's own blur."""
    blur = blur_operator(Motion.from_vector(TRUE), DEPTH, CAMERA)
    height, width = blur.latent_shape[:2]
    sharp = np.stack([texture(k, (height, width)) for k in (5, 5, 6)], -1)
    return blur.crop(sharp), blur.apply(sharp)


def psnr(a, b):
    return -10 * np.log10(np.square(a - b).mean())


def flow_miss(p):
    true, found = flow(TRUE, DEPTH, CAMERA), flow(p, DEPTH, CAMERA)
    return min(float(np.hypot(*(true - s * found).transpose(2, 0, 1)).mean()) for s in (1, -1))


@pytest.fixture(scope='module')
def pictures():
    return blurred_picture()


@pytest.fixture(scope='module')
def found(pictures):
    return alternate(pictures[1], DEPTH, CAMERA, QUICK)


def test_the_file_holds_the_papers_numbers_and_one_flag():
    values = yaml.safe_load(PAPER.read_text())['/**']['ros__parameters']
    params = params_from_mapping(values)
    assert params.method == 'paper'
    assert (params.mu1, params.mu2, params.mu3, params.mu4) == (-20, 0.2, 0.2, 0.05)
    assert (params.sigma_b, params.sigma_d) == (0.01, 0.02)
    assert (params.eta, params.gamma) == (10, 0.005)
    assert (params.levels, params.scale_factor, params.kernel_size) == (11, 0.9, 25)


def test_the_default_is_not_the_papers():
    assert SolverParams().method == 'spectra'


@pytest.mark.slow
def test_the_motion_is_found_and_the_image_gains(pictures, found):
    sharp, blurred = pictures
    assert found.outcome is Outcome.SOLVED
    assert flow_miss(found.p) < 1.0
    latent = restore(blurred, DEPTH, CAMERA, found.p, QUICK)
    assert psnr(latent, sharp) > psnr(blurred, sharp) + 3


@pytest.mark.slow
def test_turns_bring_the_motion_nearer_than_the_uniform_start(pictures, found):
    levels = alternation.build_pyramid(Level(pictures[1], DEPTH, CAMERA), 4, 0.9)
    start = alternation.first_motion(levels, QUICK)
    assert flow_miss(found.p) < 0.7 * flow_miss(start)


@pytest.mark.slow
def test_the_energy_never_rises_over_an_accepted_step(found):
    assert found.trace
    pairs = zip(found.trace[::2], found.trace[1::2], strict=True)
    for before, after in pairs:
        assert (before.level, before.step.split()[1:]) == (after.level, after.step.split()[1:])
        assert set(before.terms) == set(TERMS)
        assert sum(after.terms.values()) < sum(before.terms.values())


def test_a_level_weighs_its_reward_by_what_the_image_costs(pictures):
    problem = LevelProblem.at(Level(pictures[1], DEPTH, CAMERA), QUICK)
    state = problem.answer(TRUE)
    reward = problem.reward(state) * problem.length(TRUE) ** 2
    assert reward == pytest.approx(-alternation.REWARD * state.energy)
    assert problem.length(TRUE) == pytest.approx(blur_length(TRUE, DEPTH, CAMERA), rel=0.1)


def test_true_motions_have_the_lowest_merit_along_their_line(pictures):
    problem = LevelProblem.at(Level(pictures[1], DEPTH, CAMERA), QUICK)
    merits = [problem.merit_of(s * TRUE) for s in (0.5, 0.75, 1.0, 1.3, 1.6)]
    assert int(np.argmin(merits)) == 2


@pytest.mark.slow
def test_a_sharp_picture_passes_unchanged():
    image = np.stack([texture(5, (180, 240))] * 3, -1)
    result = deblur(RgbdFrame(image, DEPTH, CAMERA), QUICK)
    assert result.outcome in (Outcome.SHARP, Outcome.FAILED)
    assert (result.image == image).all()
    assert not result.motion.vector.any()


def test_grey_frames_come_back_grey(pictures):
    grey = np.clip(pictures[1], 0, 1)[..., 0].copy()
    known = restore_known(RgbdFrame(grey, DEPTH, CAMERA), Motion.from_vector(TRUE), QUICK)
    assert known.image.shape == grey.shape
    assert psnr(known.image, pictures[0][..., 0]) > psnr(grey, pictures[0][..., 0]) + 3


def test_steps_that_may_diverge_are_refused():
    params = replace(QUICK, gamma=1.0)
    image = np.full((180, 240, 3), 0.5, np.float32)
    with pytest.raises(InputError, match='eta gamma mu4'):
        restore(image, DEPTH, CAMERA, TRUE, params)


def test_bad_values_are_refused():
    for name, value in {'mu1': 1.0, 'levels': 0, 'scale_factor': 1.0, 'method': 'none'}.items():
        with pytest.raises(InputError, match=name):
            SolverParams(**{name: value})


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_one_case_of_the_papers_protocol_from_the_command_line(data, tmp_path):
    cases = tmp_path / 'cases'
    cases.mkdir()
    (cases / 'paper-mb2006_Cloth3').symlink_to(data / 'eval/paper-mb2006_Cloth3')
    assert main(['bench', str(cases), '-o', str(tmp_path / 'out'), '--params', str(PAPER)]) == 0
    row = next(iter(json.loads((tmp_path / 'out/table.json').read_text())['cases']))
    assert row['outcome'] == 'solved'
    assert row['score']['psnr'] > row['score']['psnr_in'] + 3
    record = json.loads((tmp_path / 'out/paper-mb2006_Cloth3/motion.json').read_text())
    totals = [sum(step['terms'].values()) for step in record['energies']]
    assert len(totals) >= 4
    assert all(after < before for before, after in zip(totals[::2], totals[1::2], strict=True))
