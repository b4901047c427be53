"""
ROS messages to arrays and back, by their fields alone.

rclpy and rosbags hand over different classes with the same fields, so nothing here imports either.
What goes out is a nested mapping of fields. REP 118: 16UC1 depth is millimetres, 32FC1 metres.
"""

from __future__ import annotations

from array import array
from collections.abc import Mapping
import struct
from typing import Any

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, InputError, MAX_PIXELS
from depth_deblur_ros.picture import check_picture
import numpy as np
import numpy.typing as npt

Fields = dict[str, Any]

_LAYOUT = {  # encoding: (sample type, channels, colour conversion of OpenCV or None)
    'mono8': ('u1', 1, None),
    'mono16': ('u2', 1, None),
    'rgb8': ('u1', 3, None),
    'rgb16': ('u2', 3, None),
    'bgr8': ('u1', 3, cv2.COLOR_BGR2RGB),
    'bgr16': ('u2', 3, cv2.COLOR_BGR2RGB),
    'rgba8': ('u1', 4, cv2.COLOR_RGBA2RGB),
    'bgra8': ('u1', 4, cv2.COLOR_BGRA2RGB),
}
for _bits, _code in (('8', 'u1'), ('16', 'u2')):
    # Four letters, first row then second, as in ROS; OpenCV's two letters mean another corner.
    _LAYOUT['bayer_rggb' + _bits] = (_code, 1, cv2.COLOR_BayerRGGB2RGB)
    _LAYOUT['bayer_bggr' + _bits] = (_code, 1, cv2.COLOR_BayerBGGR2RGB)
    _LAYOUT['bayer_gbrg' + _bits] = (_code, 1, cv2.COLOR_BayerGBRG2RGB)
    _LAYOUT['bayer_grbg' + _bits] = (_code, 1, cv2.COLOR_BayerGRBG2RGB)
DISTORTION_MODELS = ('plumb_bob', 'rational_polynomial')
_DEPTH_LAYOUT = {'16UC1': 'u2', 'mono16': 'u2', '32FC1': 'f4'}
_DEPTH_HEADER = struct.Struct(
    '<iff'
)  # of compressed_depth_image_transport: format, two parameters


def stamp_ns(header: Any) -> int:
    """Give the stamp of a std_msgs/Header in nanoseconds."""
    return int(header.stamp.sec) * 1_000_000_000 + int(header.stamp.nanosec)


def image_from_msg(msg: Any) -> FloatImage:
    """Read a sensor_msgs Image or CompressedImage as (H, W, 3) RGB or (H, W), 0..1."""
    if hasattr(msg, 'format'):
        return _unit(_compressed_image(msg))
    if msg.encoding not in _LAYOUT:
        raise InputError(
            f'image encoding {msg.encoding!r} is not known; known are {", ".join(_LAYOUT)}'
        )
    code, channels, conversion = _LAYOUT[msg.encoding]
    raw = _samples(msg, code, channels)
    return _unit(raw if conversion is None else cv2.cvtColor(raw, conversion))


def depth_from_msg(msg: Any) -> FloatImage:
    """Read a sensor_msgs Image or CompressedImage as depth (H, W) in metres, holes NaN."""
    if hasattr(msg, 'format'):
        return _compressed_depth(msg)
    if msg.encoding not in _DEPTH_LAYOUT:
        raise InputError(
            f'depth encoding {msg.encoding!r} is not known; known are {", ".join(_DEPTH_LAYOUT)}'
        )
    return _metres(_samples(msg, _DEPTH_LAYOUT[msg.encoding], 1))


