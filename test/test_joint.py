"""The joint refinement: nearer to the truth than its start, and nowhere without a reason."""

from pathlib import Path
import subprocess
import sys

from depth_deblur_ros.core import joint
from depth_deblur_ros.core.blur import blur_operator
from depth_deblur_ros.core.data import CameraIntrinsics, InputError, Motion, Outcome
from depth_deblur_ros.core.geometry import blur_length
from depth_deblur_ros.core.joint import Effort, refine
from depth_deblur_ros.core.likelihood import Pace
from depth_deblur_ros.core.pyramid import Level
from depth_deblur_ros.core.solver import BRIEF
from depth_deblur_ros.core.start import motion_axes, Start
import numpy as np
from pictures import texture
import pytest

CAMERA = CameraIntrinsics(180.0, 180.0, 111.5, 79.5, 224, 160, transfer='linear')
DEPTH = np.float32(1.5 + np.indices((160, 224))[1] / 224)
TRUTH = np.array([0.01, 0.05, 0.02, 0, 0, 0])
EFFORT = Effort(80_000)


def blurred(truth, sigma=0.004):
    """Blur a texture by exact averaging over a motion, with noise."""
    blur = blur_operator(Motion.from_vector(truth), DEPTH, CAMERA)
    high, wide, _ = blur.latent_shape
    latent = np.repeat(texture(3, (high, wide))[..., None], 3, 2).astype(np.float32)
    noise = sigma * np.random.default_rng(1).standard_normal(DEPTH.shape)
    return np.float32(blur.apply(latent)[..., 0] + noise)


def start(p, sd=0.7):
    """Give a first motion with the covariance of so many pixels each way."""
    axes = motion_axes(DEPTH, CAMERA)
    spread = sd**2 * axes @ axes.T
    return Start(Motion.from_vector(p), Outcome.SOLVED, 1.0, axes, spread)


def off(p, truth=TRUTH):
    return blur_length(p - truth, DEPTH, CAMERA)


@pytest.mark.parametrize('factor', [0.9, 1.1])
@pytest.mark.parametrize(('effort', 'left'), [(EFFORT, 0.4), (BRIEF, 0.5)])
def test_a_start_that_is_too_short_or_too_long_comes_nearer(factor, effort, left):
    found = refine(blurred(TRUTH), DEPTH, CAMERA, start(factor * TRUTH), effort)
    assert off(found.vector) < left * off(factor * TRUTH)


@pytest.mark.parametrize(
    'wrong',
    [{'pixels': 0}, {'moves': 0}, {'affordable': 0.0}, {'readable': 0.0}, {'enough': np.nan}],
)
def test_an_effort_that_is_none_is_refused(wrong):
    with pytest.raises(InputError, match='not Effort'):
        Effort(**{'pixels': 80_000, **wrong})


def test_a_pace_that_leads_nowhere_is_refused():
    for wrong in ({'spacing': 0.0}, {'spacing': np.nan}, {'steps': 0}, {'last': 0}):
        with pytest.raises(InputError, match='not Pace'):
            Pace(**wrong)


def test_the_truth_stays():
    found = refine(blurred(TRUTH), DEPTH, CAMERA, start(TRUTH), EFFORT)
    assert off(found.vector) < 0.2


def test_a_plain_wall_leaves_the_start():
    plain = np.full(DEPTH.shape, 0.5, np.float32)
    found = refine(plain, DEPTH, CAMERA, start(TRUTH), EFFORT)
    assert off(found.vector) < 0.01


def test_an_image_that_tells_something_narrows_the_covariance():
    begun = start(TRUTH)
    found = refine(blurred(TRUTH), DEPTH, CAMERA, begun, EFFORT)
    axes = np.linalg.inv(motion_axes(DEPTH, CAMERA)[:6, :6])
    sd = np.sqrt(np.diag(axes @ found.covariance @ axes.T))
    assert (sd <= 0.7 + 1e-9).all()
    assert sd[0] < 0.35


def parts_of(light, length, effort):
    level, pixels = joint._readable(Level(light, DEPTH, CAMERA), length, effort)
    return [joint._part(level, k, pixels, effort.pace) for k in range(4)]


