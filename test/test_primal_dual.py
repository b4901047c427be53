"""The paper's image step: scipy's answer to the same question, and what it must never do."""

from dataclasses import replace

from depth_deblur_ros.core.blur import blur_operator
from depth_deblur_ros.core.data import CameraIntrinsics, InputError, Motion
from depth_deblur_ros.core.energy import data_weight, differences, differences_adjoint
from depth_deblur_ros.core.primal_dual import (
    DIFFERENCES_NORM,
    image_energy,
    PrimalDualSteps,
    restore_by_primal_dual,
)
import numpy as np
import pytest
from scipy.optimize import minimize

CAMERA = CameraIntrinsics(60.0, 60.0, 15.5, 15.5, 32, 32)
DEPTH = np.ones((32, 32), np.float32)
MU4 = 0.02
RNG = np.random.default_rng(0)


def blur(p):
    return replace(blur_operator(Motion.from_vector(p), DEPTH, CAMERA), margin=3)


def boxes(shape):
    image = np.full(shape, 0.3)
    image[8:20, 10:22], image[16:28, 5:14] = (0.8, 0.5, 0.2), (0.1, 0.6, 0.9)
    return image


def scipys(start, blurred, operator):
    """Minimise the energy with lengths rounded by 1e-4, by a quasi-Newton method in float64."""

    def both(flat):
        u = flat.reshape(start.shape)
        r = operator.apply(u) - blurred
        d = differences(u)
        length = np.sqrt(np.square(d).sum(0) + 1e-8)
        value = np.vdot(r, data_weight(r)) + MU4 * length.sum()
        slope = 2 * operator.adjoint(data_weight(r)) + MU4 * differences_adjoint(d / length)
        return float(value), slope.ravel()

    options = {'maxiter': 3000, 'maxfun': 5000, 'maxcor': 30, 'ftol': 1e-13, 'gtol': 1e-9}
    found = minimize(both, start.ravel(), jac=True, method='L-BFGS-B', options=options)
    return found.x.reshape(start.shape)


@pytest.mark.parametrize('p', [np.zeros(6), np.array([0, 0.05, 0.05, 0, 0, 0])])
def test_primal_dual_agrees_with_scipy(p):
    operator = blur(p)
    blurred = operator.apply(boxes(operator.latent_shape))
    blurred = blurred + 0.01 * RNG.standard_normal(blurred.shape)
    start = operator.widen(blurred)
    steps = PrimalDualSteps(MU4, eta=1.0, gamma=6.0, count=1200, inner=4)
    found = restore_by_primal_dual(start, blurred, operator, steps)
    peer = scipys(start, blurred, operator)
    energies = [image_energy(u, blurred, operator, MU4) for u in (found, peer)]
    assert energies[0] == pytest.approx(energies[1], rel=1e-3)
    assert np.linalg.norm(found - peer) <= 1e-3 * np.linalg.norm(peer)


def test_the_energy_never_rises_whatever_the_steps():
    operator = blur(np.array([0.03, 0.05, 0, 0, 0, 0]))
    blurred = operator.apply(boxes(operator.latent_shape).astype(np.float32))
    latent = operator.widen(blurred)
    for count, inner in ((1, 1), (2, 1), (5, 3)):
        steps = PrimalDualSteps(0.05 / 255, 10.0, 0.005 * 255, count, inner)
        new = restore_by_primal_dual(latent, blurred, operator, steps)
        before, after = (image_energy(u, blurred, operator, steps.mu4) for u in (latent, new))
        assert after <= before
        latent = new


def test_what_is_sharp_and_still_stays():
    operator = blur(np.zeros(6))
    image = np.full(operator.latent_shape, 0.4, np.float32)
    new = restore_by_primal_dual(
        image, operator.crop(image), operator, PrimalDualSteps(MU4, 1, 6, 5)
    )
    np.testing.assert_allclose(new, image, atol=1e-6)


def test_the_papers_numbers_meet_the_bound_of_convergence():
    PrimalDualSteps(0.05, eta=10.0, gamma=0.005, count=1)  # values 0..255
    PrimalDualSteps(0.05 / 255, eta=10.0, gamma=0.005 * 255, count=1)  # values 0..1
    with pytest.raises(InputError, match=r'eta gamma mu4 must lie in \[0, 0.125\]'):
        PrimalDualSteps(0.05, eta=10.0, gamma=0.5, count=1)


def test_the_bound_is_that_of_the_differences():
    u = RNG.standard_normal((30, 30))
    for _ in range(300):
        u = differences_adjoint(differences(u))
        u = u / np.linalg.norm(u)
    assert 0.97 * DIFFERENCES_NORM < np.square(differences(u)).sum() < DIFFERENCES_NORM
