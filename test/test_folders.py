"""Frames from image files: what is read exactly, what is refused, what is left behind."""

import json
import math

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, InputError
from depth_deblur_ros.folders import (
    read_camera,
    read_depth,
    read_frame,
    read_rgb,
    write_image,
    write_json,
    write_text,
)
import numpy as np
import pytest

CAMERA = CameraIntrinsics(60.0, 60.0, 23.5, 15.5, 48, 32)
RECORD = {
    'fx': 60.0,
    'fy': 60,
    'cx': 23.5,
    'cy': 15.5,
    'width': 48,
    'height': 32,
    'depth_scale': 5000,
    'exposure': 0.02,
    'transfer': 'linear',
}


@pytest.fixture
def camera_json(tmp_path):
    def write(**changes):
        path = tmp_path / 'camera.json'
        path.write_text(json.dumps({**RECORD, **changes}))
        return path

    return write


def image(dtype=np.uint8, channels=3):
    top = np.iinfo(dtype).max
    shape = (32, 48) if channels == 1 else (32, 48, channels)
    return np.random.default_rng(0).integers(0, top, shape, endpoint=True).astype(dtype)


def saved(path, pixels):
    if pixels.ndim == 3:
        order = [2, 1, 0, 3][: pixels.shape[2]]
        pixels = np.ascontiguousarray(pixels[..., order])
    assert cv2.imwrite(str(path), pixels)
    return path


def test_camera_json_is_read(camera_json):
    file = read_camera(camera_json(distortion=[0.1, 0, 0, 0, 0], exposure=None))
    assert file.intrinsics == CameraIntrinsics(
        60.0, 60, 23.5, 15.5, 48, 32, (0.1, 0, 0, 0, 0), 'linear'
    )
    assert (file.depth_scale, file.exposure) == (5000, None)
    assert read_camera(camera_json()).intrinsics.distortion is None


@pytest.mark.parametrize('key', RECORD)
def test_a_missing_key_is_named(camera_json, key):
    path = camera_json()
    path.write_text(json.dumps({k: v for k, v in RECORD.items() if k != key}))
    with pytest.raises(InputError, match=rf'camera\.json lacks {key}'):
        read_camera(path)


@pytest.mark.parametrize(
    ('key', 'value'),
    [
        ('fx', math.nan),
        ('fx', 0),
        ('fy', '60'),
        ('fy', None),
        ('cx', 1e9),
        ('width', 48.5),
        ('height', -32),
        ('depth_scale', 0),
        ('depth_scale', math.inf),
        ('depth_scale', True),
        ('depth_scale', '5000'),
        ('exposure', -0.02),
        ('exposure', 0),
        ('exposure', 'auto'),
        ('transfer', 'gamma'),
        ('distortion', 0.1),
        ('distortion', [0.1, 0.2]),
        ('distortion', [0.1, 0.2, math.nan, 0, 0]),
    ],
)
def test_a_bad_value_is_refused_with_file_key_and_value(camera_json, key, value):
    with pytest.raises(InputError) as error:
        read_camera(camera_json(**{key: value}))
    text = str(error.value)
    assert 'camera.json' in text
    assert key in text
    shown = value[0] if isinstance(value, list) else value
    assert str(shown) in text
    assert '\n' not in text


def test_an_unknown_key_is_refused(camera_json):
    with pytest.raises(InputError, match='unknown keys distorsion; known are fx'):
        read_camera(camera_json(distorsion=[0, 0, 0, 0, 0]))


@pytest.mark.parametrize('text', ['', '{', '[1, 2]', '3', '\x00\xff'])
def test_what_is_no_camera_json_is_refused(tmp_path, text):
    path = tmp_path / 'camera.json'
    path.write_bytes(text.encode('latin-1'))
    with pytest.raises(InputError, match=r'camera\.json (is not JSON|must be one JSON object)'):
        read_camera(path)


def test_a_missing_file_is_named(tmp_path):
    for read in (
        read_camera,
        lambda p: read_rgb(p, CAMERA),
        lambda p: read_depth(p, 1000, CAMERA),
    ):
        with pytest.raises(InputError, match=r'cannot read .*/gone: No such file'):
            read(tmp_path / 'gone')
        with pytest.raises(InputError, match='Is a directory'):
            read(tmp_path)


@pytest.mark.parametrize('dtype', [np.uint8, np.uint16])
@pytest.mark.parametrize('channels', [1, 3])
def test_colour_is_read_as_it_is_stored(tmp_path, dtype, channels):
    pixels = image(dtype, channels)
    found = read_rgb(saved(tmp_path / 'rgb.png', pixels), CAMERA)
    assert found.dtype == np.float32
    assert found.shape == pixels.shape
    np.testing.assert_array_equal(np.rint(found * np.iinfo(dtype).max), pixels)


def test_an_opaque_alpha_channel_is_dropped_and_a_transparent_one_refused(tmp_path):
    pixels = image(channels=4)
    pixels[..., 3] = 255
    found = read_rgb(saved(tmp_path / 'opaque.png', pixels), CAMERA)
    np.testing.assert_array_equal(np.rint(found * 255), pixels[..., :3])
    pixels[3, 4, 3] = 0
    with pytest.raises(InputError, match='partly transparent'):
        read_rgb(saved(tmp_path / 'transparent.png', pixels), CAMERA)