def test_a_long_blur_is_read_at_half_the_size(monkeypatch):
    monkeypatch.setattr(joint, 'LEAST_SIDE', 40)
    parts = parts_of(blurred(TRUTH), 9.0, Effort(80_000, readable=5.0))
    assert {part.light.shape for part in parts} == {(40, 56)}
    fx = {part.camera.fx for part in parts}
    assert fx == {CAMERA.fx / 2}


def test_at_half_the_size_half_as_many_pixels_are_looked_at(monkeypatch):
    monkeypatch.setattr(joint, 'LEAST_SIDE', 40)
    monkeypatch.setattr(joint, 'MOST', 14_000)
    for readable, most in ((50.0, 14_000), (5.0, 7_000)):
        parts = parts_of(blurred(TRUTH), 9.0, Effort(80_000, readable=readable))
        assert sum(part.light.size for part in parts) == pytest.approx(most, rel=0.05)


def test_of_long_blurs_fewer_pixels_of_any_picture_are_looked_at():
    for wanted in (10_000, 10 * DEPTH.size):
        effort = Effort(wanted, affordable=6.0)
        parts = parts_of(blurred(TRUTH), 9.0, effort)
        most = min(wanted, DEPTH.size) * 6 / 9
        assert sum(part.light.size for part in parts) == pytest.approx(most, rel=0.05)


def test_parts_lie_where_the_picture_is_busy():
    light = np.full(DEPTH.shape, 0.5, np.float32)
    light[10:40, 60:100] += texture(0, (30, 40)) - 0.5
    part = parts_of(light, 5.0, Effort(160 * 224 // 4))[0]
    assert part.light.std() > 0
    assert np.ptp(part.light) == pytest.approx(np.ptp(light), rel=1e-6)


def test_the_camera_of_a_part_sees_what_the_frame_sees():
    """A ray through a part's pixel is the ray through the same pixel of the frame."""
    light = blurred(TRUTH)
    for part in parts_of(light, 5.0, Effort(160 * 224 // 4)):
        left, top = CAMERA.cx - part.camera.cx, CAMERA.cy - part.camera.cy
        assert left == round(left) and top == round(top)
        rows, columns = part.light.shape
        cut = light[round(top) : round(top) + rows, round(left) : round(left) + columns]
        np.testing.assert_array_equal(part.light, cut)


def test_disagreement_softens():
    """Parts with one optimum are believed; parts that pull apart are not."""
    bends = np.array([np.eye(6) * 1e4] * 4)
    optimum = np.ones(6)
    agree = -bends @ optimum
    assert joint._softening(agree, bends, 10.0) == joint.SOFTEST
    apart = agree + 1e4 * np.array([[1.0], [-1], [1], [-1]])
    assert joint._softening(apart, bends, 10.0) > 100 * joint.SOFTEST


def test_the_curvature_follows_a_quadratic():
    """Symmetric rank one finds the curvature along each move, but stays within its bounds."""
    rng = np.random.default_rng(0)
    first = np.eye(6)
    true = np.diag([0.5, 0.8, 0.9, 1.0, 1.1, 0.6])
    bend = first
    for _ in range(12):
        move = rng.standard_normal(6)
        bend = joint._bent(bend, first, move, true @ move)
    np.testing.assert_allclose(bend, true, atol=1e-6)
    wild = joint._bent(first, first, np.eye(6)[0], 50 * np.eye(6)[0])
    assert np.linalg.eigvalsh(wild).max() <= joint.BENDS[1] + 1e-9


def test_no_threads_of_numba_are_started():
    """They would be one more pool, which waits by spinning."""
    code = (
        'import numba, test_joint as t; '
        't.refine(t.blurred(t.TRUTH), t.DEPTH, t.CAMERA, t.start(0.9 * t.TRUTH), t.EFFORT); '
        'numba.threading_layer()'
    )
    done = subprocess.run(
        [sys.executable, '-c', code],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.stderr.endswith('ValueError: Threading layer is not initialized.\n')
