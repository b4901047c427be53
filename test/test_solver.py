"""The solver as a whole: rendered scenes with known motion, and what it must leave alone."""

from dataclasses import fields, replace
import math

import cv2
from depth_deblur_ros import bench
from depth_deblur_ros.core import solver
from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    InputError,
    Motion,
    Outcome,
    RgbdFrame,
)
from depth_deblur_ros.core.geometry import blur_length, flow, rotation_matrix
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.core.solver import deblur, restore_known
from depth_deblur_ros.core.threads import threads_here
import numpy as np
from pictures import swept, texture
import pytest
from scene import make_scene, Pose
from textures import srgb_from_linear

CAMERA = CameraIntrinsics(262.0, 262.0, 159.5, 119.5, 320, 240)
SMALL = CameraIntrinsics(180.0, 180.0, 111.5, 79.5, 224, 160)
GAIN, NOISE, VIEWS = 1.7, 0.004, 33
MOTIONS = {  # rad and m over the exposure; 8 to 12 px
    'nod and turn': (0.03, 0.03, 0, 0, 0, 0),
    'roll and turn': (0, 0.02, 0.06, 0, 0, 0),
    'shift': (0, 0, 0, 0.1, 0, 0),
}
each_motion = pytest.mark.parametrize('name', MOTIONS)


def photo(light):
    """Give what an 8-bit sRGB camera with a little noise makes of light."""
    noise = NOISE * np.random.default_rng(0).standard_normal(light.shape)
    picture = np.rint(255 * (srgb_from_linear(np.clip(GAIN * light, 0, 1)) + noise))
    return (np.clip(picture, 0, 255) / 255).astype(np.float32)


def pose_at(motion, t):
    """Place the camera so that what it saw at X in mid-exposure is at R(t theta) X + t v."""
    r = rotation_matrix(t * motion.theta)
    return Pose(r.T, -r.T @ (t * motion.v))


class Room:
    """A rendered room: exact views, taken blurred by any motion, each once."""

    def __init__(self):
        self.scene, self.taken = make_scene(5), {}
        middle = Pose(np.eye(3), np.zeros(3))
        depth = self.scene.depth(CAMERA, middle).depth
        self.depth = depth.astype(np.float32)
        self.depth[100:110, 150:170] = np.nan
        self.exact = depth
        self.sharp = photo(self.scene.light(CAMERA, middle))

    def frame(self, name):
        """Give the frame that a motion blurs: the mean of exact views in linear light."""
        if name not in self.taken:
            motion, light = Motion.from_vector(MOTIONS[name]), 0.0
            for t in (np.arange(VIEWS) + 0.5) / VIEWS - 0.5:
                light = light + self.scene.light(CAMERA, pose_at(motion, t)) / VIEWS
            self.taken[name] = RgbdFrame(photo(light), self.depth, CAMERA)
        return self.taken[name]


@pytest.fixture(scope='module')
def room():
    return Room()


@pytest.fixture(scope='module')
def solved(room):
    """Give the blind result of a motion's frame, each solved once."""
    found = {}

    def solve(name):
        if name not in found:
            found[name] = deblur(room.frame(name))
        return found[name]

    return solve


@pytest.fixture(scope='module')
def small_frame():
    """A straight blur of a grey texture on a flat wall, with holes in the depth."""
    depth = np.full((160, 224), 2, np.float32)
    depth[40:60, 50:90] = np.nan
    return RgbdFrame(swept(texture(1, (160, 224)), 10, 0.4, 0.004), depth, SMALL)


@pytest.fixture(scope='module')
def small_result(small_frame):
    return deblur(small_frame)


