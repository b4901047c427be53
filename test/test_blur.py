"""The blur operator: exact cases, its adjoint, the slow twins."""

from depth_deblur_ros.core.blur import blur_operator, BlurOperator, MAX_SAMPLES, MIN_SAMPLES
from depth_deblur_ros.core.data import CameraIntrinsics, Motion
from depth_deblur_ros.core.geometry import flow, normalised_grid
from depth_deblur_ros.core.instants import APART, FEWEST, MANY
from depth_deblur_ros.core.seen import _fill_uncovered, _see, MIN_INVERSE_DEPTH, ROW
from depth_deblur_ros.core.threads import at_most
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import oracle
import pytest

CAMERA = CameraIntrinsics(64.0, 64.0, 31.5, 23.5, 64, 48)
# A coordinate below 100 is rounded by 4e-6, and so is what lies between two values 1 apart.
TOL = 2e-5
seeds = st.integers(0, 2**32 - 1)
threads = st.sampled_from([1, 2])
few = settings(max_examples=25)


def steps_in_depth(rng, shape):
    """Give a wall with three boards before it."""
    depth = np.full(shape, rng.uniform(2, 8), np.float32)
    for z in np.sort(rng.uniform(0.8, 3, 3))[::-1]:
        y, x = rng.integers(0, shape[0] - 6), rng.integers(0, shape[1] - 6)
        h, w = rng.integers(4, 25, 2)
        depth[y : y + h, x : x + w] = z
    return depth


@st.composite
def blurs(draw):
    """Draw an operator: a small camera, a blur of up to some 15 px, edges in depth."""
    width, height = draw(st.integers(32, 50)), draw(st.integers(32, 45))
    rng = np.random.default_rng(draw(seeds))
    f = rng.uniform(0.8, 1.5, 2) * width
    camera = CameraIntrinsics(*f, width * rng.random(), height * rng.random(), width, height)
    p = rng.normal(0, 1, 9) * (*[0.05] * 3, 0.08, 0.08, 0.05, *[0.05] * 3) * rng.random()
    depth = steps_in_depth(rng, (height, width))
    return blur_operator(Motion.from_vector(p), depth, camera), rng


def shift(vx, vy=0.0, z=2.0):
    depth = np.full((48, 64), z, np.float32)
    return blur_operator(Motion(np.zeros(3), [vx, vy, 0]), depth, CAMERA)


def test_without_motion_the_latent_image_is_the_blurred_one():
    rng = np.random.default_rng(0)
    blur = blur_operator(Motion(np.zeros(3), np.zeros(3)), steps_in_depth(rng, (48, 64)), CAMERA)
    latent = rng.random(blur.latent_shape, np.float32)
    np.testing.assert_allclose(blur.apply(latent), blur.crop(latent), rtol=1e-6)


@given(drawn=blurs(), level=st.floats(0.1, 10))
@few
def test_a_plain_image_stays_plain(drawn, level):
    blur, _ = drawn
    blurred = blur.apply(np.full(blur.latent_shape, level, np.float32))
    np.testing.assert_allclose(blurred, level, rtol=5e-6)


@pytest.mark.parametrize(
    ('length', 'kernel'),
    [
        (9, np.ones(9)),
        (15, np.ones(15)),
        (12, np.r_[0.5, np.ones(11), 0.5]),  # instants between two pixels
    ],
)
@pytest.mark.parametrize('upright', [False, True])
@pytest.mark.parametrize('sign', [1, -1])
def test_a_sideways_shift_blurs_like_a_box_as_long_as_its_flow(length, kernel, upright, sign):
    v = sign * length / 32  # 64 px focal length, at 2 m
    blur = shift(0, v) if upright else shift(v)
    assert blur.inverse_depth.shape[2] == length
    latent = np.random.default_rng(0).random(blur.latent_shape, np.float32)
    along = latent.swapaxes(0, 1) if upright else latent
    m, reach = blur.margin, len(kernel) // 2
    along = along[m:-m, m - reach : along.shape[1] - m + reach]
    box = kernel / kernel.sum()
    expected = np.apply_along_axis(np.convolve, 1, along, box, 'valid')
    expected = expected.swapaxes(0, 1) if upright else expected
    np.testing.assert_allclose(blur.apply(latent), expected, atol=TOL)


