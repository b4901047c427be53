"""Message fields to arrays and back: exact values, padding, byte order, what is refused."""

import array
from types import SimpleNamespace

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, InputError
from depth_deblur_ros.messages import (
    camera_from_msg,
    camera_info_fields,
    depth_fields,
    depth_from_msg,
    header_fields,
    image_fields,
    image_from_msg,
    stamp_ns,
)
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
import numpy as np
import pytest

HEADER = header_fields(1_305_031_231_096_775_000, 'camera')
sizes = st.tuples(st.integers(1, 7), st.integers(1, 7))
buffers = [bytes, bytearray, lambda b: array.array('B', b), lambda b: np.frombuffer(b, np.uint8)]
layouts = st.fixed_dictionaries(
    {'padding': st.integers(0, 7), 'big': st.booleans(), 'buffer': st.sampled_from(buffers)}
)


def image_msg(pixels, encoding, *, padding=0, big=False, buffer=bytes):
    pixels = pixels.astype(pixels.dtype.newbyteorder('>' if big else '<'))
    rows = [row.tobytes() + b'\xee' * padding for row in pixels]
    return SimpleNamespace(
        height=pixels.shape[0],
        width=pixels.shape[1],
        encoding=encoding,
        is_bigendian=int(big),
        step=len(rows[0]),
        data=buffer(b''.join(rows)),
    )


def as_msg(fields):
    """Turn nested fields into an object, as a message class would."""
    if isinstance(fields, dict):
        return SimpleNamespace(**{name: as_msg(value) for name, value in fields.items()})
    return fields


@given(layout=layouts, data=st.data())
@pytest.mark.parametrize(
    ('encoding', 'code', 'order'),
    [
        ('rgb8', 'u1', (0, 1, 2)),
        ('bgr8', 'u1', (2, 1, 0)),
        ('rgba8', 'u1', (0, 1, 2, 3)),
        ('bgra8', 'u1', (2, 1, 0, 3)),
        ('rgb16', 'u2', (0, 1, 2)),
        ('bgr16', 'u2', (2, 1, 0)),
    ],
)
def test_colour_is_read_whatever_the_layout(encoding, code, order, layout, data):
    rgba = data.draw(hnp.arrays(code, (*data.draw(sizes), 4)))
    msg = image_msg(rgba[..., order], encoding, **layout)
    image = image_from_msg(msg)
    assert image.dtype == np.float32
    np.testing.assert_array_equal(image, rgba[..., :3] / np.float32(np.iinfo(code).max))


@given(layout=layouts, data=st.data())
@pytest.mark.parametrize(('encoding', 'code'), [('mono8', 'u1'), ('mono16', 'u2')])
def test_grey_is_read_whatever_the_layout(encoding, code, layout, data):
    grey = data.draw(hnp.arrays(code, data.draw(sizes)))
    image = image_from_msg(image_msg(grey, encoding, **layout))
    np.testing.assert_array_equal(image, grey / np.float32(np.iinfo(code).max))