@pytest.mark.parametrize('data', [b'', b'no image', b'\x89PNG\r\n\x1a\n' + bytes(40)])
def test_what_is_no_image_is_refused(tmp_path, data):
    (tmp_path / 'rgb.png').write_bytes(data)
    with pytest.raises(InputError, match=r'rgb\.png is not an image that can be read'):
        read_rgb(tmp_path / 'rgb.png', CAMERA)


@pytest.mark.parametrize('keep', [0.3, 0.9])
def test_a_truncated_image_is_refused(tmp_path, keep):
    path = saved(tmp_path / 'rgb.png', image())
    path.write_bytes(path.read_bytes()[: int(keep * path.stat().st_size)])
    with pytest.raises(InputError, match='not an image that can be read'):
        read_rgb(path, CAMERA)


def test_float_samples_are_refused(tmp_path):
    path = tmp_path / 'rgb.tiff'
    cv2.imwrite(str(path), np.ones((32, 48, 3), np.float32))
    with pytest.raises(InputError, match='8 or 16 bit samples, got float32'):
        read_rgb(path, CAMERA)


def test_depth_is_the_float_nearest_to_the_truth_and_zero_is_a_hole(tmp_path):
    stored = np.arange(32 * 48, dtype=np.uint16).reshape(32, 48) * 40
    found = read_depth(saved(tmp_path / 'depth.png', stored), 5000, CAMERA)
    assert np.isnan(found[0, 0])
    np.testing.assert_array_equal(found.ravel()[1:], np.float32(stored.ravel()[1:] / 5000))


def test_depth_that_is_all_missing_is_read_as_all_holes(tmp_path):
    path = saved(tmp_path / 'depth.png', np.zeros((32, 48), np.uint16))
    assert np.isnan(read_depth(path, 5000, CAMERA)).all()


@pytest.mark.parametrize(
    ('pixels', 'got'),
    [(image(np.uint8, 1), '1 of uint8'), (image(np.uint16, 3), '3 of uint16')],
)
def test_depth_of_another_kind_is_refused(tmp_path, pixels, got):
    with pytest.raises(InputError, match=f'one 16-bit channel, got {got}'):
        read_depth(saved(tmp_path / 'depth.png', pixels), 5000, CAMERA)


def test_images_of_another_size_are_refused(tmp_path):
    rgb = saved(tmp_path / 'rgb.png', image()[:-1])
    depth = saved(tmp_path / 'depth.png', image(np.uint16, 1)[:, :-2])
    with pytest.raises(InputError, match=r'rgb\.png is 48x31 but its camera is 48x32'):
        read_rgb(rgb, CAMERA)
    with pytest.raises(InputError, match=r'depth\.png is 46x32 but its camera is 48x32'):
        read_depth(depth, 5000, CAMERA)


def test_a_frame_is_made_of_its_files(tmp_path, camera_json):
    rgb = saved(tmp_path / 'rgb.png', image())
    depth = saved(tmp_path / 'depth.png', image(np.uint16, 1))
    frame = read_frame(rgb, depth, camera_json())
    assert frame.image.shape == (32, 48, 3)
    assert frame.exposure == 0.02
    assert frame.camera.transfer == 'linear'


@pytest.mark.parametrize('dtype', [np.uint8, np.float32])
def test_an_image_is_written_and_read_back(tmp_path, dtype):
    pixels = image()
    path = tmp_path / 'new/folder/image.png'
    write_image(path, pixels if dtype is np.uint8 else pixels.astype(np.float32) / 255)
    np.testing.assert_array_equal(np.rint(255 * read_rgb(path, CAMERA)), pixels)
    assert [p.name for p in path.parent.iterdir()] == ['image.png']


def test_an_unknown_format_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"'\.xyz' is no known image format"):
        write_image(tmp_path / 'image.xyz', image())
    assert not list(tmp_path.iterdir())


def test_what_cannot_be_written_leaves_nothing_behind(tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(InputError, match=r'cannot write .*/file/image\.png: '):
        write_image(tmp_path / 'file/image.png', image())
    (tmp_path / 'folder').mkdir()
    with pytest.raises(InputError, match=r'cannot write .*/folder: Is a directory'):
        write_text(tmp_path / 'folder', 'text')
    assert {p.name for p in tmp_path.iterdir()} == {'file', 'folder'}


def test_a_file_is_replaced_whole(tmp_path, monkeypatch):
    path = tmp_path / 'motion.json'
    write_json(path, {'a': 1})
    monkeypatch.setattr('os.replace', lambda *_: (_ for _ in ()).throw(OSError(28, 'disk full')))
    with pytest.raises(InputError, match='disk full'):
        write_json(path, {'a': 2})
    assert json.loads(path.read_text()) == {'a': 1}
    assert [p.name for p in tmp_path.iterdir()] == ['motion.json']


def test_json_never_holds_nan(tmp_path):
    with pytest.raises(ValueError, match='not JSON compliant'):
        write_json(tmp_path / 'motion.json', {'quality': math.nan})
    assert not list(tmp_path.iterdir())


def test_a_frame_of_a_distorting_lens_is_undistorted(camera_json, tmp_path):
    rgb, depth = tmp_path / 'rgb.png', tmp_path / 'depth.png'
    pixels = image()
    cv2.imwrite(str(rgb), pixels)
    cv2.imwrite(str(depth), np.full((32, 48), 5000, np.uint16))
    frame = read_frame(rgb, depth, camera_json(distortion=[0.3, 0, 0, 0]))
    assert frame.camera.distortion is None
    assert np.isnan(frame.depth[0, 0]) and frame.depth[16, 24] == 1
    assert np.abs(255 * frame.image[..., ::-1] - pixels).max() > 20
