"""The rendered scene, the motion that blurs it, and the sample bag that was made of it."""

from pathlib import Path

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics
from depth_deblur_ros.core.geometry import blur_length, rotation_matrix, warp
import make_sample_bag as sample
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
import numpy as np
import pytest
from scene import make_scene, Pose, render_view, Scene
from scipy.spatial.transform import Rotation
from sensor import depth_picture, DISPARITY, DISPARITY_STEP, photograph
from shake import hand_held, motion_between, render_blurred, true_motion
from textures import linear_from_srgb, mip_levels, SIDE, srgb_from_linear

BAG = Path(__file__).resolve().parents[1] / 'bags/sample'
SMALL = CameraIntrinsics(131.0, 131.0, 79.5, 59.5, 160, 120)
AT_REST = Pose(np.eye(3), np.zeros(3))


@pytest.fixture(scope='module')
def scene():
    return make_scene(5)


@pytest.fixture(scope='module')
def messages():
    found = {}
    with next(BAG.glob('*.mcap')).open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, _, message in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append(message)
    return found


def one_surface(sphere=False):
    """Make a scene of a wall at 2 m, or of a ball of 0.5 m around the point at 2 m."""
    wall = [[-9, -9, 2, 1, 0, 0, 0, 1, 0, 0, 0, -1, 18, 18]]
    rects = np.array([] if sphere else wall, float).reshape(-1, 14)
    spheres = np.array([[0, 0, 2, 0.5]] if sphere else [], float).reshape(-1, 4)
    pool = np.full((1, (4 * SIDE**2 - 1) // 3, 3), 0.25, np.float32)
    look = np.array([[0, 1.0, 1, 1, 1, 0]])
    return Scene(rects, spheres, look, np.zeros((0, 4)), pool)


def depth_of(message):
    assert message.encoding == '16UC1'
    return np.frombuffer(message.data, np.uint16).reshape(message.height, message.width)


def test_a_wall_has_the_depth_of_its_plane():
    yaw = 0.3  # the plane z = 2 of the world, in a camera turned to the right
    pose = Pose(rotation_matrix([0, yaw, 0]), np.zeros(3))
    depth = render_view(one_surface(), SMALL, pose)[1]
    xn = (np.arange(160) - SMALL.cx) / SMALL.fx
    expected = 2 / (np.cos(yaw) - np.sin(yaw) * xn)
    np.testing.assert_allclose(depth, np.broadcast_to(expected, depth.shape), rtol=1e-12)


def test_a_ball_begins_at_its_radius_before_its_centre():
    camera = CameraIntrinsics(131.0, 131.0, 80.0, 60.0, 160, 120)
    depth = render_view(one_surface(sphere=True), camera, AT_REST)[1]
    assert depth[60, 80] == pytest.approx(1.5)
    assert np.isinf(depth[0, 0])


def test_a_plain_surface_is_plain_and_as_light_as_its_lamps_make_it():
    light = render_view(one_surface(), SMALL, AT_REST)[0]
    np.testing.assert_allclose(light, 0.25 * 0.42, rtol=1e-5)


def test_mip_levels_halve_down_to_the_mean():
    texture = np.random.default_rng(0).random((SIDE, SIDE, 3), np.float32)
    levels = mip_levels(texture)
    assert len(levels) == (4 * SIDE**2 - 1) // 3
    np.testing.assert_allclose(levels[-1], texture.mean(axis=(0, 1)), atol=1e-4)


def test_the_srgb_curve_and_its_inverse_agree():
    values = np.linspace(0, 1, 1001)
    np.testing.assert_allclose(srgb_from_linear(linear_from_srgb(values)), values, atol=1e-6)


def test_a_seed_gives_one_scene_and_another_seed_another(scene):
    same, other = make_scene(5), make_scene(6)
    view = scene.light(SMALL, AT_REST)
    np.testing.assert_array_equal(same.light(SMALL, AT_REST), view)
    assert np.abs(other.light(SMALL, AT_REST) - view).mean() > 0.02


def test_a_view_holds_nothing_finer_than_its_pixels(scene):
    """Halving a view equals rendering at half the size: aliased texture would not agree."""
    large = CameraIntrinsics(262.0, 262.0, 159.5, 119.5, 320, 240)
    halved = cv2.resize(scene.light(large, AT_REST), (160, 120), interpolation=cv2.INTER_AREA)
    direct = scene.light(SMALL, AT_REST)
    assert np.sqrt(np.mean((halved - direct) ** 2)) < 0.12 * direct.std()


@pytest.mark.parametrize('middle', [0.0, 0.13, 0.4])
def test_points_move_as_the_convention_says(middle):
    path, exposure = hand_held(3, turn=1.1, speed=0.4), 0.02
    first, last = (path.pose(middle + t * exposure) for t in (-0.5, 0.5))
    pose, p = path.pose(middle), true_motion(path, middle, exposure).vector
    depth = np.random.default_rng(0).uniform(0.8, 4, (SMALL.height, SMALL.width))
    y, x = np.indices(depth.shape)
    rays = np.stack(
        [(x - SMALL.cx) / SMALL.fx, (y - SMALL.cy) / SMALL.fy, np.ones_like(depth)], -1
    )
    world = (rays * depth[..., None]) @ pose.rotation.T + pose.centre
    seen = []
    for camera in (first, last):
        local = (world - camera.centre) @ camera.rotation
        seen.append(SMALL.fx * local[..., :2] / local[..., 2:] + (SMALL.cx, SMALL.cy))
    told = [warp(p, t, depth, SMALL) for t in (-0.5, 0.5)]
    path_length = np.linalg.norm(seen[1] - seen[0], axis=-1)
    assert path_length.mean() > 0.8
    off = np.linalg.norm((seen[1] - seen[0]) - (told[1] - told[0]), axis=-1)
    assert off.max() < 0.01 + 0.005 * path_length.max()
    # The acceleration moves both ends alike, by 1/8 a T^2, and leaves the blur's length as it is.
    assert np.linalg.norm(seen[1] - told[1], axis=-1).max() < 0.5


def test_the_rendered_views_move_as_the_convention_says(scene):
    path, exposure = hand_held(3, turn=1.1, speed=0.4), 0.02
    poses = [path.pose(0.1 + t * exposure) for t in (-0.5, 0.0, 0.5)]
    before, middle, after = (scene.light(SMALL, pose) for pose in poses)
    depth = scene.depth(SMALL, poses[1]).depth
    p = motion_between(*poses).vector
    inner = np.s_[12:-12, 12:-12]

    def error(target, vector, t):
        at = warp(vector, t, depth, SMALL).astype(np.float32)
        found = cv2.remap(target, at, None, cv2.INTER_LINEAR)
        return float(np.mean((found - middle)[inner] ** 2))

    for target, t in ((before, -0.5), (after, 0.5)):
        assert error(target, p, t) < 0.5 * error(target, 0 * p, t) < 0.5 * error(target, -p, t)


def test_a_still_camera_blurs_nothing(scene):
    still = hand_held(0, turn=0.0, speed=0.0)
    blurred = render_blurred(scene, SMALL, still, 0.1, 0.02)
    np.testing.assert_allclose(blurred, scene.light(SMALL, still.pose(0.1)), atol=1e-6)


def test_blur_keeps_the_light_and_softens_the_picture(scene):
    path = hand_held(4, turn=6.0, speed=0.4)
    blurred = render_blurred(scene, SMALL, path, 0.1, 0.02)
    sharp = scene.light(SMALL, path.pose(0.1))
    assert blurred.mean() == pytest.approx(sharp.mean(), rel=0.02)
    assert np.abs(np.diff(blurred, axis=1)).mean() < 0.8 * np.abs(np.diff(sharp, axis=1)).mean()


def test_the_picture_has_shot_noise():
    light = np.full((200, 200, 3), 0.2, np.float32)
    picture = photograph(light, np.random.default_rng(0))
    assert picture.dtype == np.uint8
    assert 0.4 < picture.std() < 2
    assert abs(picture.mean() - 255 * srgb_from_linear(np.array(0.2 * 1.7))) < 0.5


def test_depth_noise_grows_with_the_square_and_comes_in_steps_of_disparity():
    view = one_surface().depth(SMALL, AT_REST)
    light = np.full((120, 160, 3), 0.3, np.float32)
    spread = {}
    for scale in (1.0, 2.0):
        far = type(view)(view.depth * scale, view.incidence, view.shine, view.lit)
        taken = depth_picture(far, light, np.random.default_rng(0))
        values = taken[taken > 0]
        steps = DISPARITY / (values / 1000) / DISPARITY_STEP
        assert np.abs(steps - np.rint(steps)).max() < 0.1  # the rounding to millimetres
        spread[scale] = np.std(values / 1000)
    assert 3 < spread[2.0] / spread[1.0] < 5.5
    assert (taken[:, :8] == 0).all()


def test_the_bag_is_small_and_holds_ten_frames(messages):
    assert sum(file.stat().st_size for file in BAG.iterdir()) < 8_000_000
    assert {topic: len(found) for topic, found in messages.items()} == dict.fromkeys(
        [
            '/camera/depth/image',
            '/camera/rgb/camera_info',
            '/camera/rgb/exposure',
            '/camera/rgb/image_color',
            '/ground_truth/motion',
        ],
        10,
    )
    colour = messages['/camera/rgb/image_color']
    assert {(m.width, m.height, m.encoding) for m in colour} == {(640, 480, 'rgb8')}
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in colour]
    assert stamps == [sample.stamp_of(k) for k in range(10)]


def test_a_tenth_to_a_quarter_of_the_depth_is_missing(messages):
    for message in messages['/camera/depth/image']:
        depth = depth_of(message)
        assert 0.1 < (depth == 0).mean() < 0.25
        assert 800 < depth[depth > 0].min() < depth.max() < 4600


def test_the_true_twist_is_the_cameras_own_velocity(messages):
    for k, message in enumerate(messages['/ground_truth/motion']):
        ends = [sample.middle_of(k) + t * sample.EXPOSURE for t in (-0.5, 0.5)]
        first, last = (sample.PATH.pose(t) for t in ends)
        turn = Rotation.from_matrix(first.rotation.T @ last.rotation).as_rotvec()
        angular = [getattr(message.twist.angular, axis) for axis in 'xyz']
        np.testing.assert_allclose(angular, turn / sample.EXPOSURE, atol=1e-9)
        middle = sample.PATH.pose(sample.middle_of(k)).rotation
        velocity = middle.T @ (last.centre - first.centre) / sample.EXPOSURE
        linear = [getattr(message.twist.linear, axis) for axis in 'xyz']
        # They differ by how much the camera turns and speeds up within half the exposure.
        np.testing.assert_allclose(linear, velocity, atol=2e-3)


def test_the_frames_are_blurred_and_not_all_alike(messages):
    lengths = []
    for k, message in enumerate(messages['/camera/depth/image']):
        depth = np.where(depth_of(message) == 0, 3000, depth_of(message)) / 1000
        motion = true_motion(sample.PATH, sample.middle_of(k), sample.EXPOSURE)
        lengths.append(blur_length(motion.vector, depth, sample.CAMERA))
    assert 3 < min(lengths) < 6
    assert 16 < max(lengths) < 24


def test_the_exposure_comes_before_its_frame(messages):
    assert [m.data for m in messages['/camera/rgb/exposure']] == pytest.approx([0.02] * 10)


@pytest.mark.slow
def test_the_script_makes_the_frame_that_is_in_the_bag(messages):
    frame = next(sample.render_frames())
    stored = messages['/camera/rgb/image_color'][0]
    colour = np.frombuffer(stored.data, np.uint8).reshape(480, 640, 3)
    assert np.abs(frame.colour.astype(int) - colour).mean() < 0.1
    assert (frame.depth != depth_of(messages['/camera/depth/image'][0])).mean() < 0.01