def test_samples_follow_the_longest_blur_within_limits():
    for length, samples in ((0, MIN_SAMPLES), (20.5, 21), (500, MAX_SAMPLES)):
        assert shift(length / 32).inverse_depth.shape[2] == samples
    motion, depth = Motion(np.zeros(3), [30 / 32, 0, 0]), np.full((48, 64), 2, np.float32)
    assert blur_operator(motion, depth, CAMERA, 1.5).inverse_depth.shape[2] == 20


@pytest.mark.parametrize('sign', [1, -1])
def test_something_near_hides_what_is_far_as_it_passes(sign):
    """A board 16 px wide passes by 12 px before a wall so far away that it stands still."""
    depth = np.full((48, 64), 1e6, np.float32)
    depth[:, 24:40] = 1.0
    blur = blur_operator(Motion(np.zeros(3), [sign * 12 / 64, 0, 0]), depth, CAMERA)
    latent = blur.widen(np.repeat((depth == 1).astype(np.float32)[..., None], 3, 2))
    blurred = blur.apply(latent)[24, :, 0]
    assert (blurred[:16] == 0).all()
    assert (blurred[48:] == 0).all()
    beside = blurred[40:46]
    assert (np.diff(beside) < 0).all()
    # At k px from the edge the board is there for the share of time that it is farther out than k.
    np.testing.assert_allclose(beside, (5.5 - np.arange(6)) / 12, atol=1.01 / 12)
    np.testing.assert_allclose(blurred[18:24], beside[::-1], atol=1.01 / 12)


def test_a_far_thing_never_hides_a_near_one():
    """A window in a wall passes: its rims cover what is behind and uncover it again."""
    depth = np.full((48, 64), 1.0, np.float32)
    depth[10:30, 20:40] = 4.0
    seen = blur_operator(Motion(np.zeros(3), [10 / 64, 0, 0]), depth, CAMERA).inverse_depth
    first, last = seen[20, :, 0], seen[20, :, -1]
    assert (seen[40] == 1).all()
    assert set(np.unique(seen[20])) == {np.float32(0.25), np.float32(1)}
    np.testing.assert_array_equal(np.flatnonzero(first < 1)[[0, -1]], [20 - 4, 40 - 5 - 1])
    np.testing.assert_array_equal(np.flatnonzero(last < 1)[[0, -1]], [20 + 5, 40 + 4 - 1])


def test_what_is_out_of_reach_does_not_move():
    far = shift(1.0, z=1e30)
    assert far.inverse_depth.max() == np.float32(MIN_INVERSE_DEPTH)


def test_widening_and_cropping_cancel():
    blur = shift(9 / 32)
    image = np.random.default_rng(0).random((48, 64, 3), np.float32)
    wide = blur.widen(image)
    assert wide.shape == blur.latent_shape
    np.testing.assert_array_equal(blur.crop(wide), image)
    np.testing.assert_array_equal(wide[0], np.pad(image[0], [(blur.margin,) * 2, (0, 0)], 'edge'))


@given(drawn=blurs(), count=threads)
@few
@pytest.mark.parametrize(('kind', 'tolerance'), [(np.float32, 1e-5), (np.float64, 2e-7)])
def test_apply_and_adjoint_agree(drawn, count, kind, tolerance):
    """Positions are float32 in both; what is summed keeps the kind of the image."""
    blur, rng = drawn
    latent = rng.random(blur.latent_shape).astype(kind) - kind(0.5)
    image = rng.random((*blur.inverse_depth.shape[:2], 3)).astype(kind) - kind(0.5)
    with at_most(count):
        there, back = blur.apply(latent), blur.adjoint(image)
    assert (there.dtype, back.dtype) == (kind, kind)
    assert (there.shape, back.shape) == (image.shape, latent.shape)
    left, right = np.vdot(there.astype(float), image), np.vdot(latent, back.astype(float))
    scale = np.linalg.norm(there.astype(float)) * np.linalg.norm(image)
    assert abs(left - right) <= tolerance * scale


