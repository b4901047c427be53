"""The slope of the likelihood against dense algebra, and the scales against what was put in."""

from depth_deblur_ros.core import likelihood
from depth_deblur_ros.core.blur import blur_operator
from depth_deblur_ros.core.data import CameraIntrinsics, Motion
from depth_deblur_ros.core.likelihood import (
    curvature_of,
    Pace,
    Part,
    posterior,
    settled,
    slope_of,
)
import numpy as np
import oracle
from pictures import texture
import pytest

TINY = CameraIntrinsics(40.0, 40.0, 15.5, 15.5, 32, 32, transfer='linear')
TRUTH = np.array([0.0, 0.1, 0.03, 0.02, 0.0, 0.0])


def part(camera, motion, seed=0, sigma=0.01, scene=0, pace=None):
    """Give a part of a picture that a motion blurs, with noise, before a slanted wall."""
    shape = camera.height, camera.width
    depth = np.float32(2 + 0.5 * np.indices(shape)[1] / shape[1])
    blur = blur_operator(Motion.from_vector(motion), depth, camera)
    high, wide, _ = blur.latent_shape
    latent = np.repeat(texture(scene, (high, wide))[..., None], 3, 2).astype(np.float32)
    noise = sigma * np.random.default_rng(5).standard_normal(shape)
    light = np.float32(blur.apply(latent)[..., 0] + noise)
    return Part(light, np.ones(shape, np.float32), depth, camera, seed, pace=pace or Pace())


def dense(found):
    """Give A, W, R [float64] of a posterior's quadratic, over the whole latent planes."""
    problem, sweep = found.problem, found.problem.sweep
    _, high, wide = sweep.latent_shape
    width = found.part.light.shape[1]
    columns = np.eye(high * wide, dtype=np.float32).reshape(-1, high, wide)
    a, r = [], []
    trust = problem.trust
    for column in columns:
        x = np.repeat(column[None], 3, 0)
        a.append(sweep.gather(x, np.ones_like(trust))[0, :, :width].ravel())
        none = np.zeros_like(trust)
        r.append(-problem.slope(none, x)[0].ravel())
    return np.array(a, np.float64).T, trust[0][:, :width].ravel().astype(np.float64), np.array(r)


def minus_log_likelihood(p, one):
    """Give - log of the likelihood of B with the prior's links held: L Gaussian, marginalised."""
    found = posterior(one, p)
    a, w, r = dense(found)
    matrix = (a.T * w) @ a + r.astype(np.float64)
    b = one.light.astype(np.float64).ravel()
    best = np.linalg.solve(matrix + 1e-9 * np.eye(len(matrix)), a.T @ (w * b))
    left = b - a @ best
    energy = left @ (w * left) + best @ r @ best
    determinant = np.linalg.slogdet(matrix + 1e-9 * np.eye(len(matrix)))[1]
    return 0.5 * energy / one.scales.sigma**2 + 0.5 * determinant


@pytest.fixture
def converged(monkeypatch):
    """Hold the links at the blurred picture, which no motion changes; give a pace to the end."""
    monkeypatch.setattr(likelihood, 'REWEIGHTINGS', 1)
    return Pace(last=250)


@pytest.mark.slow
@pytest.mark.parametrize('axis', [1, 7])
def test_the_slope_is_that_of_the_marginal_likelihood(axis, converged):
    """
    Along a turn, and one that rows see differently, by central differences of dense algebra.

    The samples average to the trace.
    """
    p, step, along = np.pad(0.9 * TRUTH, (0, 3)), 2e-4, np.eye(9)[axis]
    p[7] = 0.02
    one = part(TINY, TRUTH, pace=converged)
    ahead, behind = (minus_log_likelihood(p + s * step * along, one) for s in (1, -1))
    parts = [part(TINY, TRUTH, seed, pace=converged) for seed in range(40)]
    told = [slope_of(posterior(one, p))[0] @ along for one in parts]
    expected = (ahead - behind) / (2 * step)
    error = 3 * np.std(told) / np.sqrt(len(told)) + 0.05 * abs(expected)
    assert abs(np.mean(told) - expected) < error
    assert error < 0.5 * abs(expected)


