"""From bag to bag with a solver that is known: what is read, what is written, what is refused."""

from dataclasses import replace
import json

import cv2
from depth_deblur_ros.bag import BagReader, BagWriter
from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    DeblurResult,
    InputError,
    Motion,
    Outcome,
)
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.messages import (
    camera_info_fields,
    depth_fields,
    header_fields,
    image_fields,
)
from depth_deblur_ros.replay import replay
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
import numpy as np
import pytest

COLOUR = '/camera/rgb/image_color'
DEPTH = '/camera/depth/image'
INFO = '/camera/rgb/camera_info'
IMAGE = 'sensor_msgs/msg/Image'
PICTURE = 'sensor_msgs/msg/CompressedImage'
CAMERA = CameraIntrinsics(60, 60, 31.5, 23.5, 64, 48)
START = 1_305_031_231_096_775_000
STEP = 33_000_000
FRAMES = 5
RNG = np.random.default_rng(0)
IMAGES = [RNG.integers(0, 256, (48, 64, 3), np.uint8) / np.float32(255) for _ in range(FRAMES)]


def header(i, late=0):
    return header_fields(START + i * STEP + late, 'camera_optical')


def write_colour(bag, i, topic=COLOUR, image=None):
    fields = image_fields(IMAGES[i] if image is None else image, header(i))
    bag.write(topic, IMAGE, fields, START + i * STEP + 1_000)


def write_depth(bag, i, topic=DEPTH, shape=(48, 64), late=4_000_000):
    depth = np.full(shape, 1 + i, np.float32)
    bag.write(topic, IMAGE, depth_fields(depth, header(i, late)), START + i * STEP + late + 1_000)


def write_info(bag, i=0, topic=INFO, camera=CAMERA):
    fields = camera_info_fields(camera, header(i))
    bag.write(topic, 'sensor_msgs/msg/CameraInfo', fields, START + i * STEP)


def write_bag(path, frames=range(FRAMES)):
    with BagWriter(path) as bag:
        for i in frames:
            write_info(bag, i)
            write_colour(bag, i)
            write_depth(bag, i)
    return path


def solve(frame, params):
    """Pretend: the image turned upside down, a motion that tells the depth."""
    z = float(np.nanmean(frame.depth))
    return DeblurResult(
        image=frame.image[::-1].copy(),
        depth=frame.depth,
        motion=Motion(np.array([0.01, 0, 0]), np.array([0, 0, z]), np.eye(6)),
        outcome=Outcome.SOLVED,
        sign_resolved=True,
        quality=1.0,
        blur_px=3.0,
        seconds=0.1,
    )


def run(bag, out, **options):
    return replay(bag, out, params=SolverParams(), **{'solve': solve, **options})


def read_back(path):
    """Read a bag with a reader that is not ours: topic -> [(log time, message)]."""
    found = {}
    with next(path.glob('*.mcap')).open('rb') as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for _, channel, message, content in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((message.log_time, content))
    return found


