"""The image step with the motion known: noise, prior, conjugate gradients."""

from dataclasses import replace
import itertools

import cv2
from depth_deblur_ros.core import latent
from depth_deblur_ros.core.blur import blur_operator, BlurOperator
from depth_deblur_ros.core.data import CameraIntrinsics, Motion
from depth_deblur_ros.core.descent import conjugate_gradients
from depth_deblur_ros.core.latent import (
    _trust_rows,
    FEW,
    LatentSteps,
    noise_sigma,
    restore_coarse_to_fine,
    restored_light,
)
from depth_deblur_ros.core.light import light_from_stored, light_slope, stored_from_light
from depth_deblur_ros.core.quadratic import (
    _link_weights,
    EPSILON,
    EXPONENT,
    reweighted,
    sum_rows,
)
from depth_deblur_ros.core.sweep import GUARD, Sweep
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import oracle
import pytest

CAMERA = CameraIntrinsics(64.0, 64.0, 31.5, 23.5, 64, 48)
DEPTH = np.full((48, 64), 2, np.float32)
STILL = Motion(np.zeros(3), np.zeros(3))
SIDEWAYS = Motion(np.zeros(3), [9 / 32, 0, 0])  # a blur of 9 px at 2 m
STEPS = LatentSteps(prior=2.7, outer=3, inner=10)
WEIGHT = np.float32(2.7 * 0.004**2)
seeds = st.integers(0, 2**32 - 1)
few = settings(max_examples=25)
transfers = pytest.mark.parametrize('transfer', ['srgb', 'linear'])


