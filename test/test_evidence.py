"""What the spectra say: templates, axes, the score and its slow twin."""

from depth_deblur_ros.core.data import CameraIntrinsics
from depth_deblur_ros.core.evidence import (
    _corners,
    _templates,
    BAND,
    EVEN,
    Evidence,
    gather_evidence,
    MAX_PATCHES,
    motion_axes,
    PATCH,
    REACH,
    scores,
    template_table,
)
from depth_deblur_ros.core.geometry import flow
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import oracle
from pictures import swept, texture
import pytest

CAMERA = CameraIntrinsics(262.0, 262.0, 159.5, 119.5, 320, 240)
DEPTH = np.linspace(1, 4, 320 * 240, dtype=np.float32).reshape(240, 320)
WHOLE = np.ones((240, 320), np.float32)
seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope='module')
def table():
    return template_table()


def evidence_of(grey):
    return gather_evidence(grey, WHOLE, DEPTH, CAMERA, motion_axes(DEPTH, CAMERA))


def made_up_evidence(rng):
    """Give evidence of the right shapes that no picture stands behind."""
    patches, shape = 5, (REACH + 1, 2 * REACH + 1)
    match = rng.standard_normal((patches, *shape)).astype(np.float32)
    energy = rng.random(shape, np.float32)
    return Evidence(match, energy, rng.random(patches), rng.normal(0, 1, (patches, 2, 6)))


def test_no_blur_has_no_bands(table):
    assert table.energy[0, REACH] < 1e-10
    assert table.energy.max() > 0.1
    along = table.energy[0, REACH:]
    assert (np.diff(along[:6]) > 0).all()


def test_templates_of_a_flow_and_its_opposite_are_one(table):
    """And the flows u, -u of the row v = 0 agree, though both are in the table."""
    np.testing.assert_allclose(table.energy[0], table.energy[0, ::-1], atol=1e-6)
    rows = table.templates.reshape(-1, *table.energy.shape)[:, 0]
    np.testing.assert_allclose(rows, rows[:, ::-1], atol=1e-5)
    fy, fx = np.meshgrid(np.fft.fftfreq(PATCH), np.fft.rfftfreq(PATCH), indexing='ij')
    us = np.array([-20.0, -3, 0, 7, 31])
    there, back = (_templates(fx, fy, table.bins, s * us, s * 9.0) for s in (1, -1))
    np.testing.assert_allclose(there, back, atol=1e-5)


def test_mirrored_flows_have_equally_deep_bands(table):
    np.testing.assert_allclose(table.energy, table.energy[:, ::-1], atol=1e-5)


def test_templates_are_blind_to_what_scenes_have_by_themselves(table):
    np.testing.assert_allclose(table.nuisance.T @ table.nuisance, np.eye(26), atol=1e-5)
    assert np.abs(table.nuisance.T @ table.templates).max() < 1e-4
    fy, fx = np.meshgrid(np.fft.fftfreq(PATCH), np.fft.rfftfreq(PATCH), indexing='ij')
    r = np.hypot(fx, fy).flat[table.bins]
    assert BAND[0] < r.min() < r.max() < BAND[1]
    power_law = np.log(r)
    rest = power_law - table.nuisance @ (table.nuisance.T @ power_law)
    assert np.abs(rest).max() < 1e-4


def test_a_template_is_dark_where_the_spectrum_of_a_box_is(table):
    fy, fx = np.meshgrid(np.fft.fftfreq(PATCH), np.fft.rfftfreq(PATCH), indexing='ij')
    t = _templates(fx, fy, table.bins, np.array([12.0]), 0.0)[:, 0]
    f = fx.flat[table.bins]
    assert t[np.abs(f - 1 / 12) < 1e-9].max() < t[f == 0].min() - 2


@pytest.mark.parametrize(
    'shape', [(96, 96), (97, 130), (144, 200), (240, 320), (480, 640), (1200, 1920)]
)
def test_patches_lie_inside_from_border_to_border(shape):
    corners = np.array(_corners(shape))
    assert len(corners) <= MAX_PATCHES
    assert len(np.unique(corners, axis=0)) == len(corners)
    assert (corners >= 0).all()
    assert (corners + PATCH <= shape).all()
    if 144 <= min(shape) <= max(shape) <= 640:
        np.testing.assert_array_equal(corners.min(0), 0)
        np.testing.assert_array_equal(corners.max(0) + PATCH, shape)