@given(drawn=blurs(), count=threads)
@few
def test_apply_and_adjoint_are_their_slow_twins(drawn, count):
    blur, rng = drawn
    matrix = oracle.blur_matrix(blur)
    latent = rng.random(blur.latent_shape, np.float32)
    image = rng.random((*blur.inverse_depth.shape[:2], 3), np.float32)
    with at_most(count):
        there, back = blur.apply(latent), blur.adjoint(image)
    np.testing.assert_allclose(there, oracle.through(matrix, latent, image.shape), atol=TOL)
    slow = oracle.through(matrix.T, image, latent.shape)
    # Clipped to the rim of the latent image, many a pixel reads one and the same.
    np.testing.assert_allclose(back, slow, atol=TOL * max(1, float(slow.max())))


def test_blocks_that_read_far_apart_are_their_slow_twins():
    """A near board in a corner moves by 20 px, the wall behind hardly; both lie in one block."""
    depth = np.full((48, 64), 20, np.float32)
    depth[10:30, 20:43] = 1
    blur = blur_operator(Motion(np.zeros(3), [20 / 64, 18 / 64, 0.05]), depth, CAMERA)
    offsets = blur.sweep.layout.cells[..., 2] * blur.sweep.layout.cells[..., 3]
    assert (offsets == 4).any()
    assert ((offsets > 4) & (offsets <= MANY)).any()
    assert (offsets > MANY).any()
    matrix, rng = oracle.blur_matrix(blur), np.random.default_rng(0)
    latent, image = rng.random(blur.latent_shape, np.float32), rng.random((48, 64, 3), np.float32)
    there, back = blur.apply(latent), blur.adjoint(image)
    np.testing.assert_allclose(there, oracle.through(matrix, latent, image.shape), atol=TOL)
    slow = oracle.through(matrix.T, image, latent.shape)
    np.testing.assert_allclose(back, slow, atol=TOL * max(1, float(slow.max())))


@pytest.mark.parametrize('v', [[16, 3, 0], [3, 6, 2], [6, 6, -1], [0, 0, 5]])
def test_pixels_that_would_read_beyond_the_latent_image_read_its_rim(v):
    rng = np.random.default_rng(0)
    blur = blur_operator(Motion([0.01, 0.02, 0.3], v), steps_in_depth(rng, (48, 64)), CAMERA)
    assert (blur.sweep.layout.cells == APART).any()
    matrix = oracle.blur_matrix(blur)
    latent, image = rng.random(blur.latent_shape, np.float32), rng.random((48, 64, 3), np.float32)
    slow = oracle.through(matrix, latent, image.shape)
    np.testing.assert_allclose(blur.apply(latent), slow, atol=TOL)
    slow = oracle.through(matrix.T, image, latent.shape)
    np.testing.assert_allclose(blur.adjoint(image), slow, atol=TOL * max(1, float(slow.max())))


@given(seed=seeds, spacing=st.floats(0.3, 4), slack=st.sampled_from([0, 0.2]), count=threads)
@few
def test_a_thinned_operator_is_its_slow_twin(seed, spacing, slack, count):
    """Near boards move by many px, the wall behind by few: blocks have 3 to N instants."""
    rng = np.random.default_rng(seed)
    depth, v = steps_in_depth(rng, (48, 64)), rng.normal(0, 0.15, 3)
    blur = blur_operator(Motion(rng.normal(0, 0.01, 3), v), depth, CAMERA)
    matrix = oracle.matrix_of(blur, *oracle.thinned_displacements(blur, spacing), slack)
    latent, image = rng.random(blur.latent_shape, np.float32), rng.random((48, 64, 3), np.float32)
    sweep = blur.thinned(spacing, slack)
    planes, taken = np.zeros(sweep.latent_shape, np.float32), sweep.blurred_planes(image)
    blur.latent_part(planes)[:] = np.moveaxis(latent, 2, 0)
    with at_most(count):
        there, back = sweep.gather(planes, np.ones_like(taken)), sweep.adjoint(taken)
    slow = oracle.through(matrix, latent, image.shape)
    np.testing.assert_allclose(np.moveaxis(there, 0, 2), slow, atol=TOL)
    slow = oracle.through(matrix.T, image, latent.shape)
    back = np.moveaxis(blur.latent_part(back), 0, 2)
    np.testing.assert_allclose(back, slow, atol=TOL * max(1, float(slow.max())))