def cards(seed, shape=(48, 64)):
    """Lay coloured cards over each other: edges, and flat parts between them."""
    rng = np.random.default_rng(seed)
    image = np.full((*shape, 3), 0.4, np.float32)
    for _ in range(shape[0] * shape[1] // 60):
        y, x = rng.integers(-4, shape[0]), rng.integers(-4, shape[1])
        h, w = rng.integers(3, 12, 2)
        image[max(y, 0) : y + h, max(x, 0) : x + w] = rng.uniform(0.05, 0.95, 3)
    return cv2.GaussianBlur(image, (0, 0), 0.5)


def card_planes(seed, height):
    """Give cards as latent planes, 16 wide, `height` rows between the guards."""
    return np.ascontiguousarray(np.moveaxis(cards(seed, (height + 2 * GUARD, 16)), 2, 0))


def inside(planes):
    """Give what lies between the guards as an image (H, W, ...)."""
    return np.moveaxis(planes[:, GUARD:-GUARD], 0, 2)


def restored(taken, blur, transfer, sigma, steps):
    """Give stored values."""
    return stored_from_light(restored_light(taken, blur.sweep, transfer, sigma, steps), transfer)


def links_of(stored):
    links = np.full((4, *stored.shape[1:]), 9, np.float32)  # the last image's
    _link_weights(0, stored.shape[1], stored, WEIGHT, links)
    return links


def smooth(u, links, ease):
    """Give the prior's slope at u and <u, slope>, in latent planes; nothing comes from A'."""
    out, products = np.zeros_like(u), np.zeros((u.shape[1], 2), np.float32)
    strips, rows = np.zeros((1, *u.shape), np.float32), u.shape[1]
    told = strips, rows, u, links, ease, np.float32(1), out, products
    for first, end in itertools.pairwise([0, rows // 3, rows // 3 + 1, rows]):
        sum_rows(first, end, *told)
    own, square = products.sum(0, dtype=np.float64)
    np.testing.assert_allclose(square, np.vdot(out, out / ease), rtol=1e-4)
    return out, own


def blurred_cards(transfer, sigma=0.0, motion=SIDEWAYS, seed=0):
    """Give the sharp cards (stored values), what the motion makes of them, and the operator."""
    blur = blur_operator(motion, DEPTH, CAMERA)
    wide = cards(seed, blur.latent_shape[:2])
    taken = stored_from_light(blur.apply(light_from_stored(wide, transfer)), transfer)
    noise = sigma * np.random.default_rng(seed + 1).standard_normal(taken.shape)
    return blur.crop(wide), np.clip(taken + noise, 0, 1).astype(np.float32), blur


def rms(image):
    return float(np.sqrt(np.square(image, dtype=np.float64).mean()))


@pytest.mark.parametrize('sigma', [0.003, 0.01, 0.03])
@pytest.mark.parametrize('shape', [(240, 320, 3), (120, 160), (48, 64, 3)])
def test_the_noise_of_a_plain_picture_is_found(sigma, shape):
    rng = np.random.default_rng(0)
    image = (0.5 + sigma * rng.standard_normal(shape)).astype(np.float32)
    assert noise_sigma(image) == pytest.approx(sigma, rel=0.2)


@pytest.mark.parametrize('sigma', [0.003, 0.01, 0.03])
def test_the_noise_of_a_blurred_picture_is_found(sigma):
    rng = np.random.default_rng(0)
    image = cv2.blur(cards(3, (240, 320)), (11, 1)) + sigma * rng.standard_normal((240, 320, 3))
    assert noise_sigma(image.astype(np.float32)) == pytest.approx(sigma, rel=0.2)


def test_a_slope_is_no_noise():
    y, x = np.indices((60, 80))
    plane = (0.2 + 0.004 * x + 0.003 * y).astype(np.float32)
    assert noise_sigma(plane) < 1e-6
    assert noise_sigma(np.repeat(plane[..., None], 3, 2)) < 1e-6


@given(seed=seeds, height=st.integers(1, 9))
@few
def test_link_weights_are_their_slow_twin(seed, height):
    stored = card_planes(seed, height)
    links = links_of(stored)
    slow = oracle.link_weights(inside(stored), WEIGHT, EPSILON, EXPONENT)
    np.testing.assert_allclose(inside(links), slow, rtol=2e-4)
    assert not links[:, :GUARD].any()
    assert not links[:, -GUARD:].any()


@given(seed=seeds, height=st.integers(1, 4))
@settings(max_examples=8)
def test_the_prior_is_its_slow_twin_symmetric_and_never_negative(seed, height):
    stored = card_planes(seed, height)
    links, slope = links_of(stored), light_slope(stored, 'srgb')
    within = np.zeros(stored.shape, bool)
    within[:, GUARD:-GUARD] = True
    units = np.eye(stored.size, dtype=np.float32)[within.ravel()].reshape(-1, *stored.shape)
    kernel = np.stack([smooth(unit, links, 1 / slope**2)[0][within] for unit in units], 1)
    np.testing.assert_allclose(kernel, kernel.T, rtol=1e-6)
    parts = (np.ascontiguousarray(inside(part), np.float64) for part in (links, slope**2))
    slow = oracle.prior_matrix(*parts)
    order = np.moveaxis(np.arange(len(slow)).reshape(height, 16, 3), 2, 0).ravel()
    slow = slow[np.ix_(order, order)]
    np.testing.assert_allclose(kernel, slow, rtol=2e-6, atol=2e-6 * np.abs(slow).max(initial=0))
    assert np.linalg.eigvalsh(slow).min() >= -1e-9 * np.abs(slow).max()
    assert (smooth(np.full_like(stored, 0.3), links, 1 / slope**2)[0] == 0).all()


@given(seed=seeds)
@few
def test_the_prior_is_the_gradient_of_its_energy(seed):
    rng = np.random.default_rng(seed)
    stored = card_planes(seed, 4)
    links, scale = links_of(stored), np.square(light_slope(stored, 'srgb'))
    parts = [np.ascontiguousarray(inside(part), np.float64) for part in (links, scale)]
    u = rng.random(stored.shape, np.float32)
    rise, product = smooth(u, links, 1 / scale)
    # Upwards everywhere: of a product that cancels nothing but rounding is left.
    d = np.abs(rng.standard_normal(inside(stored).shape)) * np.sign(inside(rise))
    step = 1e-4
    up, down = (oracle.prior_energy(inside(u) + s * step * d, *parts) for s in (1, -1))
    assert np.vdot(inside(rise), d) == pytest.approx((up - down) / (2 * step), rel=1e-4, abs=1e-8)
    assert product == pytest.approx(2 * oracle.prior_energy(inside(u), *parts), rel=1e-5)


@given(seed=seeds)
@few
def test_reweighting_takes_the_gradient_of_the_sparse_energy(seed):
    """At the image that gave the links, quadratic and hyper-Laplacian rise alike."""
    rng = np.random.default_rng(seed)
    stored = rng.random((4, 5, 3))
    links, ones = oracle.link_weights(stored, 1.0, EPSILON, EXPONENT), np.ones_like(stored)
    each = np.eye(stored.size).reshape(-1, *stored.shape)
    rise = [oracle.prior_energy(stored + e, links, ones) for e in each]
    rise = np.subtract(rise, [oracle.prior_energy(stored - e, links, ones) for e in each])
    # Upwards everywhere, where nothing cancels.
    d = np.abs(rng.standard_normal(stored.shape)) * np.sign(rise).reshape(stored.shape)
    step = 1e-5
    up, down = (
        oracle.sparse_energy(stored + s * step * d, 1.0, EPSILON, EXPONENT) for s in (1, -1)
    )
    quadratic = [oracle.prior_energy(stored + s * step * d, links, ones) for s in (1, -1)]
    assert quadratic[0] - quadratic[1] == pytest.approx(up - down, rel=1e-5)


@pytest.fixture(scope='module')
def quadratic():
    """Give one reweighted problem: its first image, its value in float64, its steps."""
    _, blurred, blur = blurred_cards('srgb', sigma=0.01)
    sweep = blur.sweep
    taken = sweep.blurred_planes(blurred)
    light, trust = light_from_stored(taken, 'srgb'), 1 / np.square(light_slope(taken, 'srgb'))
    first = sweep.widened(light)
    stored = stored_from_light(first, 'srgb')
    problem = reweighted(first, sweep, 'srgb', trust, WEIGHT)
    matrix, shape = oracle.blur_matrix(blur), blur.latent_shape
    rim = sweep.room - blur.margin
    links, scale = (
        np.ascontiguousarray(inside(part), np.float64)
        for part in (problem.links, np.square(light_slope(stored, 'srgb')))
    )

    def value(x):
        image = np.moveaxis(x, 0, 2)[rim : rim + shape[0], rim : rim + shape[1]]
        miss = oracle.through(matrix, image, blurred.shape) - np.moveaxis(light, 0, 2)
        data = np.sum(np.moveaxis(trust, 0, 2) * miss**2)
        return 0.5 * data + oracle.prior_energy(inside(x).astype(np.float64), links, scale)

    def after(limit):
        slope = problem.slope(trust * sweep.missing(light, first), first)
        return conjugate_gradients(problem, first.copy(), slope, limit)

    return first, value, after


def test_a_slope_is_the_same_when_only_the_prior_of_another_is_exchanged():
    rng = np.random.default_rng(0)
    blur = blur_operator(SIDEWAYS, DEPTH, CAMERA)
    sweep, planes = blur.sweep, np.moveaxis(cards(0), 2, 0)
    light = sweep.blurred_planes(cards(1))
    trust = 0.5 + rng.random(sweep.blurred_shape, np.float32)
    first, latent = (sweep.widened(k * planes + 0.1) for k in (0.5, 0.8))
    before, problem = (reweighted(x, sweep, 'srgb', trust, 300 * WEIGHT) for x in (first, latent))
    pull = trust * sweep.missing(light, latent)
    expected = problem.slope(pull, latent)
    found = problem.slope_after(before, before.slope(pull, latent), latent)
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(expected).max())
    assert np.abs(before.slope(pull, latent) - expected).max() > 0.01 * np.abs(expected).max()


@given(seed=seeds)
@few
def test_what_is_saturated_counts_where_the_model_gives_less(seed):
    rng = np.random.default_rng(seed)
    missing, noise = (
        rng.standard_normal((3, 5, 16), np.float32),
        rng.random((3, 5, 16), np.float32),
    )
    full, trust, pull = rng.random(missing.shape) < 0.3, noise.copy(), missing.copy()
    _trust_rows(0, 2, full, trust, pull)
    _trust_rows(2, 5, full, trust, pull)
    np.testing.assert_array_equal(trust, np.where(full & (missing <= 0), np.float32(0), noise))
    np.testing.assert_array_equal(pull, trust * missing)


@pytest.mark.parametrize('share', [0.01, 0.05])
def test_what_is_burnt_is_looked_at_again_where_it_is_much(monkeypatch, share):
    """Each time that it is, the latent image is blurred once more."""
    rng, calls, missing = np.random.default_rng(0), [], Sweep.missing
    monkeypatch.setattr(Sweep, 'missing', lambda *told: calls.append(told) or missing(*told))
    taken = np.where(rng.random((48, 64, 1)) < share, np.float32(1), 0.9 * cards(0))
    restored(taken, blur_operator(SIDEWAYS, DEPTH, CAMERA), 'srgb', 0.004, STEPS)
    assert len(calls) == (STEPS.outer if share > FEW else 1)


def test_no_step_of_the_conjugate_gradients_raises_the_quadratic(quadratic):
    first, value, after = quadratic
    np.testing.assert_array_equal(after(0), first)
    values = [value(after(limit)) for limit in range(16)]
    assert (np.diff(values) <= 1e-6 * values[0]).all()
    assert values[10] < 0.2 * values[0]


def test_the_slope_that_is_left_is_that_of_the_image_that_is_given():
    """The next reweighting begins with it."""
    _, taken, blur = blurred_cards('srgb', sigma=0.01)
    sweep, stored = blur.sweep, blur.sweep.blurred_planes(taken)
    light, trust = light_from_stored(stored, 'srgb'), 1 / np.square(light_slope(stored, 'srgb'))
    first = sweep.widened(light)
    problem = reweighted(first, sweep, 'srgb', trust, WEIGHT)
    slope = problem.slope(trust * sweep.missing(light, first), first)
    begun = np.abs(slope).max()
    image = conjugate_gradients(problem, first.copy(), slope, 5)
    expected = problem.slope(trust * sweep.missing(light, image), image)
    np.testing.assert_allclose(slope, expected, atol=1e-5 * begun)


def test_many_steps_reach_the_minimum_of_the_quadratic(quadratic):
    """There the slope of the quadratic along any direction is nothing beside what it was."""
    first, value, after = quadratic
    best, rng, step = after(200), np.random.default_rng(0), 1e-3
    directions = rng.standard_normal((5, *first.shape))
    before, left = (
        max(abs(value(x + step * d) - value(x - step * d)) for d in directions)
        for x in (first.astype(np.float64), best.astype(np.float64))
    )
    assert left < 2e-3 * before


@transfers
def test_without_motion_and_noise_little_is_changed(transfer):
    sharp, taken, blur = blurred_cards(transfer, motion=STILL)
    found = restored(taken, blur, transfer, 0.0, STEPS)
    assert found.shape == sharp.shape
    assert found.dtype == np.float32
    assert rms(found - sharp) < 0.01


@transfers
def test_a_plain_picture_stays_plain(transfer):
    blur = blur_operator(SIDEWAYS, DEPTH, CAMERA)
    for level in (0.0, 0.02, 0.5, 1.0):
        plain = np.full((48, 64, 3), level, np.float32)
        found = restored(plain, blur, transfer, 0.004, STEPS)
        np.testing.assert_allclose(found, level, atol=2e-4)


@transfers
@pytest.mark.parametrize('sigma', [0.0, 0.01])
def test_the_restored_picture_is_closer_to_the_sharp_one(transfer, sigma):
    sharp, taken, blur = blurred_cards(transfer, sigma)
    found = restored(taken, blur, transfer, sigma, STEPS)
    assert 0 <= found.min() <= found.max() <= 1
    assert rms(found - sharp) < 0.5 * rms(taken - sharp)


@pytest.mark.parametrize(
    ('transfer', 'sigma', 'slack'), [('linear', 0, 0), ('srgb', 0, 0.2), ('linear', 0.02, 0.2)]
)
def test_blocks_have_slack_where_noise_hides_it(monkeypatch, transfer, sigma, slack):
    """Where none is found, sRGB is taken to hide some."""
    taken, told, thinned = blurred_cards(transfer, sigma)[1], [], BlurOperator.thinned

    def spied(blur, spacing, slack):
        told.append(slack)
        return thinned(blur, spacing, slack)

    monkeypatch.setattr(BlurOperator, 'thinned', spied)
    camera = replace(CAMERA, transfer=transfer)
    restore_coarse_to_fine(taken, DEPTH, SIDEWAYS, camera, STEPS)
    assert told
    assert told == pytest.approx([slack] * len(told))


@pytest.mark.parametrize('brief', [False, True])
def test_long_blurs_have_wider_instants_in_brief_where_there_is_noise(monkeypatch, brief):
    """As many at half the size; 10 px are no long blur."""
    told, operator = [], latent.blur_operator

    def spied(motion, depth, camera, spacing):
        told.append(spacing)
        return operator(motion, depth, camera, spacing)

    monkeypatch.setattr(latent, 'blur_operator', spied)
    camera = CameraIntrinsics(128.0, 128.0, 63.5, 47.5, 128, 96)
    depth, taken = np.full((96, 128), 2, np.float32), cards(0, (96, 128))
    for length in (10, 40):
        motion = Motion(np.zeros(3), [length / 64, 0, 0])
        restore_coarse_to_fine(taken, depth, motion, camera, replace(STEPS, brief=brief))
    half, usual, coarse, long = told
    assert half == usual
    assert (long > usual) == brief
    assert coarse == pytest.approx(max(long / 2, usual))


@pytest.mark.parametrize(('transfer', 'fewer'), [('srgb', True), ('linear', False)])
def test_to_be_brief_saves_steps_where_there_is_noise(transfer, fewer, monkeypatch):
    """Where none is found, sRGB is taken to hide some."""
    taken, limits = blurred_cards(transfer)[1], []
    camera = replace(CAMERA, transfer=transfer)

    def counted(problem, image, slope, limit):
        limits[-1].append(limit)
        return image

    monkeypatch.setattr(latent, 'conjugate_gradients', counted)
    monkeypatch.setattr(latent, 'picture_sigma', lambda _: 0.0)
    for brief in (False, True):
        limits.append([])
        steps = LatentSteps(2.7, 2, 12, brief=brief)
        restore_coarse_to_fine(taken, DEPTH, SIDEWAYS, camera, steps)
    usual, brief = limits
    assert brief[-1] == usual[-1]
    assert (brief[-2] < usual[-2]) == fewer
    assert (brief != usual) == fewer


def test_a_coarse_start_brings_the_same_steps_closer():
    camera = CameraIntrinsics(128.0, 128.0, 79.5, 63.5, 160, 128)
    depth, motion = np.full((128, 160), 2, np.float32), Motion(np.zeros(3), [16 / 64, 0, 0])
    blur, steps = blur_operator(motion, depth, camera), LatentSteps(2.7, 1, 10)
    height, width, _ = blur.latent_shape
    wide = cv2.resize(cards(1, (height // 4, width // 4)), (width, height))
    taken = stored_from_light(blur.apply(light_from_stored(wide, 'srgb')), 'srgb')
    plain = restored(taken, blur, 'srgb', noise_sigma(taken), steps)
    coarse = restore_coarse_to_fine(taken, depth, motion, camera, steps)
    sharp = blur.crop(wide)
    assert rms(coarse - sharp) < 0.8 * rms(plain - sharp) < 0.8 * rms(taken - sharp)


def test_saturated_pixels_do_not_darken_a_lamp(monkeypatch):
    """A lamp four times as light as white, blurred and clipped, with and without their care."""
    blur = blur_operator(SIDEWAYS, DEPTH, CAMERA)
    light = np.full(blur.latent_shape, 0.1, np.float32)
    middle = np.array(light.shape[:2]) // 2
    light[middle[0] - 4 : middle[0] + 4, middle[1] - 4 : middle[1] + 4] = 4
    taken = stored_from_light(blur.apply(light), 'srgb')
    assert (taken >= latent.SATURATED).any()
    sharp = stored_from_light(blur.crop(light), 'srgb')
    careful = restored(taken, blur, 'srgb', 0.002, STEPS)
    monkeypatch.setattr(latent, 'SATURATED', 2.0)
    careless = restored(taken, blur, 'srgb', 0.002, STEPS)
    assert rms(careful - sharp) < 0.8 * rms(careless - sharp)
    assert rms(careful - sharp) < 0.8 * rms(taken - sharp)


def test_what_is_brighter_than_white_stays_so_from_size_to_size():
    """A picture at three times the light: what was cut to white at half the size would ring."""
    camera = CameraIntrinsics(128.0, 128.0, 79.5, 63.5, 160, 128)
    depth, motion = np.full((128, 160), 2, np.float32), Motion(np.zeros(3), [20 / 64, 0, 0])
    blur = blur_operator(motion, depth, camera)
    height, width, _ = blur.latent_shape
    wide = cv2.resize(cards(2, (height // 4, width // 4)), (width, height))
    light = 3 * light_from_stored(wide, 'srgb')
    sharp = stored_from_light(blur.crop(light), 'srgb')
    taken = stored_from_light(blur.apply(light), 'srgb')
    found = restore_coarse_to_fine(taken, depth, motion, camera, STEPS)
    assert rms(found - sharp) < 0.65 * rms(taken - sharp)


def test_more_prior_is_smoother():
    _, taken, blur = blurred_cards('srgb', sigma=0.02)
    rough = [
        rms(np.diff(restored(taken, blur, 'srgb', 0.02, LatentSteps(c, 3, 10)), axis=0))
        for c in (0.3, 3, 30)
    ]
    assert rough[0] > rough[1] > rough[2]
