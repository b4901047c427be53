"""Templates of straight blurs, and how patches are matched with them."""

from depth_deblur_ros.core.templates import (
    ACROSS,
    BAND,
    BLOCK,
    in_blocks,
    matches,
    PATCH,
    product,
    REACH,
    template_table,
)
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import oracle
import pytest

COLUMNS = 2 * REACH + 1


@pytest.fixture(scope='module')
def table():
    return template_table()


def rows_of(table):
    """Give the templates (n, rows, u)."""
    t = table.templates.transpose(2, 0, 1, 3)
    return t.reshape(len(t), REACH + 1, ACROSS)[..., :COLUMNS]


@pytest.mark.parametrize('v', [0, 1, 17, REACH])
def test_templates_are_their_slow_twin(table, v):
    slow = oracle.templates(table.bins, np.arange(-REACH, REACH + 1.0), float(v))
    slow -= table.nuisance @ (table.nuisance.T @ slow)
    np.testing.assert_allclose(rows_of(table)[:, v], slow, atol=1e-4)
    np.testing.assert_allclose(table.energy[v, :COLUMNS], np.square(slow).mean(0), atol=1e-5)


@pytest.mark.parametrize('cell', [(0, 3), (2, -2), (5, 9), (11, -30)])
def test_the_energy_between_whole_pixels_is_that_of_the_template_there(table, cell):
    """That of the bilinear mean of four, but for a term that counts in the shortest only."""
    v, x = cell[0], cell[1] + REACH
    t, d = rows_of(table)[:, v : v + 2, x : x + 2], table.energy[v : v + 2, x : x + 2]
    for a, b in ((0.5, 0), (0, 0.5), (0.5, 0.5), (0.3, 0.8)):
        w = np.outer([1 - b, b], [1 - a, a])
        sag = np.array([a * (1 - a), b * (1 - b)]) @ table.sag[v, x]
        exact = np.square((w * t).sum((1, 2))).mean()
        assert (w * d).sum() - sag == pytest.approx(exact, rel=0.1)
        assert sag > 0


@given(rows=st.integers(1, 9), inner=st.integers(1, 40), columns=st.integers(1, 70))
@settings(max_examples=20)
def test_products_by_blocks_are_products(rows, inner, columns):
    rng = np.random.default_rng(rows + inner + columns)
    left, right = (rng.standard_normal(s, np.float32) for s in ((rows, inner), (inner, columns)))
    found = product(left, in_blocks(right))
    np.testing.assert_allclose(found[:, :columns], left @ right, atol=1e-4)
    assert not found[:, columns:].any()


@given(patches=st.integers(1, 9), seed=st.integers(0, 2**32 - 1))
@settings(max_examples=10)
def test_matches_are_products(patches, seed):
    rng = np.random.default_rng(seed)
    logs = rng.standard_normal((patches, 30)).astype(np.float32)
    templates = rng.standard_normal((2, ACROSS // BLOCK, 30, BLOCK)).astype(np.float32)
    found = matches(logs, templates)
    slow = np.einsum('bn,vkni->bvki', logs, templates).reshape(patches, 2, ACROSS) / 30
    np.testing.assert_allclose(found, slow, atol=1e-5)


def test_no_blur_has_no_bands(table):
    assert table.energy[0, REACH] < 1e-10
    assert table.energy.max() > 0.1
    along = table.energy[0, REACH:COLUMNS]
    assert (np.diff(along[:6]) > 0).all()


def test_templates_of_a_flow_and_its_opposite_are_one(table):
    """And the flows u, -u of the row v = 0 agree, though both are in the table."""
    still = table.energy[0, :COLUMNS]
    np.testing.assert_allclose(still, still[::-1], atol=1e-6)
    rows = rows_of(table)[:, 0]
    np.testing.assert_allclose(rows, rows[:, ::-1], atol=1e-5)
    us = np.array([-20.0, -3, 0, 7, 31])
    there, back = (oracle.templates(table.bins, s * us, s * 9.0) for s in (1, -1))
    np.testing.assert_allclose(there, back, atol=1e-5)


def test_mirrored_flows_have_equally_deep_bands(table):
    energy = table.energy[:, :COLUMNS]
    np.testing.assert_allclose(energy, energy[:, ::-1], atol=1e-5)


def test_templates_are_blind_to_what_scenes_have_by_themselves(table):
    np.testing.assert_allclose(table.nuisance.T @ table.nuisance, np.eye(26), atol=1e-5)
    assert np.abs(np.tensordot(table.nuisance, rows_of(table), (0, 0))).max() < 1e-4
    fy, fx = np.meshgrid(np.fft.fftfreq(PATCH), np.fft.rfftfreq(PATCH), indexing='ij')
    r = np.hypot(fx, fy).flat[table.bins]
    assert BAND[0] < r.min() < r.max() < BAND[1]
    power_law = np.log(r)
    rest = power_law - table.nuisance @ (table.nuisance.T @ power_law)
    assert np.abs(rest).max() < 1e-4


def test_a_template_is_dark_where_the_spectrum_of_a_box_is(table):
    f = np.tile(np.fft.rfftfreq(PATCH), PATCH)[table.bins]
    t = oracle.templates(table.bins, np.array([12.0]), 0.0)[:, 0]
    assert t[np.abs(f - 1 / 12) < 1e-9].max() < t[f == 0].min() - 2