def test_axes_are_what_they_are_called():
    """Shifts move the middle by 1 px, roll and zoom a corner; parallax is still on the mean."""
    g = motion_axes(DEPTH, CAMERA)
    assert np.linalg.matrix_rank(g) == 6
    f = [flow(axis, DEPTH, CAMERA) for axis in g.T]
    middle = np.s_[119:121, 159:161]
    for k in (0, 1):
        np.testing.assert_allclose(f[k][middle].mean((0, 1)), np.eye(2)[k], atol=1e-3)
    assert np.linalg.norm(f[2][0, 0]) == pytest.approx(1, rel=0.02)
    assert np.linalg.norm(f[2][middle], axis=-1).max() < 0.01
    flat = np.full_like(DEPTH, 1 / np.mean(1 / DEPTH))
    zoom = flow(g[:, 3], flat, CAMERA)
    assert np.linalg.norm(zoom[0, 0]) == pytest.approx(1, rel=0.02)
    assert (zoom[0, 0] < 0).all()
    for k in (4, 5):
        along = f[k][100:140, 140:180, k - 4]
        w = 1 / DEPTH[100:140, 140:180]
        expected = (w - np.mean(1 / DEPTH)) / np.std(1 / DEPTH)
        np.testing.assert_allclose(along, expected, atol=0.05)


@given(seed=seeds)
@settings(max_examples=25)
def test_the_score_is_its_slow_twin(seed):
    rng = np.random.default_rng(seed)
    evidence = made_up_evidence(rng)
    qs = rng.normal(0, 1, (20, 6)) * rng.uniform(0, 40, (20, 1))
    slow = [oracle.score(q, evidence, EVEN) for q in qs]
    np.testing.assert_allclose(scores(qs, evidence), slow, rtol=1e-6, atol=1e-9)


@given(seed=seeds)
def test_a_motion_and_its_opposite_score_alike(seed):
    rng = np.random.default_rng(seed)
    evidence = made_up_evidence(rng)
    qs = rng.normal(0, 12, (50, 6))
    np.testing.assert_allclose(scores(qs, evidence), scores(-qs, evidence), rtol=1e-9)


def test_flows_beyond_the_table_cost():
    evidence = made_up_evidence(np.random.default_rng(0))
    far = scores(np.full((1, 6), 1e4), evidence)[0]
    assert far == 0
    half = Evidence(abs(evidence.match), evidence.energy, evidence.weight, evidence.flow_of_q)
    assert scores(np.full((1, 6), 0.1), half)[0] < 0


@pytest.mark.parametrize('q', [(12, 0, 0, 0, 0, 0), (5, 9, 0, 0, 0, 0), (-4, 17, 0, 0, 0, 0)])
def test_the_true_motion_scores_better_than_others(q):
    grey = swept(texture(0), float(np.hypot(*q[:2])), float(np.arctan2(q[1], q[0])), 0.005)
    evidence = evidence_of(grey)
    true = scores(np.array([q], float), evidence)[0]
    rng = np.random.default_rng(0)
    others = rng.normal(0, 1, (2000, 6)) * (14, 14, 7, 6, 3, 3)
    others = others[np.minimum(*(np.abs(others - s * np.array(q)).max(1) for s in (1, -1))) > 4]
    assert true < -0.2
    assert true < scores(others, evidence).min()
    assert scores(np.zeros((1, 6)), evidence)[0] == pytest.approx(0, abs=1e-3)


def test_the_evidence_does_not_depend_on_how_bright_the_picture_is():
    grey = swept(texture(1), 10.0)
    plain, dim = evidence_of(grey), evidence_of(np.float32(0.25) * grey)
    np.testing.assert_allclose(plain.weight, dim.weight, rtol=1e-4)
    np.testing.assert_allclose(plain.match, dim.match, atol=2e-3)
    assert plain.weight.sum() == pytest.approx(1)
