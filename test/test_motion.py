"""The paper's motion step: its slope, its descent, and scipy's answer to the same question."""

from dataclasses import replace

import cv2
from depth_deblur_ros.core.blur import blur_operator
from depth_deblur_ros.core.data import CameraIntrinsics, Motion
from depth_deblur_ros.core.energy import edge_weights, EdgeWeights, motion_norm, smoothness_form
from depth_deblur_ros.core.motion import (
    blur_and_slope,
    Bowl,
    damped_step,
    estimate_motion,
    levenberg_marquardt,
    MotionProblem,
    Steps,
    Stop,
)
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.optimize import minimize

CAMERA = CameraIntrinsics(60.0, 62.0, 22.3, 18.6, 44, 38)
TRUE = np.array([0.03, 0.06, -0.05, 0.02, -0.03, 0.05])  # 3 to 6 px
RNG = np.random.default_rng(0)


def problem(mu1=-1e-3, sigma=2.0):
    """Give a tiny case in float64: smooth colours over a slanted wall with a box before it."""
    y, x = np.mgrid[:38, :44]
    depth = (1.5 + x / 80 - 0.5 * ((abs(x - 12) < 7) & (abs(y - 15) < 8))).astype(np.float32)
    blur = replace(blur_operator(Motion.from_vector(TRUE), depth, CAMERA), margin=10)
    latent = cv2.GaussianBlur(RNG.random(blur.latent_shape), (0, 0), sigma)
    latent = (latent - latent.mean()) / latent.std() * 0.2 + 0.5
    blurred = blur_and_slope(TRUE, latent, blur)[0]
    cost = edge_weights(blurred.astype(np.float32), depth, EdgeWeights(0.2, 0.2, 0.01, 0.02))
    form = 1e-3 * smoothness_form(cost, depth, CAMERA)
    return MotionProblem(latent, blurred, blur, motion_norm(depth, CAMERA), form, mu1)


def test_the_slope_of_the_blur_agrees_with_differences():
    case = problem(sigma=0.8)
    slope = blur_and_slope(TRUE, case.latent, case.blur)[1]
    for k in range(6):
        shift = 1e-7 * np.eye(6)[k]
        ahead, behind = (
            blur_and_slope(TRUE + s * shift, case.latent, case.blur)[0] for s in (1, -1)
        )
        found = (ahead - behind) / 2e-7
        # A sample that crosses into the next cell within the difference bends one value.
        off = np.abs(found - slope[..., k]) > 1e-4 * np.abs(slope[..., k]).max()
        assert off.mean() < 2e-3


def test_the_blur_is_the_operators_own():
    case = problem()
    value = blur_and_slope(TRUE, case.latent, case.blur)[0]
    direct = case.blur.apply(case.latent.astype(np.float32))
    np.testing.assert_allclose(value, direct, atol=1e-5)  # float32 positions of the operator


@given(st.lists(st.floats(-0.05, 0.05), min_size=6, max_size=6))
def test_the_gradient_of_the_energy_agrees_with_differences(shift):
    case, p = CASE, TRUE + np.array(shift)
    found = []
    for k in range(6):
        h = 1e-8 * np.eye(6)[k]  # so short that hardly a sample crosses into the next cell
        found.append((case.energy(p + h) - case.energy(p - h)) / 2e-8)
    exact = 2 * case.bowl(p).slope
    assert np.linalg.norm(exact - found) <= 1e-4 * np.linalg.norm(exact)


CASE = problem()


def test_levenberg_marquardt_agrees_with_scipy():
    start = TRUE + np.array([0.006, -0.01, 0.02, -0.01, 0.012, 0.02])
    fit = estimate_motion(start, CASE, 60)
    peer = minimize(
        CASE.energy,
        TRUE,
        method='Nelder-Mead',
        options={'xatol': 1e-8, 'fatol': 1e-14, 'maxfev': 6000, 'maxiter': 6000},
    )
    assert np.linalg.norm(fit.p - peer.x) <= 1e-3 * np.linalg.norm(peer.x)
    assert fit.energies[-1] == pytest.approx(peer.fun, rel=1e-3)


def test_without_rewards_the_true_motion_is_found():
    case = replace(CASE, mu1=0.0, smoothness=np.zeros((6, 6)))
    fit = estimate_motion(TRUE * 0.8, case, 40)
    np.testing.assert_allclose(fit.p, TRUE, atol=1e-5)


@given(st.lists(st.floats(-0.1, 0.1), min_size=6, max_size=6), st.sampled_from([0.0, -0.1, -3.0]))
def test_the_energy_never_rises_over_an_accepted_step(shift, mu1):
    fit = estimate_motion(TRUE + np.array(shift), replace(CASE, mu1=mu1), 6)
    assert all(b < a for a, b in zip(fit.energies, fit.energies[1:], strict=False))


def test_a_reward_makes_the_motion_longer():
    lengths = []
    for mu1 in (0.0, -0.5):
        p = estimate_motion(TRUE, replace(CASE, mu1=mu1), 20).p
        lengths.append(p @ CASE.norm @ p)
    assert lengths[1] > lengths[0]


def test_no_motion_is_a_saddle():
    still = blur_operator(Motion.from_vector(np.zeros(6)), np.ones((38, 44), np.float32), CAMERA)
    case = replace(CASE, blur=replace(still, margin=10))
    assert np.linalg.norm(case.bowl(np.zeros(6)).slope) < 1e-9


def test_what_the_image_can_answer_leaves_longer_steps():
    case = replace(
        CASE, latent=CASE.latent.astype(np.float32), blurred=CASE.blurred.astype(np.float32)
    )
    stiff, soft = (case.bowl(TRUE * 0.9, answering=n) for n in (0, 8))
    np.testing.assert_allclose(stiff.slope, soft.slope)
    steps = [damped_step(bowl, 1e-3) for bowl in (stiff, soft)]
    assert steps[1] @ case.norm @ steps[1] > steps[0] @ case.norm @ steps[0]


def test_a_step_is_no_longer_than_it_may_be():
    bowl = Bowl(1.0, -10 * np.ones(2), np.eye(2))
    fit = levenberg_marquardt(np.ones(2), lambda p: bowl, lambda p: 0.5, np.eye(2), Steps(1, 0.25))
    assert np.linalg.norm(fit.p - 1) == pytest.approx(0.25)


def test_the_reasons_to_stop_are_told():
    flat = Bowl(0.0, np.zeros(2), np.eye(2))
    stuck = levenberg_marquardt(np.ones(2), lambda p: flat, lambda p: 0.0, np.eye(2), Steps(5))
    assert stuck.stop is Stop.NO_DESCENT
    assert estimate_motion(TRUE * 0.9, CASE, 1).stop is Stop.STEP_LIMIT
