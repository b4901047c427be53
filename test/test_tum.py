"""Folders in the benchmark's format: which images pair, and what reaches the bag."""

from decimal import Decimal
from itertools import pairwise
import json

import cv2
from depth_deblur_ros.cli import main
from depth_deblur_ros.core.data import InputError
from depth_deblur_ros.tum import import_tum, preset_camera, PRESETS, tum_camera, tum_pairs
from hypothesis import given
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
import numpy as np
import pytest

RGB = ('1.000000', '1.033333', '1.066667')
DEPTH = ('1.010000', '1.060001')
CAMERA = {
    'fx': 60.0,
    'fy': 60.0,
    'cx': 23.5,
    'cy': 15.5,
    'width': 48,
    'height': 32,
    'depth_scale': 500,
    'exposure': None,
    'transfer': 'srgb',
    'distortion': [0.2, -0.9, 0.1, 0.0, 1.1],
}
NS = 1_000_000


@pytest.fixture
def folder(tmp_path):
    """Write three colour and two depth images, named by their stamps, and a camera."""
    rng = np.random.default_rng(0)
    for name, stamps in (('rgb', RGB), ('depth', DEPTH)):
        (tmp_path / 'tum' / name).mkdir(parents=True)
        for stamp in stamps:
            size, kind = ((32, 48, 3), np.uint8) if name == 'rgb' else ((32, 48), np.uint16)
            pixels = rng.integers(0, np.iinfo(kind).max, size).astype(kind)
            cv2.imwrite(str(tmp_path / 'tum' / name / f'{stamp}.png'), pixels)
    (tmp_path / 'tum/camera.json').write_text(json.dumps(CAMERA))
    return tmp_path / 'tum'


def stamps_of(folder):
    return [(p.rgb_ns, p.depth_ns) for p in tum_pairs(folder)]


def write_lists(folder):
    for name, stamps in (('rgb', RGB), ('depth', DEPTH)):
        lines = ['# a comment', '', *(f'{s} {name}/{s}.png' for s in stamps)]
        (folder / f'{name}.txt').write_text('\n'.join(lines))


def read_bag(path):
    found = {}
    with next(path.glob('*.mcap')).open('rb') as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, channel, record, message in reader.iter_decoded_messages():
            found.setdefault(channel.topic, []).append((record.log_time, message))
    return found


def test_names_that_are_stamps_pair_with_the_nearest(folder):
    near = [(1000 * NS, 1010 * NS), (1033_333_000, 1010 * NS), (1066_667_000, 1060_001_000)]
    assert stamps_of(folder) == near
    (folder / 'rgb').rename(folder / 'color')
    assert stamps_of(folder) == near


def test_lists_come_before_associations_and_associations_before_names(folder):
    by_name = stamps_of(folder)
    lines = ['# rgb depth', f'{RGB[2]} rgb/{RGB[2]}.png {DEPTH[0]} depth/{DEPTH[0]}.png A_pan']
    (folder / 'associations.txt').write_text('\n'.join(lines))
    assert stamps_of(folder) == [(1066_667_000, 1010 * NS)]
    write_lists(folder)
    assert stamps_of(folder) == by_name
    assert {p.rgb.name for p in tum_pairs(folder)} == {f'{s}.png' for s in RGB}


@given(st.integers(0, 2**31 * 10**9 - 1))
def test_stamps_are_exact_to_the_nanosecond(tmp_path_factory, nanoseconds):
    folder = tmp_path_factory.mktemp('tum')
    text = f'{Decimal(nanoseconds) / 10**9:f}'
    for name in ('rgb', 'depth'):
        (folder / f'{name}.txt').write_text(f'{text} {name}/{text}.png\n')
    assert stamps_of(folder) == [(nanoseconds, nanoseconds)]


@pytest.mark.parametrize(
    ('name', 'text', 'words'),
    [
        ('rgb.txt', '1.0', r'rgb\.txt:1 must have 2 columns'),
        ('rgb.txt', 'one rgb/1.png', r"rgb\.txt:1 must be a stamp in seconds, got 'one'"),
        (
            'rgb.txt',
            'nan rgb/1.png',
            r'rgb\.txt:1 must be a stamp in \[0, 2147483648\) s, got nan',
        ),
        ('rgb.txt', '-1 rgb/1.png', 'got -1'),
        ('rgb.txt', '1.0 a.png\n1.0 b.png', r'rgb\.txt has two files at 1000000000 ns'),
        ('depth.txt', '# nothing', 'lists no depth images'),
        ('groundtruth.txt', '1 2 3', r'groundtruth\.txt:1 must have 8 columns'),
        ('groundtruth.txt', '1 2 3 4 5 6 7 x', 'must hold numbers'),
        ('groundtruth.txt', '1 2 3 4 5 6 7 inf', 'must be finite'),
    ],
)
def test_bad_lists_are_refused_with_file_and_line(folder, tmp_path, name, text, words):
    write_lists(folder)
    (folder / name).write_text(text)
    with pytest.raises(InputError, match=words):
        import_tum(folder, tmp_path / 'bag')
    assert [p.name for p in tmp_path.iterdir()] == ['tum']