def test_curvature_is_less_than_with_the_image_held():
    """And never negative: part of what a motion changes, another image makes up for."""
    found = posterior(part(TINY, TRUTH), TRUTH)
    _, slope = slope_of(found)
    yn = found.blur.ray[-slope.shape[1] :, None]
    flat = np.concatenate([slope, yn * slope[:3]]).reshape(9, -1)
    held = found.problem.trust[0].ravel() * flat @ flat.T / found.part.scales.sigma**2
    answered = curvature_of(found, slope)
    assert np.linalg.eigvalsh(answered).min() > 0
    assert (np.diag(answered) < np.diag(held)).all()


@pytest.mark.parametrize('sigma', [0.004, 0.02])
def test_noise_is_found(sigma):
    camera = CameraIntrinsics(120.0, 120.0, 63.5, 63.5, 128, 128, transfer='linear')
    motion = np.array([0.0, 0.06, 0, 0, 0, 0])
    found = settled(part(camera, motion, sigma=sigma), motion).part
    assert 0.8 * sigma < found.scales.sigma < 1.25 * sigma


def test_a_smoother_scene_has_more_prior():
    """The same scene at a third of its contrast, and of its noise."""
    camera = CameraIntrinsics(120.0, 120.0, 63.5, 63.5, 128, 128, transfer='linear')
    motion = np.array([0.0, 0.06, 0, 0, 0, 0])
    one = part(camera, motion, sigma=0.004)
    faint = Part(one.light / 3, one.counts, one.depth, camera, 0)
    assert settled(faint, motion).part.scales.prior > 1.2 * settled(one, motion).part.scales.prior


def test_the_adjoint_of_the_test_is_the_operator(converged):
    """The dense A of these tests agrees with the slow twin."""
    found = posterior(part(TINY, TRUTH), TRUTH)
    a, _, _ = dense(found)
    own = likelihood.OWN_SPACING * found.part.pace.spacing
    matrix = oracle.matrix_of(found.blur, *oracle.thinned_displacements(found.blur, own))
    inner = np.random.default_rng(0).random(matrix.shape[1])
    planes = np.zeros(found.problem.sweep.latent_shape)
    high, wide, _ = found.blur.latent_shape
    found.blur.latent_part(planes)[0] = inner.reshape(high, wide)
    np.testing.assert_allclose(a @ planes[0].ravel(), matrix @ inner, atol=1e-4)


def test_the_posterior_is_that_of_slopes_that_are_asked_anew():
    """It exchanges the prior's part of the slope, and of the noise, with each reweighting."""
    own, p = part(TINY, 0.5 * TRUTH), np.pad(0.5 * TRUTH, (0, 3))
    _, sweep, latent = likelihood._unblurred(own, p)
    data, trust = likelihood._observed(own, sweep)
    for k in reversed(range(likelihood.REWEIGHTINGS)):
        problem = likelihood._weighted(own, sweep, trust, latent)
        push = problem.slope(trust * sweep.missing(data, latent), latent)
        push[1:] += own.scales.sigma * likelihood._prior_noise(problem, own.seed)
        steps = own.pace.steps if k else own.pace.last
        latent = likelihood.conjugate_gradients(problem, latent, push, steps)
    found = posterior(own, p).latent
    assert np.abs(found[1:]).max() > 0.01
    np.testing.assert_allclose(found, latent, atol=1e-4)


def test_sums_over_links_are_those_of_the_matrix():
    """x' R x by rows, and noise whose covariance is R."""
    found = posterior(part(TINY, 0.5 * TRUTH), np.pad(0.5 * TRUTH, (0, 3)))
    problem, rng = found.problem, np.random.default_rng(0)
    x = found.latent + rng.standard_normal(found.latent.shape, np.float32)
    none = np.zeros(problem.sweep.blurred_shape, np.float32)
    expected = [
        -float(np.vdot(plane, r)) for plane, r in zip(x, problem.slope(none, x), strict=True)
    ]
    told = likelihood._roughness(problem, x) * x[0].size
    np.testing.assert_allclose(told, expected, rtol=1e-4)
    noise = [likelihood._prior_noise(problem, seed).astype(np.float64) for seed in range(200)]
    told = np.mean([np.sum(n * x[:2], (1, 2)) ** 2 for n in noise])
    assert told == pytest.approx(np.mean(expected[:2]), rel=0.3)