def camera_from_msg(info: Any, transfer: str = 'srgb', rectified: bool = True) -> CameraIntrinsics:
    """
    Read a sensor_msgs/CameraInfo: P (all zero: K) of a rectified image, else K and D.

    The matrices are those of the full sensor; region of interest and binning lead to the image.
    """
    p, k = np.asarray(info.p, float).reshape(3, 4), np.asarray(info.k, float).reshape(3, 3)
    m = p if rectified and p.any() else k
    if not m.any():
        raise InputError('camera_info is not calibrated: K and P are all zero')
    roi, bin_x, bin_y = info.roi, max(1, info.binning_x), max(1, info.binning_y)
    width, height = roi.width or info.width, roi.height or info.height
    return CameraIntrinsics(
        fx=float(m[0, 0]) / bin_x,
        fy=float(m[1, 1]) / bin_y,
        cx=(float(m[0, 2]) - roi.x_offset + 0.5) / bin_x - 0.5,
        cy=(float(m[1, 2]) - roi.y_offset + 0.5) / bin_y - 0.5,
        width=int(width) // bin_x,
        height=int(height) // bin_y,
        distortion=None if rectified else _distortion(info),
        transfer=transfer,
    )


def _distortion(info: Any) -> tuple[float, ...] | None:
    """Give the coefficients of a lens model that can be undone; None where all are zero."""
    values = tuple(float(value) for value in info.d)
    if not any(values):
        return None
    if info.distortion_model not in DISTORTION_MODELS:
        raise InputError(
            f'distortion model {info.distortion_model!r} is not one of '
            f'{", ".join(DISTORTION_MODELS)}: rectify the images first'
        )
    return values


def header_fields(stamp: int, frame_id: str) -> Fields:
    """Give a std_msgs/Header for a stamp in nanoseconds."""
    sec, nanosec = divmod(stamp, 1_000_000_000)
    return {'stamp': {'sec': sec, 'nanosec': nanosec}, 'frame_id': frame_id}


def image_fields(image: FloatImage, header: Fields) -> Fields:
    """Give a sensor_msgs/Image, rgb8 or mono8, of an image in 0..1."""
    encoding = 'rgb8' if image.ndim == 3 else 'mono8'
    return _image_of(np.rint(image * 255).astype(np.uint8), encoding, header)


def compressed_fields(image: Fields, quality: int) -> Fields:
    """Give the sensor_msgs/CompressedImage, JPEG, of what image_fields gave."""
    pixels = image['data'].reshape(image['height'], image['width'], -1)[..., ::-1]
    _, data = cv2.imencode('.jpg', pixels, [cv2.IMWRITE_JPEG_QUALITY, quality])
    order = 'bgr8' if pixels.shape[2] == 3 else ''
    form = f'{image["encoding"]}; jpeg compressed {order}'  # as image_transport words it
    return {'header': image['header'], 'format': form, 'data': data.ravel()}


def depth_fields(depth: FloatImage, header: Fields) -> Fields:
    """Give a sensor_msgs/Image, 32FC1, of a depth in metres."""
    return _image_of(depth.astype('<f4'), '32FC1', header)


def camera_info_fields(camera: CameraIntrinsics, header: Fields) -> Fields:
    """Give the sensor_msgs/CameraInfo of an image that was taken with this camera."""
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    return {
        'header': header,
        'width': camera.width,
        'height': camera.height,
        'distortion_model': DISTORTION_MODELS[len(camera.distortion or ()) > 5],
        'd': list(camera.distortion or [0.0] * 5),
        'k': k,
        'r': np.eye(3).ravel().tolist(),
        'p': [*k[0:3], 0.0, *k[3:6], 0.0, *k[6:9], 0.0],
    }


def filled(message: Any, fields: Mapping[str, Any], entry: Any = None) -> Any:
    """Set a message from nested fields, as rclpy wants them; entry makes those of a list."""
    for name, value in fields.items():
        before = getattr(message, name)
        if isinstance(value, Mapping):
            filled(before, value, entry)
        elif isinstance(value, np.ndarray):
            setattr(message, name, array('B', value.tobytes()))  # others are taken in a slow loop
        elif isinstance(before, bytes):
            setattr(message, name, bytes([value]))
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            setattr(message, name, [filled(entry(), item) for item in value])
        else:
            setattr(message, name, value)
    return message


def _image_of(pixels: npt.NDArray[Any], encoding: str, header: Fields) -> Fields:
    return {
        'header': header,
        'height': pixels.shape[0],
        'width': pixels.shape[1],
        'encoding': encoding,
        'is_bigendian': 0,
        'step': pixels.strides[0],
        'data': np.ascontiguousarray(pixels).view(np.uint8).ravel(),
    }