def test_a_refinement_that_the_bands_do_not_confirm_is_not_taken(small_frame, monkeypatch):
    def astray(light, depth, camera, start, effort):
        return Motion.from_vector(1.6 * start.motion.vector, 1e-12 * np.eye(6))

    params = SolverParams(mode='motion')
    unrefined = deblur(small_frame, params, start=deblur(small_frame, params).motion)
    monkeypatch.setattr(solver, 'refine', astray)
    kept = deblur(small_frame, params)
    assert kept.outcome is Outcome.SOLVED
    assert kept.blur_px == pytest.approx(10, abs=0.7)
    least = np.diag(unrefined.motion.covariance) / 2
    assert (np.diag(kept.motion.covariance) > least).all()


def psnr(image, truth):
    return -10 * math.log10(float(np.mean((image - truth) ** 2)))


def same(a, b, but=('seconds',)):
    """Tell whether two results agree bit for bit."""
    for field in fields(a):
        one, other = getattr(a, field.name), getattr(b, field.name)
        if isinstance(one, Motion):
            np.testing.assert_array_equal(one.vector, other.vector)
            np.testing.assert_array_equal(one.covariance, other.covariance)
        elif field.name not in but:
            np.testing.assert_array_equal(one, other)


def test_to_deblur_is_to_find_the_motion_and_then_to_restore(small_frame, small_result):
    found = deblur(small_frame, restore=False)
    assert found.image is small_frame.image
    same(found, small_result, but=('seconds', 'image'))
    known = restore_known(replace(small_frame, depth=found.depth), found.motion)
    np.testing.assert_array_equal(known.image, small_result.image)


@each_motion
def test_a_known_motion_is_found_in_a_rendered_room(room, solved, name):
    result = solved(name)
    assert result.outcome is Outcome.SOLVED
    true, found = (flow(p, room.exact, CAMERA) for p in (MOTIONS[name], result.motion.vector))
    assert 8 < np.linalg.norm(true, axis=-1).mean() < 15
    misses = [np.linalg.norm(found - s * true, axis=-1).mean() for s in (1, -1)]
    assert min(misses) < 1
    assert result.blur_px == pytest.approx(np.linalg.norm(found, axis=-1).mean(), rel=0.05)
    assert not result.sign_resolved
    assert 0.5 < result.quality <= 1


@each_motion
def test_the_image_gets_closer_to_the_truth_with_the_motion_found_and_more_so_known(
    room, solved, name
):
    frame = room.frame(name)
    known = restore_known(frame, Motion.from_vector(MOTIONS[name]))
    before, found, best = (
        psnr(image, room.sharp) for image in (frame.image, solved(name).image, known.image)
    )
    assert found > before + 3
    assert best > before + 4
    assert found > best - 3
    assert known.outcome is Outcome.SOLVED


def test_a_motion_and_its_opposite_restore_alike(small_frame):
    p = np.array([0.005, 0.03, 0.02, 0.02, 0.01, 0.02])
    there, back = (restore_known(small_frame, Motion.from_vector(s * p)) for s in (1, -1))
    assert psnr(back.image, there.image) > 40


def test_no_result_has_holes(room, solved):
    assert np.isnan(room.depth).any()
    depth = solved('shift').depth
    assert (np.isfinite(depth) & (depth > 0)).all()
    measured = np.isfinite(room.depth)
    np.testing.assert_array_equal(depth[measured], room.depth[measured])


def test_the_covariance_of_a_found_motion_is_one(solved):
    for name in MOTIONS:
        covariance = solved(name).motion.covariance
        np.testing.assert_allclose(covariance, covariance.T, rtol=1e-9)
        scale = np.sqrt(np.diag(covariance))
        assert (scale > 0).all()
        assert np.linalg.eigvalsh(covariance / np.outer(scale, scale)).min() > 0


def test_a_sharp_frame_passes_unchanged(room):
    result = deblur(RgbdFrame(room.sharp, room.depth, CAMERA))
    assert result.outcome is Outcome.SHARP
    np.testing.assert_array_equal(result.image, room.sharp)
    assert not result.motion.vector.any()
    assert (result.blur_px, result.sign_resolved) == (0, False)