@pytest.mark.parametrize('pattern', ['rggb', 'bggr', 'gbrg', 'grbg'])
@pytest.mark.parametrize(('bits', 'code'), [(8, 'u1'), (16, 'u2')])
@pytest.mark.parametrize('size', [(8, 10), (7, 9)])
def test_a_mosaic_of_one_colour_gives_that_colour(pattern, bits, code, size):
    top = np.iinfo(code).max
    colour = dict(r=top, g=top // 2, b=top // 5)
    mosaic = np.empty(size, code)
    for place, letter in enumerate(pattern):
        mosaic[place // 2 :: 2, place % 2 :: 2] = colour[letter]
    image = image_from_msg(image_msg(mosaic, f'bayer_{pattern}{bits}'))
    expected = np.float32([colour[letter] / top for letter in 'rgb'])
    np.testing.assert_allclose(
        image[2:-2, 2:-2], np.broadcast_to(expected, image[2:-2, 2:-2].shape)
    )


@given(layout=layouts, data=st.data())
@pytest.mark.parametrize('encoding', ['16UC1', 'mono16'])
def test_millimetres_become_metres_and_zero_a_hole(encoding, layout, data):
    mm = data.draw(hnp.arrays('u2', data.draw(sizes)))
    depth = depth_from_msg(image_msg(mm, encoding, **layout))
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(np.isnan(depth), mm == 0)
    np.testing.assert_array_equal(depth[mm > 0], np.float32(mm[mm > 0] / 1000.0))


@given(layout=layouts, data=st.data())
def test_metres_stay_and_what_is_no_depth_is_a_hole(layout, data):
    metres = data.draw(hnp.arrays('f4', data.draw(sizes)))
    depth = depth_from_msg(image_msg(metres, '32FC1', **layout))
    good = np.isfinite(metres) & (metres > 0)
    np.testing.assert_array_equal(depth, np.where(good, metres, np.nan))


def test_unknown_encodings_are_named_with_the_known_ones():
    with pytest.raises(InputError, match=r"'yuv422'.*rgb8.*bayer_rggb8"):
        image_from_msg(image_msg(np.zeros((2, 2), 'u1'), 'yuv422'))
    with pytest.raises(InputError, match=r"'rgb8'.*16UC1, mono16, 32FC1"):
        depth_from_msg(image_msg(np.zeros((2, 2, 3), 'u1'), 'rgb8'))


@pytest.mark.parametrize(
    'lie',
    [
        {'step': 5},
        {'height': 5},
        {'width': 5},
        {'width': 0},
        {'height': 0},
        {'data': b''},
        {'width': 2**31, 'height': 2**31, 'step': 3 * 2**31},
    ],
)
def test_lying_sizes_are_refused(lie):
    msg = image_msg(np.zeros((2, 2, 3), 'u1'), 'rgb8')
    vars(msg).update(lie)
    with pytest.raises(InputError, match='image of'):
        image_from_msg(msg)


def compressed(file, format_):
    return SimpleNamespace(format=format_, data=np.frombuffer(file, np.uint8))


def encoded(extension, pixels):
    return cv2.imencode(extension, pixels)[1].tobytes()


GRADIENT = np.dstack([np.full((16, 24), v, np.uint8) for v in (200, 120, 10)])  # RGB


@pytest.mark.parametrize(
    'format_', ['rgb8; jpeg compressed bgr8', 'bgr8; jpeg compressed bgr8', 'jpeg']
)
def test_jpeg_gives_rgb(format_):
    image = image_from_msg(compressed(encoded('.jpg', GRADIENT[..., ::-1]), format_))
    np.testing.assert_allclose(image * 255, GRADIENT, atol=3)  # rounding of JPEG


@pytest.mark.parametrize('code', ['u1', 'u2'])
@pytest.mark.parametrize('channels', [1, 3, 4])
def test_png_is_exact(code, channels):
    pixels = np.random.default_rng(0).integers(0, np.iinfo(code).max, (9, 7, channels), code)
    image = image_from_msg(compressed(encoded('.png', pixels), 'rgb8; png compressed bgr8'))
    expected = pixels[..., 0] if channels == 1 else pixels[..., 2::-1]
    np.testing.assert_array_equal(image, expected / np.float32(np.iinfo(code).max))
    assert image.flags.c_contiguous


def test_a_file_that_holds_rgb_as_it_says_is_not_swapped():
    file = encoded('.png', GRADIENT)
    image = image_from_msg(compressed(file, 'rgb8; png compressed rgb8'))
    np.testing.assert_array_equal(image, GRADIENT / np.float32(255))


@given(data=st.binary(max_size=60), format_=st.sampled_from(['jpeg', 'rgb8; png compressed bgr8']))
def test_bytes_that_are_no_picture_are_refused(data, format_):
    with pytest.raises(InputError, match='cannot be decoded'):
        image_from_msg(compressed(data, format_))


def test_compressed_depth_in_millimetres_is_exact():
    mm = np.uint16([[0, 1, 1500], [999, 4000, 65535]])
    for file, format_ in [
        (bytes(12) + encoded('.png', mm), '16UC1; compressedDepth png'),
        (bytes(12) + encoded('.png', mm), '16UC1; compressedDepth'),
        (encoded('.png', mm), '16UC1; png compressed '),
    ]:
        depth = depth_from_msg(compressed(file, format_))
        np.testing.assert_array_equal(depth, depth_from_msg(image_msg(mm, '16UC1')))


def test_compressed_depth_in_metres_undoes_the_quantisation():
    metres = np.float32([[0.5, 1.0, np.nan], [3.3, 7.0, 9.9]])
    a, top = np.float32(100 * 101), np.float32(10)  # as the transport: quantisation 100, 10 m
    b = 1 - a / top
    inverse = np.where(np.isnan(metres), 0, a / metres + b).astype(np.uint16)
    header = np.int32(0).tobytes() + np.float32([a, b]).tobytes()
    msg = compressed(header + encoded('.png', inverse), '32FC1; compressedDepth png')
    np.testing.assert_allclose(depth_from_msg(msg), metres, rtol=0.01)  # one step of 1/depth


@pytest.mark.parametrize(
    ('file', 'format_', 'reason'),
    [
        (bytes(40), '16UC1; compressedDepth rvl', 'rvl'),
        (bytes(12), '16UC1; compressedDepth png', 'too few'),
        (bytes(40), '16UC1; compressedDepth png', 'cannot be decoded'),
        (bytes(12) + encoded('.png', GRADIENT), '16UC1; compressedDepth png', '16 bit'),
        (encoded('.jpg', GRADIENT), '16UC1; jpeg compressed', '16 bit'),
    ],
)
def test_depth_that_cannot_be_read_is_refused(file, format_, reason):
    with pytest.raises(InputError, match=reason):
        depth_from_msg(compressed(file, format_))


def info(p=None, k=None, size=(640, 480), roi=(0, 0, 0, 0), binning=(0, 0)):
    x, y, width, height = roi
    return SimpleNamespace(
        width=size[0],
        height=size[1],
        p=np.zeros(12) if p is None else p,
        k=np.zeros(9) if k is None else k,
        d=[0.1, 0.2, 0.0, 0.0, 0.0],
        binning_x=binning[0],
        binning_y=binning[1],
        roi=SimpleNamespace(x_offset=x, y_offset=y, width=width, height=height),
    )


P = [500, 0, 300, 0, 0, 510, 200, 0, 0, 0, 1, 0]
K = [520, 0, 310, 0, 530, 210, 0, 0, 1]


def test_the_projection_counts_and_the_distortion_does_not():
    assert camera_from_msg(info(P, K), 'linear') == CameraIntrinsics(
        500, 510, 300, 200, 640, 480, transfer='linear'
    )
    assert camera_from_msg(info(None, K)) == CameraIntrinsics(520, 530, 310, 210, 640, 480)


def test_a_camera_without_calibration_is_refused():
    with pytest.raises(InputError, match='not calibrated'):
        camera_from_msg(info())
    with pytest.raises(InputError, match='fx'):
        camera_from_msg(info([np.nan] * 12))


def test_binning_is_a_resize_and_a_region_shifts_the_centre():
    whole = camera_from_msg(info(P))
    assert camera_from_msg(info(P, binning=(2, 4))) == whole.scaled(320, 120)
    part = camera_from_msg(info(P, roi=(100, 50, 200, 160)))
    assert (part.width, part.height, part.cx, part.cy) == (200, 160, 200, 150)
    both = camera_from_msg(info(P, roi=(100, 50, 200, 160), binning=(2, 2)))
    assert both == part.scaled(100, 80)


def test_stamps_and_headers_round_trip():
    assert stamp_ns(as_msg(HEADER)) == 1_305_031_231_096_775_000
    assert HEADER['stamp'] == {'sec': 1_305_031_231, 'nanosec': 96_775_000}


@given(pixels=hnp.arrays('u1', st.sampled_from([(3, 5, 3), (4, 7)])))
def test_images_round_trip(pixels):
    image = pixels / np.float32(255)
    np.testing.assert_array_equal(image_from_msg(as_msg(image_fields(image, HEADER))), image)


@given(depth=hnp.arrays('f4', (3, 5), elements=st.floats(0.125, 100, width=32)))
def test_depth_and_its_camera_round_trip(depth):
    np.testing.assert_array_equal(depth_from_msg(as_msg(depth_fields(depth, HEADER))), depth)


def test_cameras_round_trip():
    camera = CameraIntrinsics(500, 510, 300.25, 200.5, 640, 480)
    fields = camera_info_fields(camera, HEADER) | {'binning_x': 0, 'binning_y': 0}
    fields['roi'] = {'x_offset': 0, 'y_offset': 0, 'width': 0, 'height': 0}
    assert camera_from_msg(as_msg(fields)) == camera
    assert camera_from_msg(as_msg(fields | {'p': np.zeros(12)})) == camera