def _samples(msg: Any, code: str, channels: int) -> npt.NDArray[Any]:
    """Give the message's samples (H, W) or (H, W, C), honouring row padding and byte order."""
    dtype = np.dtype(('>' if msg.is_bigendian else '<') + code)
    row = msg.width * channels * dtype.itemsize
    size = f'{msg.width}x{msg.height} {msg.encoding}'
    if not 0 < msg.width * msg.height <= MAX_PIXELS:
        raise InputError(f'an image of {size} is not within 1 and {MAX_PIXELS} pixels')
    if msg.step < row or len(msg.data) < msg.step * msg.height:
        raise InputError(
            f'an image of {size} with step {msg.step} does not fit in {len(msg.data)} bytes'
        )
    rows = np.frombuffer(msg.data, np.uint8)[: msg.step * msg.height]
    rows = np.ascontiguousarray(rows.reshape(msg.height, msg.step)[:, :row])
    samples = rows.view(dtype).astype(dtype.newbyteorder('='), copy=False)
    return samples.reshape((msg.height, msg.width, channels)[: 2 if channels == 1 else 3])


def _unit(raw: npt.NDArray[Any]) -> FloatImage:
    # Divide, do not multiply by 1 / 255: the largest value must be 1 exactly.
    image: FloatImage = raw.astype(np.float32, order='C') / np.float32(np.iinfo(raw.dtype).max)
    return image


def _metres(raw: npt.NDArray[Any]) -> FloatImage:
    depth = raw.astype(np.float32)
    if raw.dtype == np.uint16:
        depth /= np.float32(1000)  # 1500 mm must be 1.5 m exactly, which * 0.001 is not
    depth[~(np.isfinite(depth) & (depth > 0))] = np.nan
    return depth


def _decoded(msg: Any, data: npt.NDArray[np.uint8]) -> npt.NDArray[Any]:
    """Decode the bytes of a picture file, which OpenCV gives in the order BGR."""
    check_picture(data.tobytes())
    try:
        raw = cv2.imdecode(data, cv2.IMREAD_UNCHANGED)
    except cv2.error:
        raw = None
    if raw is None or raw.dtype not in (np.uint8, np.uint16):
        raise InputError(
            f'{data.size} bytes of a compressed image, format {msg.format!r}, cannot be decoded'
        )
    return np.asarray(raw)


def _compressed_image(msg: Any) -> npt.NDArray[Any]:
    raw = _decoded(msg, np.frombuffer(msg.data, np.uint8))
    if raw.ndim == 2:
        return raw
    # image_transport converts to BGR before it compresses and says so; anything else is said too.
    return raw[..., :3] if 'compressed rgb' in msg.format else raw[..., 2::-1]


def _compressed_depth(msg: Any) -> FloatImage:
    """Undo compressed_depth_image_transport: header, then PNG of mm or quantised 1/depth."""
    data = np.frombuffer(msg.data, np.uint8)
    if 'compressedDepth' not in msg.format:
        return _metres(_depth_png(msg, data))
    if 'rvl' in msg.format:
        raise InputError(f'depth format {msg.format!r} is not known; only png is')
    if data.size <= _DEPTH_HEADER.size:
        raise InputError(f'{data.size} bytes are too few for depth format {msg.format!r}')
    raw = _depth_png(msg, data[_DEPTH_HEADER.size :])
    if not msg.format.startswith('32FC1'):
        return _metres(raw)
    _, a, b = _DEPTH_HEADER.unpack(data[: _DEPTH_HEADER.size].tobytes())
    with np.errstate(divide='ignore', invalid='ignore'):
        return _metres(np.where(raw == 0, np.nan, a / (raw - np.float64(b))))


def _depth_png(msg: Any, data: npt.NDArray[np.uint8]) -> npt.NDArray[Any]:
    raw = _decoded(msg, data)
    if raw.dtype != np.uint16 or raw.ndim != 2:
        raise InputError(
            f'depth format {msg.format!r} does not hold a 16 bit image of one channel'
        )
    return raw
