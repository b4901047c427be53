"""What the spectra say: axes, the score and its slow twin."""

from dataclasses import replace

from depth_deblur_ros.core.data import CameraIntrinsics
from depth_deblur_ros.core.evidence import (
    _corners,
    Evidence,
    gather_spectra,
    MAX_PATCHES,
    motion_axes,
    thinned,
)
from depth_deblur_ros.core.geometry import flow
from depth_deblur_ros.core.scores import EVEN, rough_scores, scores
from depth_deblur_ros.core.search import FEWER, seen_at
from depth_deblur_ros.core.spectra import patch_spectra
from depth_deblur_ros.core.templates import ACROSS, PATCH, REACH, template_table
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
    return spectra_of(grey).evidence()


def spectra_of(grey):
    return gather_spectra((grey, WHOLE, DEPTH), CAMERA, motion_axes(DEPTH, CAMERA))


def made_up_evidence(rng):
    """Give evidence of the right shapes that no picture stands behind."""
    patches, shape = 5, (REACH + 1, ACROSS)
    match = rng.standard_normal((patches, *shape)).astype(np.float32)
    energy, sag = rng.uniform(0.5, 1, shape), rng.random((*shape, 2))
    weight, flow_of_q = rng.random(patches), rng.normal(0, 1, (patches, 2, 9))
    return Evidence(match, *(np.float32(a) for a in (energy, sag, weight, flow_of_q)))


def test_spectra_are_those_of_each_patch_by_itself(table):
    grey = swept(texture(1), 7)
    valid = np.random.default_rng(0).random(grey.shape, np.float32)
    corners = [(0, 0), (48, 0), (144, 0), (48, 100), (144, 224)]
    power, weight = patch_spectra(grey, valid, corners, table.bins)
    gy, gx = (np.pad(d, 1) for d in (grey[2:] - grey[:-2], grey[:, 2:] - grey[:, :-2]))
    gy, gx = gy[:, 1:-1] / 2, gx[1:-1] / 2  # the border mirrors: no gradient across it
    window = np.outer(*[np.hanning(PATCH + 2)[1:-1]] * 2)
    for k, (y, x) in enumerate(corners):
        cut = np.s_[y : y + PATCH, x : x + PATCH]
        fields = [window * valid[cut] * g[cut] for g in (gy, gx)]
        slow = sum(np.abs(np.fft.rfft2(field)) ** 2 for field in fields).flat[table.bins]
        np.testing.assert_allclose(power[k], slow, rtol=1e-3, atol=1e-5 * slow.max())
        assert weight[k] == pytest.approx(sum(np.square(f).mean() for f in fields), rel=1e-4)


def test_one_motion_is_heard_alone_as_among_all():
    spectra, q = spectra_of(swept(texture(1), 7)), np.array([5.0, -3, 1, 0.5, 0, 0, 0, 0, 0])
    assert seen_at(spectra, q) == pytest.approx(-scores(q[None], spectra.evidence())[0], rel=1e-4)


@pytest.mark.parametrize(
    'shape', [(96, 96), (97, 130), (144, 200), (240, 320), (480, 640), (1200, 1920)]
)
@pytest.mark.parametrize('most', [MAX_PATCHES, FEWER])
def test_patches_lie_inside_from_border_to_border(shape, most):
    corners = np.array(_corners(shape, most))
    assert len(corners) <= most
    assert len(np.unique(corners, axis=0)) == len(corners)
    assert (corners >= 0).all()
    assert (corners + PATCH <= shape).all()
    if 144 <= min(shape) <= max(shape) <= 640:
        np.testing.assert_array_equal(corners.min(0), 0)
        np.testing.assert_array_equal(corners.max(0) + PATCH, shape)


def test_axes_are_what_they_are_called():
    """Shifts move the middle by 1 px, roll and zoom a corner; parallax is still on the mean."""
    g = motion_axes(DEPTH, CAMERA)
    assert np.linalg.matrix_rank(g) == 9
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
    qs = rng.normal(0, 1, (20, 9)) * rng.uniform(0, 40, (20, 1))
    slow = [oracle.score(q, evidence, EVEN) for q in qs]
    np.testing.assert_allclose(scores(qs, evidence), slow, rtol=2e-4, atol=2e-4)


@given(seed=seeds)
@settings(max_examples=25)
def test_the_rough_score_is_its_slow_twin(seed):
    """That of the nearest templates: (11) without what lies between them."""
    rng = np.random.default_rng(seed)
    evidence = made_up_evidence(rng)
    qs = rng.normal(0, 1, (20, 6)) * rng.uniform(0, 40, (20, 1))
    flows = np.einsum('bij,mj->mbi', np.float64(evidence.flow_of_q[..., :6]), qs)
    u, v = np.moveaxis(np.where(flows[..., 1:] < 0, -flows, flows), 2, 0)
    inside = np.maximum(abs(u), v) < REACH
    # A flow half-way between two templates may go to either.
    sure = (np.abs((np.stack([u, v]) % 1) - 0.5).min((0, 2)) > 1e-4).nonzero()[0]
    column, row = (np.floor(np.where(inside, a, 0) + 0.5).astype(int) for a in (u, v))
    patch = np.arange(len(evidence.weight))
    c = np.where(inside, evidence.match[patch, row, column + REACH], 0) @ evidence.weight
    d = np.where(inside, evidence.energy[row, column + REACH], 1) @ evidence.weight
    slow = -c / np.sqrt(d + EVEN)
    np.testing.assert_allclose(rough_scores(qs, evidence)[sure], slow[sure], rtol=1e-4, atol=1e-5)


@given(seed=seeds)
def test_a_motion_and_its_opposite_score_alike(seed):
    rng = np.random.default_rng(seed)
    evidence = made_up_evidence(rng)
    qs = rng.normal(0, 12, (50, 6))
    np.testing.assert_allclose(scores(qs, evidence), scores(-qs, evidence), rtol=1e-6)


def test_flows_beyond_the_table_cost():
    evidence = made_up_evidence(np.random.default_rng(0))
    far = scores(np.full((1, 6), 1e4), evidence)[0]
    assert far == 0
    half = replace(evidence, match=abs(evidence.match))
    assert scores(np.full((1, 6), 0.1), half)[0] < 0


def test_every_second_patch_is_heard_in_a_thinned_evidence():
    evidence = made_up_evidence(np.random.default_rng(0))
    half = thinned(evidence)
    np.testing.assert_array_equal(half.match, evidence.match[::2])
    assert half.weight.sum() == pytest.approx(1)


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


@pytest.mark.parametrize('q', [(12, 0, 0, 0, 0, 0), (-3, 1, 2, 0, 1, 0), (-40, 54, 0, 3, 0, 0)])
def test_evidence_around_a_motion_is_the_whole_evidence_there(q):
    spectra = spectra_of(swept(texture(1), 10.0))
    whole, some = (
        spectra.evidence(),
        spectra.evidence_around(np.pad(np.array(q, float), (0, 3)), 8),
    )
    near = np.array(q) + np.random.default_rng(0).uniform(-0.6, 0.6, (200, 6))
    np.testing.assert_array_equal(scores(near, some), scores(near, whole))
    wanted = some.match.any(0)
    np.testing.assert_array_equal(some.match[:, wanted], whole.match[:, wanted])
    assert wanted.mean() < 0.5
    assert not scores(np.array([[-q[1], q[0] + 30.0, 0, 0, 0, 0]]), some)[0]