def stamp(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def pixels(message):
    return np.frombuffer(message.data, np.uint8).reshape(message.height, message.width, -1)


@pytest.fixture
def bag(tmp_path):
    return write_bag(tmp_path / 'in')


def test_every_pair_comes_out_with_its_stamp_and_frame(bag, tmp_path):
    summary = run(bag, tmp_path / 'out', exposure_s=0.02)
    assert (summary.pairs, summary.complete) == (FRAMES, True)
    found = read_back(tmp_path / 'out')
    names = ['image', 'camera_info', 'depth']
    assert set(found) == {f'/deblurred/{name}' for name in names} | {
        '/motion',
        '/motion_with_covariance',
        '/displacement',
        '/result',
    }
    for topic, messages in found.items():
        assert [time for time, _ in messages] == [START + i * STEP + 1_000 for i in range(FRAMES)]
        if topic != '/result':
            assert [stamp(m) for _, m in messages] == [START + i * STEP for i in range(FRAMES)]
            assert {m.header.frame_id for _, m in messages} == {'camera_optical'}


def test_images_depth_camera_and_twist_are_those_of_the_solver(bag, tmp_path):
    run(bag, tmp_path / 'out', exposure_s=0.02)
    found = read_back(tmp_path / 'out')
    for i in range(FRAMES):
        image = found['/deblurred/image'][i][1]
        np.testing.assert_array_equal(pixels(image) / np.float32(255), IMAGES[i][::-1])
        depth = found['/deblurred/depth'][i][1]
        assert depth.encoding == '32FC1'
        assert set(np.frombuffer(depth.data, '<f4')) == {1 + i}
        info = found['/deblurred/camera_info'][i][1]
        assert (info.width, info.height, info.p[0], info.k[2]) == (64, 48, 60, 31.5)
        twist = found['/motion'][i][1].twist
        assert twist.angular.x == pytest.approx(-0.5)
        assert twist.linear.z == pytest.approx(-(1 + i) / 0.02)
        covariance = found['/motion_with_covariance'][i][1].twist.covariance
        assert covariance[0] == pytest.approx(1 / 0.02**2)


def test_without_an_exposure_there_is_no_twist(bag, tmp_path):
    run(bag, tmp_path / 'out')
    found = read_back(tmp_path / 'out')
    assert '/motion' not in found
    assert '/motion_with_covariance' not in found
    assert found['/displacement'][1][1].twist.linear.z == -2


def test_the_exposure_topic_counts_more_than_the_option(bag, tmp_path):
    with BagReader(bag) as source, BagWriter(tmp_path / 'in2') as target:
        for message in source.messages(source.topics):
            target.copy(message)
        target.write('/exposure', 'std_msgs/msg/Float32', {'data': 0.25}, START + STEP)
    run(tmp_path / 'in2', tmp_path / 'out', exposure_s=0.5, estimates=tmp_path / 'e.jsonl')
    lines = [json.loads(line) for line in (tmp_path / 'e.jsonl').read_text().splitlines()]
    assert [line['exposure'] for line in lines] == [0.5] + [0.25] * (FRAMES - 1)


def failing(frame, params):
    if frame.stamp_ns == START + STEP:
        raise InputError('this frame is bad')
    return solve(frame, params)


def test_a_frame_that_the_solver_refuses_does_not_end_the_run(bag, tmp_path):
    seen = []
    summary = run(
        bag,
        tmp_path / 'out',
        solve=failing,
        estimates=tmp_path / 'e.jsonl',
        on_frame=lambda number, frame, result: seen.append((number, frame.stamp_ns)),
    )
    assert not summary.complete
    assert summary.outcomes == {Outcome.SOLVED: FRAMES - 1, Outcome.FAILED: 1}
    assert summary.refused == {'this frame is bad': 1}
    found = read_back(tmp_path / 'out')
    image = pixels(found['/deblurred/image'][1][1])
    np.testing.assert_array_equal(image / np.float32(255), IMAGES[1])
    assert [m.level for _, m in found['/result']] == [0, 2, 0, 0, 0]
    assert 'this frame is bad' in found['/result'][1][1].message
    lines = [json.loads(line) for line in (tmp_path / 'e.jsonl').read_text().splitlines()]
    assert [line['outcome'] for line in lines].count('failed') == 1
    assert [line['stamp'] for line in lines] == [(START + i * STEP) / 10**9 for i in range(FRAMES)]
    assert seen == list(enumerate(START + i * STEP for i in range(FRAMES) if i != 1))


def test_frames_that_cannot_be_read_are_failed_with_their_reason(tmp_path):
    with BagWriter(tmp_path / 'in') as bag:
        write_info(bag)
        for i in range(FRAMES):
            write_colour(bag, i, image=np.zeros((40, 64), np.float32) if i == 1 else None)
            write_depth(bag, i, shape=(24, 32) if i == 2 else (48, 64))
    summary = run(tmp_path / 'in', tmp_path / 'out')
    assert summary.outcomes[Outcome.FAILED] == 2
    assert sorted(summary.refused) == [
        'depth is 32x24 but the image is 64x48: register the depth to the colour camera first',
        'image is 64x40 but its camera is 64x48',
    ]
    found = read_back(tmp_path / 'out')
    assert len(found['/deblurred/image']) == FRAMES
    assert len(found['/displacement']) == len(found['/result']) == FRAMES


def test_colour_frames_without_depth_are_counted(tmp_path):
    with BagWriter(tmp_path / 'in') as bag:
        write_info(bag)
        for i in range(FRAMES):
            write_colour(bag, i)
            if i != 3:
                write_depth(bag, i)
    summary = run(tmp_path / 'in', tmp_path / 'out')
    assert (summary.pairs, summary.complete) == (FRAMES - 1, False)
    assert summary.dropped == {'no depth within the slop': 1}
    assert 'dropped 1: no depth within the slop' in str(summary)


def test_a_message_that_is_no_frame_and_cannot_be_read_is_no_lost_frame(tmp_path):
    with BagWriter(tmp_path / 'in') as bag:
        write_info(bag)
        broken = {'header': {'stamp': {'sec': 1, 'nanosec': 1_000_000_000}, 'frame_id': 'imu'}}
        bag.write('/imu', 'sensor_msgs/msg/Imu', broken, START)
        for i in range(FRAMES):
            write_colour(bag, i)
            write_depth(bag, i)
    summary = run(tmp_path / 'in', tmp_path / 'out')
    assert (summary.pairs, summary.complete) == (FRAMES, False)
    assert not summary.dropped and summary.unread == {'/imu': 1}
    assert 'unreadable 1: /imu' in str(summary)


def test_a_camera_info_that_comes_late_serves_from_the_start(tmp_path):
    with BagWriter(tmp_path / 'in') as bag:
        for i in range(FRAMES):
            write_colour(bag, i)
            write_depth(bag, i)
        write_info(bag, FRAMES)
    assert run(tmp_path / 'in', tmp_path / 'out').complete


@pytest.mark.parametrize('rectified', [True, False])
def test_the_lens_is_undone_unless_images_are_rectified(tmp_path, rectified):
    with BagWriter(tmp_path / 'in') as bag:
        write_info(bag, camera=replace(CAMERA, distortion=(0.4, 0, 0, 0, 0)))
        write_colour(bag, 0)
        write_depth(bag, 0)
    params = SolverParams(rectified=rectified)
    replay(tmp_path / 'in', tmp_path / 'out', params=params, solve=solve)
    found = read_back(tmp_path / 'out')
    assert not any(found['/deblurred/camera_info'][0][1].d)
    corner = np.frombuffer(bytes(found['/deblurred/depth'][0][1].data), np.float32)[0]
    assert np.isnan(corner) != rectified


def test_a_camera_that_is_given_counts_and_needs_no_topic(tmp_path):
    with BagWriter(tmp_path / 'in') as bag:
        write_colour(bag, 0)
        write_depth(bag, 0)
    camera = CameraIntrinsics(70, 70, 31.5, 23.5, 64, 48, transfer='linear')
    run(tmp_path / 'in', tmp_path / 'out', camera=camera)
    assert read_back(tmp_path / 'out')['/deblurred/camera_info'][0][1].k[0] == 70


def test_compressed_topics_of_other_names_are_found(tmp_path):
    with BagWriter(tmp_path / 'in') as bag:
        write_info(bag, topic='/cam/camera_info')
        write_info(bag, topic='/cam/depth/camera_info')
        for i in range(FRAMES):
            png = cv2.imencode('.png', np.uint8(IMAGES[i][..., ::-1] * 255 + 0.5))[1].tobytes()
            fields = {'format': 'rgb8; png compressed bgr8', 'header': header(i), 'data': png}
            bag.write('/cam/image/compressed', PICTURE, fields, START + i * STEP)
            png = bytes(12) + cv2.imencode('.png', np.full((48, 64), 1500, np.uint16))[1].tobytes()
            fields = {'format': '16UC1; compressedDepth png', 'header': header(i), 'data': png}
            bag.write('/cam/depth/image/compressedDepth', PICTURE, fields, START + i * STEP)
    run(tmp_path / 'in', tmp_path / 'out')
    found = read_back(tmp_path / 'out')
    image = pixels(found['/deblurred/image'][0][1])
    np.testing.assert_array_equal(image / np.float32(255), IMAGES[0][::-1])
    assert set(np.frombuffer(found['/deblurred/depth'][0][1].data, '<f4')) == {np.float32(1.5)}


def test_topics_can_be_named(bag, tmp_path):
    with BagReader(bag) as source, BagWriter(tmp_path / 'in2') as target:
        for message in source.messages(source.topics):
            target.copy(message)
        write_colour(target, 0, topic='/other')
        write_info(target, 0, topic='/other_info')
    topics = {'colour': '/other', 'info': '/other_info'}
    assert run(tmp_path / 'in2', tmp_path / 'out', topics=topics).pairs == 1
    with pytest.raises(InputError, match="unknown topic role 'color'; known are colour, depth"):
        run(tmp_path / 'in2', tmp_path / 'out2', topics={'color': '/other'})


def test_all_topics_are_copied_but_for_names_of_results(bag, tmp_path):
    with BagReader(bag) as source, BagWriter(tmp_path / 'in2') as target:
        for message in source.messages(source.topics):
            target.copy(message)
        for topic in ('/note', '/result'):
            target.write(topic, 'std_msgs/msg/String', {'data': 'hello'}, START)
    run(tmp_path / 'in2', tmp_path / 'out', all_topics=True)
    found = read_back(tmp_path / 'out')
    assert found['/note'][0][1].data == 'hello'
    assert len(found[COLOUR]) == len(found['/deblurred/image']) == FRAMES
    assert len(found['/result']) == FRAMES


def test_a_span_of_the_bag_is_replayed(bag, tmp_path):
    told = []
    summary = run(
        bag,
        tmp_path / 'out',
        start=0.03,
        duration=0.066,
        progress=lambda done, total: told.append((done, total)),
    )
    assert summary.pairs == 2
    assert [stamp(m) for _, m in read_back(tmp_path / 'out')['/displacement']] == [
        START + STEP,
        START + 2 * STEP,
    ]
    assert [done for done, _ in told] == [1, 2]


def test_a_bag_without_its_end_is_replayed_as_far_as_it_goes(bag, tmp_path):
    file = bag / 'in.mcap'
    content = file.read_bytes()
    file.write_bytes(content[:-20])
    summary = run(bag, tmp_path / 'out')
    assert (summary.pairs, summary.complete) == (FRAMES, False)
    assert 'damaged: in.mcap: ends at byte' in str(summary)
    assert f'damaged: 0 of {3 * FRAMES} messages lost' in str(summary)


def test_an_interrupted_run_leaves_nothing(bag, tmp_path):
    def stop(frame, params):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(bag, tmp_path / 'out', solve=stop, estimates=tmp_path / 'e.jsonl')
    assert [p.name for p in tmp_path.iterdir()] == ['in']


def refuse_all(frame, params):
    raise InputError('all depth is missing')


@pytest.mark.parametrize(
    ('options', 'reason'),
    [
        ({'exposure_s': 0.0}, r'exposure must lie in \(0, 60\] s, got 0.0'),
        ({'start': 9.0}, r'start must lie in \[0, 0\.\d+\] s.*got 9.0'),
        ({'start': -1.0}, 'start must lie in'),
        ({'duration': 0.0}, 'duration must lie in'),
        ({'topics': {'depth': '/no'}}, r'/no is not there.*image_color \(sensor_msgs/msg/Image\)'),
        ({'topics': {'depth': INFO}}, 'camera_info is not there as sensor_msgs/msg/Image'),
        ({'sync_slop_s': 0.001}, 'within 0.001 s: the nearest is 0.004 s away'),
        ({'solve': refuse_all}, 'none of the 5 pairs can be solved: all depth is missing'),
    ],
)
def test_bad_input_is_refused_and_leaves_nothing(bag, tmp_path, options, reason):
    with pytest.raises(InputError, match=reason):
        run(bag, tmp_path / 'out', estimates=tmp_path / 'e.jsonl', **options)
    assert [p.name for p in tmp_path.iterdir()] == ['in']


def test_results_never_replace_the_bag_they_come_from(bag):
    with pytest.raises(InputError, match='is the bag to read'):
        run(bag, bag, overwrite=True)


def test_a_missing_topic_names_those_that_are_there(tmp_path):
    with BagWriter(tmp_path / 'in') as bag:
        write_colour(bag, 0)
        write_info(bag)
    with pytest.raises(InputError, match=r'no topic for depth .*none is there; topics: .*Image\)'):
        run(tmp_path / 'in', tmp_path / 'out')


def test_two_topics_that_would_fit_are_named(tmp_path):
    with BagWriter(tmp_path / 'in') as bag:
        write_info(bag)
        write_depth(bag, 0)
        write_colour(bag, 0, topic='/left')
        write_colour(bag, 0, topic='/right')
    with pytest.raises(InputError, match='more than one would fit: /left, /right'):
        run(tmp_path / 'in', tmp_path / 'out')


def test_a_camera_without_calibration_is_refused(tmp_path):
    with BagWriter(tmp_path / 'in') as bag:
        write_colour(bag, 0)
        write_depth(bag, 0)
        bag.write(INFO, 'sensor_msgs/msg/CameraInfo', {'width': 64, 'height': 48}, START)
    with pytest.raises(InputError, match='not calibrated'):
        run(tmp_path / 'in', tmp_path / 'out')


def test_a_place_for_estimates_that_cannot_be_written_is_refused(bag, tmp_path):
    with pytest.raises(InputError, match='cannot write'):
        run(bag, tmp_path / 'out', estimates=bag / 'metadata.yaml/e.jsonl')