def test_slack_spares_cells_and_reads_what_is_even_as_before():
    """A roll drifts by a tenth of a pixel along a block; what goes on evenly, slack goes on."""
    turn, depth = (
        Motion(np.array([0.02, 0.1, 0.05]), np.zeros(3)),
        np.full((48, 64), 2, np.float32),
    )
    blur = blur_operator(turn, depth, CAMERA, spacing=2.0)
    loose, exact = blur.thinned(0, 0.2), blur.thinned(0)
    wide = [np.mean(sweep.layout.cells[..., 2:].max(-1) > 2) for sweep in (exact, loose)]
    assert wide[1] < 0.1 * wide[0]
    y, x = np.indices(exact.latent_shape[1:], np.float32)
    slope = np.array([0.01 * x, 0.02 * y, 0.3 + 0.01 * x - 0.01 * y], np.float32)
    one = np.ones(exact.blurred_shape, np.float32)
    there, same = (sweep.gather(slope, one) for sweep in (loose, exact))
    np.testing.assert_allclose(there, same, atol=TOL)


@given(drawn=blurs())
@few
def test_blocks_keep_nearness_to_half_a_part_in_65535_of_the_nearest(drawn):
    blur, _ = drawn
    seen = blur.inverse_depth
    parts = (oracle.kept(blur) - seen) / (seen.max() / 65535)
    assert np.abs(parts).max() < 0.51  # float32 tells 1 / 256 of the largest of them


def test_an_operator_forgets_what_it_was_used_for():
    """Its room for results is used again and again."""
    rng, blur = np.random.default_rng(0), shift(9 / 32, 7 / 32)
    images = rng.random((2, 48, 64, 3), np.float32)
    apart = [shift(9 / 32, 7 / 32).adjoint(image) for image in images]
    np.testing.assert_array_equal([blur.adjoint(image) for image in images], apart)


def test_a_block_has_as_many_instants_as_its_own_blur_is_long():
    depth = np.full((48, 64), 20, np.float32)
    depth[:, 40:56] = 1.0
    blur = blur_operator(Motion(np.zeros(3), [20 / 64, 0, 0]), depth, CAMERA)  # 20 px and 1 px
    counts = np.rint(1 / blur.thinned(0.8).layout.shares)
    assert (counts[:, 0] == FEWEST).all()
    assert (counts[:, 2:] == 20).all()
    assert (np.rint(1 / blur.thinned(2.0).layout.shares)[:, 2] == 10).all()
    assert (np.rint(1 / blur.sweep.layout.shares) == 20).all()


@given(drawn=blurs())
@few
def test_every_pixel_reads_within_the_latent_image(drawn):
    """Else the strips of the adjoint write outside of themselves."""
    blur, _ = drawn
    assert np.abs(oracle.displacements(blur)).max() <= blur.margin - 1


@pytest.mark.parametrize('count', [1, 2])
def test_a_board_that_comes_close_stays_within_the_strips(count):
    """It is twice as near at one end of the exposure as at mid-exposure."""
    depth = np.full((48, 64), 3, np.float32)
    depth[20:40, 10:50] = 0.6
    blur = blur_operator(Motion(np.zeros(3), [0, 0.25, 0.6]), depth, CAMERA)
    assert np.abs(oracle.displacements(blur)).max() <= blur.margin - 1
    rng = np.random.default_rng(0)
    latent, image = rng.random(blur.latent_shape), rng.random((48, 64, 3))
    with at_most(count):
        left, right = np.vdot(blur.apply(latent), image), np.vdot(latent, blur.adjoint(image))
    assert left == pytest.approx(right, rel=1e-6)