def test_what_is_no_tum_folder_is_refused(tmp_path):
    with pytest.raises(InputError, match='is not a folder'):
        tum_pairs(tmp_path / 'gone')
    with pytest.raises(InputError, match='neither lists nor a folder rgb or color'):
        tum_pairs(tmp_path)
    for name in ('assoc_a.txt', 'assoc_b.txt'):
        (tmp_path / name).write_text('')
    with pytest.raises(InputError, match=r'more than one association file: assoc_a\.txt, assoc_b'):
        tum_pairs(tmp_path)


def test_the_camera_given_comes_first_then_the_folders_then_the_preset(folder, tmp_path):
    other = tmp_path / 'other.json'
    other.write_text(json.dumps({**CAMERA, 'fx': 70.0}))
    assert tum_camera(folder, other, 'tum_fr1').intrinsics.fx == 70
    assert tum_camera(folder, None, 'tum_fr1').intrinsics.fx == 60
    (folder / 'camera.json').unlink()
    assert tum_camera(folder, None, 'tum_fr1') == preset_camera('tum_fr1')
    with pytest.raises(InputError, match=r'has no camera\.json: name a camera file or a preset'):
        tum_camera(folder)
    with pytest.raises(InputError, match=r"preset must be one of tum_fr1, .*, got 'tum_fr9'"):
        tum_camera(folder, None, 'tum_fr9')


@pytest.mark.parametrize('name', PRESETS)
def test_presets_are_vga_cameras(name):
    file = preset_camera(name)
    assert (file.intrinsics.width, file.intrinsics.height, file.depth_scale) == (640, 480, 5000)
    assert (file.intrinsics.distortion is None) == (name == 'tum_fr3')


def test_everything_reaches_the_bag_once_and_unchanged(folder, tmp_path):
    (folder / 'groundtruth.txt').write_text('1.0305 1 2 3 0.5 0.5 0.5 -0.5\n')
    summary = import_tum(folder, tmp_path / 'bag')
    assert str(summary) == '3 colour images, 2 depth images, 1 poses'
    bag = read_bag(tmp_path / 'bag')
    colour, depth = bag['/camera/rgb/image_color'], bag['/camera/depth/image']
    for images, stamps, name in ((colour, RGB, 'rgb'), (depth, DEPTH, 'depth')):
        assert len(images) == len(stamps)
        for (log_ns, message), stamp in zip(images, stamps, strict=True):
            assert log_ns == int(Decimal(stamp) * 10**9)
            header = message.header
            assert header.stamp.sec * 10**9 + header.stamp.nanosec == log_ns
            assert header.frame_id == 'openni_rgb_optical_frame'
            stored = cv2.imread(str(folder / name / f'{stamp}.png'), cv2.IMREAD_UNCHANGED)
            if name == 'rgb':
                assert message.encoding == 'rgb8'
                found = np.frombuffer(message.data, np.uint8).reshape(32, 48, 3)
                np.testing.assert_array_equal(found, stored[..., ::-1])
            else:
                assert message.encoding == '32FC1'
                found = np.frombuffer(message.data, np.float32).reshape(32, 48)
                np.testing.assert_array_equal(found, np.float32(stored / 500))
    pose = bag['/ground_truth/pose'][0][1]
    assert (pose.pose.position.z, pose.pose.orientation.w) == (3, -0.5)
    info = bag['/camera/rgb/camera_info']
    assert [log for log, _ in info] == [log for log, _ in colour]
    assert list(info[0][1].d) == CAMERA['distortion']
    assert list(info[0][1].k) == [60, 0, 23.5, 0, 60, 15.5, 0, 0, 1]


def test_messages_stand_in_the_order_of_their_stamps(folder, tmp_path):
    import_tum(folder, tmp_path / 'bag')
    with next((tmp_path / 'bag').glob('*.mcap')).open('rb') as file:
        reader = make_reader(file)
        times = [record.log_time for *_, record in reader.iter_messages(log_time_order=False)]
    assert all(a <= b for a, b in pairwise(times))


def test_pairs_that_the_stamps_do_not_tell_are_counted(folder, tmp_path):
    rows = [(RGB[0], DEPTH[1]), (RGB[1], DEPTH[0])]
    text = '\n'.join(f'{a} rgb/{a}.png {b} depth/{b}.png' for a, b in rows)
    (folder / 'assoc.txt').write_text(text)
    summary = import_tum(folder, tmp_path / 'bag')
    assert summary.regrouped == 1
    assert '1 pairs are not nearest by stamp' in str(summary)


def test_a_missing_image_leaves_no_bag(folder, tmp_path, capsys):
    (folder / 'depth' / f'{DEPTH[1]}.png').write_bytes(b'')
    assert main(['import-tum', str(folder), str(tmp_path / 'bag')]) == 2
    assert f'{DEPTH[1]}.png is not an image' in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ['tum']


def test_a_real_folder_is_paired_as_its_association_file_says(data):
    pairs = tum_pairs(data / 'tum_fr1_rpy')
    depths = {p.depth_ns for p in pairs}
    assert (len(pairs), len(depths)) == (50, 44)
    for pair in pairs:
        assert pair.depth_ns == min(depths, key=lambda d: abs(d - pair.rgb_ns))
    assert len(tum_pairs(data / 'tum_fr1_360')) == 5
