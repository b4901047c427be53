"""The paper's energy: what each term is, and its gradient against differences of the term."""

from depth_deblur_ros.core import energy
from depth_deblur_ros.core.data import CameraIntrinsics
from depth_deblur_ros.core.geometry import flow
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
import numpy as np
import pytest

CAMERA = CameraIntrinsics(50.0, 52.0, 15.2, 16.1, 34, 32)
RNG = np.random.default_rng(0)
DEPTH = 1 + RNG.random((32, 34))
EDGES = energy.EdgeWeights(0.2, 0.3, 0.1, 0.5)
P = np.array([0.01, -0.02, 0.03, 0.02, -0.01, 0.04])
STEP = 1e-6  # of the central differences; their error is then below 1e-8 of the gradient
pictures = hnp.arrays(np.float64, (5, 7, 3), elements=st.floats(-1, 1))
fields = hnp.arrays(np.float64, (2, 5, 7, 3), elements=st.floats(-1, 1))


def slope(term, at):
    """Give the gradient of a term by central differences."""
    found = np.zeros_like(at)
    for k in np.ndindex(at.shape):
        shift = np.zeros_like(at)
        shift[k] = STEP
        found[k] = (term(at + shift) - term(at - shift)) / (2 * STEP)
    return found


def smoothness():
    image = RNG.random((32, 34, 3)).astype(np.float32)
    cost = energy.edge_weights(image, DEPTH.astype(np.float32), EDGES)
    return cost, energy.smoothness_form(cost, DEPTH, CAMERA)


@given(pictures, fields)
def test_the_adjoint_of_the_differences_is_their_adjoint(u, q):
    left, right = np.vdot(energy.differences(u), q), np.vdot(u, energy.differences_adjoint(q))
    assert left == pytest.approx(right, abs=1e-12)


@pytest.mark.parametrize(
    ('term', 'gradient'),
    [
        (energy.intensity_term, energy.intensity_gradient),
        (energy.difference_term, energy.difference_gradient),
        (lambda u: energy.variation_term(u, 0.05), lambda u: energy.variation_gradient(u, 0.05)),
    ],
)
def test_gradients_of_image_terms_agree_with_differences(term, gradient):
    u = RNG.standard_normal((5, 6, 3))
    np.testing.assert_allclose(gradient(u), slope(term, u), rtol=1e-4, atol=1e-7)


def test_gradients_of_motion_terms_agree_with_differences():
    norm, form = energy.motion_norm(DEPTH, CAMERA), smoothness()[1]
    pairs = [
        (
            energy.motion_gradient(P, norm, -20),
            slope(lambda p: energy.motion_term(p, norm, -20), P),
        ),
        (energy.smoothness_gradient(P, form), slope(lambda p: energy.smoothness_term(p, form), P)),
    ]
    for exact, found in pairs:
        np.testing.assert_allclose(exact, found, rtol=1e-4)


def test_the_data_weight_makes_both_data_terms_one_form():
    r = RNG.standard_normal((5, 6, 3))
    both = energy.intensity_term(r) + energy.difference_term(r)
    assert float(np.vdot(r, energy.data_weight(r))) == pytest.approx(both)


def test_an_even_image_costs_nothing_but_its_own_error():
    even = np.full((6, 7, 3), 0.5)
    assert energy.variation_term(even, 1.0) == energy.difference_term(even) == 0
    assert energy.intensity_term(even) == pytest.approx(6 * 7 * 3 * 0.25)
    assert not energy.variation_gradient(even, 1.0).any()


def test_the_variation_of_a_step_is_its_height_times_its_length():
    step = np.zeros((6, 8, 1))
    step[:, 4:] = 0.5
    assert energy.variation_term(step, 2.0) == pytest.approx(2 * 6 * 0.5)


def test_motion_is_measured_by_its_flow():
    f = flow(P, DEPTH, CAMERA).astype(np.float64)
    expected = -2 * np.square(f).sum(-1).mean()
    found = energy.motion_term(P, energy.motion_norm(DEPTH, CAMERA), -2)
    assert found == pytest.approx(expected, rel=1e-5)


def test_smoothness_is_the_weighted_flow_difference():
    cost, form = smoothness()
    d = energy.differences(flow(P, DEPTH, CAMERA).astype(np.float64))
    expected = (cost * np.square(d).sum((0, -1))).sum()
    assert energy.smoothness_term(P, form) == pytest.approx(expected, rel=1e-4)


def test_edges_of_image_and_depth_let_the_flow_jump():
    image, depth = np.zeros((6, 8, 3), np.float32), np.ones((6, 8), np.float32)
    image[:, 4:], depth[3:] = 1, 3
    cost = energy.edge_weights(image, depth, energy.EdgeWeights(0.2, 0.3, 0.01, 0.02))
    assert cost[0, 0] == pytest.approx(0.5)
    assert cost[0, 3] == pytest.approx(0.3)
    assert cost[2, 0] == pytest.approx(0.2)
    assert cost[2, 3] == pytest.approx(0)