@pytest.mark.parametrize('colours', [(), (3,)])
@pytest.mark.parametrize('contrast', [0.01, 0.1, 1.0])
def test_noise_is_never_taken_for_motion(contrast, colours):
    rng = np.random.default_rng(0)
    noise = np.float32(0.5) + np.float32(contrast) * (rng.random((160, 224, *colours)) - 0.5)
    noise = noise.astype(np.float32)
    result = deblur(RgbdFrame(noise, np.full((160, 224), 2, np.float32), SMALL))
    assert result.outcome is not Outcome.SOLVED
    assert not result.motion.vector.any()
    np.testing.assert_array_equal(result.image, noise)


@pytest.mark.parametrize('colours', [(), (3,)])
@pytest.mark.parametrize('level', [0.0, 0.5, 1.0])
def test_a_plain_picture_passes_unchanged(level, colours):
    plain = np.full((160, 224, *colours), level, np.float32)
    result = deblur(RgbdFrame(plain, np.full((160, 224), 2, np.float32), SMALL))
    assert result.outcome is not Outcome.SOLVED
    assert not result.motion.vector.any()
    np.testing.assert_array_equal(result.image, plain)


def test_the_same_frame_gives_the_same_result(small_frame, small_result):
    assert small_result.outcome is Outcome.SOLVED
    before = small_frame.image.copy()
    same(deblur(small_frame), small_result)
    np.testing.assert_array_equal(small_frame.image, before)


def test_threads_change_nothing_but_rounding(small_frame, small_result):
    before = threads_here()
    alone = deblur(small_frame, SolverParams(threads=1))
    assert threads_here() == before
    np.testing.assert_allclose(alone.motion.vector, small_result.motion.vector, atol=1e-6)
    np.testing.assert_allclose(alone.image, small_result.image, atol=2e-3)


def test_more_threads_than_there_are_do_no_harm(small_frame, small_result):
    many = deblur(small_frame, SolverParams(threads=64))
    np.testing.assert_allclose(many.motion.vector, small_result.motion.vector, atol=1e-6)


def test_a_grey_frame_is_solved_as_its_colour_twin(small_frame, small_result):
    colour = replace(small_frame, image=np.repeat(small_frame.image[..., None], 3, 2))
    result = deblur(colour)
    assert small_result.image.shape == (160, 224)
    assert result.image.shape == (160, 224, 3)
    np.testing.assert_array_equal(result.motion.vector, small_result.motion.vector)
    np.testing.assert_allclose(result.image[..., 1], small_result.image, atol=2e-3)


def test_the_motion_alone_leaves_the_image(small_frame):
    result = deblur(small_frame, SolverParams(mode='motion'))
    np.testing.assert_array_equal(result.image, small_frame.image)


def test_where_neighbours_tell_what_to_expect_fast_finds_what_motion_finds(small_frame):
    before = deblur(small_frame, SolverParams(mode='motion')).motion
    alone = deblur(small_frame, SolverParams(mode='fast'))
    motion, fast = (
        deblur(small_frame, SolverParams(mode=mode), start=before) for mode in ('motion', 'fast')
    )
    same(motion, fast, but=('seconds', 'image'))
    for cold in (alone.motion, before):  # these are refined
        assert not np.array_equal(cold.vector, fast.motion.vector)


@pytest.mark.parametrize(('noise', 'alike'), [(0.0, True), (0.01, False)])
def test_a_clean_picture_is_asked_in_full_in_every_mode(noise, alike):
    """Where nothing hides what it knows, the first frame's motion is that of mode full."""
    image = swept(texture(1, (160, 224)), 10, 0.4, noise)
    depth, camera = np.full(image.shape, 2, np.float32), replace(SMALL, transfer='linear')
    frame = RgbdFrame(image, depth, camera)
    full, *others = (deblur(frame, SolverParams(mode=mode)) for mode in ('full', 'fast', 'motion'))
    assert full.outcome is Outcome.SOLVED
    for other in others:
        assert np.array_equal(full.motion.vector, other.motion.vector) == alike