@given(seed=seeds, samples=st.integers(1, 4))
@few
def test_what_is_seen_is_its_slow_twin(seed, samples):
    rng = np.random.default_rng(seed)
    height, width = rng.integers(3, 14, 2)
    nearness = 1 / steps_in_depth(rng, (14, 16))[:height, :width].astype(np.float64)
    motion = rng.normal(0, 0.2, 8)
    ray = np.concatenate([np.linspace(-0.6, 0.5, width), np.linspace(-0.4, 0.5, height)])
    rows = rng.normal(0, 3, (height, ROW))
    xn, (a, ax, axx, c, cx, b, bx, d) = ray[:width], rows.T[..., None]
    across = a + ax * xn + axx * xn**2 + nearness * (b + bx * xn)
    f = np.stack([across, c + cx * xn + nearness * d], -1)
    seen = np.empty((height, samples, width + 3))
    flow_numbers = np.concatenate([np.pad(xn, (0, 3), 'edge'), rows.ravel()])
    _see(0, samples, nearness, ray, motion, flow_numbers, seen)
    slow = oracle.seen(nearness, ray, motion, f, samples)
    np.testing.assert_allclose(np.moveaxis(seen[..., :width], 1, 2), slow, rtol=1e-6)
    assert (seen[..., width:] == seen[..., width - 1 : width]).all()


def test_what_an_operator_sees_is_its_slow_twin():
    rng = np.random.default_rng(3)
    depth, p = steps_in_depth(rng, (48, 64)), np.array([0.01, 0.02, 0.05, 0.1, 0.05, 0.1])
    seen = blur_operator(Motion.from_vector(p), depth, CAMERA).inverse_depth
    ray = np.concatenate([axis.ravel() for axis in normalised_grid(CAMERA)])
    slow = oracle.seen(1 / np.float64(depth), ray, p, flow(p, depth, CAMERA), seen.shape[2])
    # A surface's rim may fall on either side of a pixel by rounding.
    assert (np.abs(seen - slow) > 1e-5).mean() < 1e-3


@given(seed=seeds)
def test_filling_what_was_uncovered_is_its_slow_twin(seed):
    rng = np.random.default_rng(seed)
    view = (rng.random((6, 9)) * (rng.random((6, 9)) > rng.random())).astype(np.float32)
    nearness = rng.random((6, 9), np.float32) + 1
    filled = view.copy()
    _fill_uncovered(filled, nearness)
    np.testing.assert_array_equal(filled, oracle.fill_uncovered(view, nearness))


def test_an_uncovered_gap_shows_the_farther_side():
    view = np.array([[0, 2, 0, 0, 1, 0], [0, 0, 0, 0, 0, 0]], np.float32)
    nearness = np.full((2, 6), 7, np.float32)
    _fill_uncovered(view, nearness)
    np.testing.assert_array_equal(view, [[2, 2, 1, 1, 1, 1], [7] * 6])


def test_threads_share_one_row_or_none():
    """More strips than rows of work, and a last strip that is shorter than the others."""
    rng = np.random.default_rng(0)
    seen = np.ones((3, 40, 8), np.float32)
    ray = np.linspace(-0.5, 0.5, 43, dtype=np.float32)
    motion = np.array([0, 0.1, 0, 0, 0, 0, 30, 30, 0, 0, 0], np.float32)
    blur = BlurOperator(ray, motion, seen, 4)
    image = rng.random((3, 40, 3), np.float32)
    with at_most(1):
        alone = blur.adjoint(image)
    with at_most(2):
        np.testing.assert_allclose(blur.adjoint(image), alone, atol=1e-6)