def test_fast_improves_the_image(small_frame):
    result = deblur(small_frame, SolverParams(mode='fast'))
    truth = texture(1, (160, 224))
    assert psnr(result.image, truth) > psnr(small_frame.image, truth) + 1


@pytest.mark.parametrize('factor', [1.0, -1.0, 5.0])
def test_a_start_does_no_harm(small_frame, small_result, factor):
    begin = Motion.from_vector(factor * small_result.motion.vector)
    result = deblur(small_frame, start=begin)
    assert result.outcome is Outcome.SOLVED
    p, q = (r.motion.vector for r in (result, small_result))
    wall = np.full((160, 224), 2, np.float32)
    assert min(blur_length(p - s * q, wall, SMALL) for s in (1, -1)) < 0.3


@pytest.mark.parametrize('value', [np.nan, 0, -1, np.inf])
def test_without_any_depth_there_is_nothing_to_solve(small_frame, value):
    none = replace(small_frame, depth=np.full((160, 224), value, np.float32))
    for solve in (deblur, lambda frame: restore_known(frame, Motion(np.zeros(3), np.zeros(3)))):
        with pytest.raises(InputError, match='100 % of it are holes'):
            solve(none)


def test_no_motion_known_leaves_the_image_nearly_alone(room):
    still = Motion(np.zeros(3), np.zeros(3))
    result = restore_known(RgbdFrame(room.sharp, room.depth, CAMERA), still)
    assert result.blur_px == 0
    assert psnr(result.image, room.sharp) > 30


PAPER = ('paper-mb2006_Aloe', 'paper-mb2006_Cloth3', 'paper-mb2006_Midd1')
TAKEN = ('camera-mb2005_Art', 'camera-mb2005_Moebius', 'camera-mb2006_Aloe')
ROAD = ('paperkitti-kitti_000046',)
STILL = (
    'still-mb2005_Dolls',
    'still-mb2006_Cloth4',
    'still-mb2014Q_Jadeplant',
    'still-mb2014Q_Shelves',
)


def scored(data, names, tmp_path, *, oracle):
    cases = [data / 'eval' / name for name in names]
    rows = list(bench.solve_cases(cases, tmp_path, SolverParams(), oracle=oracle))
    assert all(row.error is None for row in rows)
    return rows


@pytest.mark.slow
@pytest.mark.parametrize(
    ('names', 'known', 'blind'), [(PAPER, 30, 29), (TAKEN, 28, 27.5), (ROAD, 29, 28)]
)
def test_cases_with_known_truth_reach_their_bars(data, tmp_path, names, known, blind):
    for oracle, bar in ((True, known), (False, blind)):
        rows = scored(data, names, tmp_path, oracle=oracle)
        assert np.mean([row.score.psnr for row in rows]) > bar
        assert all(row.score.psnr > row.score.psnr_in - 0.05 for row in rows)


@pytest.mark.slow
def test_still_cases_pass_unchanged(data, tmp_path):
    for row in scored(data, STILL, tmp_path, oracle=False):
        assert row.outcome == Outcome.SHARP.value
        taken = cv2.imread(str(data / 'eval' / row.case / 'rgb.png'))
        np.testing.assert_array_equal(
            cv2.imread(str(tmp_path / row.case / 'deblurred.png')), taken
        )


def test_a_burnt_channel_has_no_share_of_grey():
    rng = np.random.default_rng(0)
    image = rng.uniform(0, 0.9, (48, 64, 3)).astype(np.float32)
    np.testing.assert_array_equal(solver._channels(image), [[1, 1, 1]])
    image[:24, :, 0] = 1
    np.testing.assert_array_equal(solver._channels(image), [[0, 1, 1]])
    image[:24] = 1  # all alike
    np.testing.assert_array_equal(solver._channels(image), [[1, 1, 1]])
