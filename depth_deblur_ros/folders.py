"""
Frames out of image files, results into files.

A frame is a colour image, a 16-bit depth image registered to it, and a camera.json. Results are
written beside their target under another name first, so that a file is whole or not there.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
import json
import math
import os
from pathlib import Path
from typing import Any

import cv2
from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    check_exposure,
    FloatImage,
    InputError,
    RgbdFrame,
)
from depth_deblur_ros.core.lens import undistorted
import numpy as np
import numpy.typing as npt

NEEDED = ('fx', 'fy', 'cx', 'cy', 'width', 'height', 'depth_scale', 'exposure', 'transfer')
OPTIONAL = ('distortion',)
MAX_DEPTH_SCALE = 1e6  # stored values per metre; a micrometre a step


@dataclass(frozen=True)
class CameraFile:
    """
    What camera.json says.

    depth_scale: stored value / depth_scale = metres; exposure in seconds or None when unknown.
    """

    intrinsics: CameraIntrinsics
    depth_scale: float
    exposure: float | None

    def __post_init__(self) -> None:
        check_depth_scale(self.depth_scale)
        check_exposure(self.exposure)


def check_depth_scale(value: Any) -> None:
    """Refuse a depth scale that cannot turn stored values into metres."""
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if not number or not math.isfinite(value) or not 0 < value <= MAX_DEPTH_SCALE:
        raise InputError(f'depth_scale must lie in (0, {MAX_DEPTH_SCALE:g}], got {value}')


def read_camera(path: Path) -> CameraFile:
    """Read camera.json; InputError names the file, the key and the value."""
    try:
        record = json.loads(_read_bytes(path))
    except ValueError as error:
        raise InputError(f'{path} is not JSON: {error}') from error
    if not isinstance(record, dict):
        raise InputError(f'{path} must be one JSON object, got {type(record).__name__}')
    if missing := [key for key in NEEDED if key not in record]:
        hint = ' (null = unknown)' if missing == ['exposure'] else ''
        raise InputError(f'{path} lacks {", ".join(missing)}{hint}')
    if unknown := sorted(record.keys() - {*NEEDED, *OPTIONAL}):
        known = ', '.join((*NEEDED, *OPTIONAL))
        raise InputError(f'{path} has unknown keys {", ".join(unknown)}; known are {known}')
    try:
        return _camera_of(record)
    except InputError as error:
        raise InputError(f'{path}: {error}') from error


def _camera_of(record: dict[str, Any]) -> CameraFile:
    distortion = record.get('distortion')
    if distortion is not None and not isinstance(distortion, list):
        raise InputError(f'distortion must be a list k1 k2 p1 p2 [k3], got {distortion!r}')
    names = {f.name for f in fields(CameraIntrinsics)} - {'distortion'}
    intrinsics = CameraIntrinsics(
        distortion=None if distortion is None else tuple(distortion),
        **{name: record[name] for name in names},
    )
    return CameraFile(intrinsics, record['depth_scale'], record['exposure'])


def read_rgb(path: Path, camera: CameraIntrinsics) -> FloatImage:
    """Read a colour (H, W, 3) or grey (H, W) image of 8 or 16 bit as float32 in 0..1."""
    pixels = read_pixels(path, camera)
    full = float(np.iinfo(pixels.dtype).max)
    return np.ascontiguousarray(pixels, np.float32) / np.float32(full)


def read_pixels(path: Path, camera: CameraIntrinsics) -> npt.NDArray[Any]:
    """Read an image as it is stored, uint8 or uint16, (H, W, 3) RGB or (H, W)."""
    pixels = _decode(path)
    _check_size(path, pixels, camera)
    if pixels.dtype not in (np.uint8, np.uint16):
        raise InputError(f'{path} must hold 8 or 16 bit samples, got {pixels.dtype}')
    if pixels.ndim == 2:
        return pixels
    if pixels.shape[2] == 4 and (pixels[..., 3] < np.iinfo(pixels.dtype).max).any():
        raise InputError(f'{path} is partly transparent; an opaque image is needed')
    return np.ascontiguousarray(pixels[..., 2::-1])  # cv2 reads blue first


def read_depth(path: Path, depth_scale: float, camera: CameraIntrinsics) -> FloatImage:
    """Read a 16-bit depth image as metres (H, W), 0 = hole as NaN."""
    stored = _decode(path)
    if stored.dtype != np.uint16 or stored.ndim != 2:
        channels = 1 if stored.ndim == 2 else stored.shape[2]
        raise InputError(
            f'{path} must be a depth image of one 16-bit channel, got {channels} of {stored.dtype}'
        )
    _check_size(path, stored, camera)
    # Divide in float64, so that each value is the float nearest to the truth.
    return np.where(stored == 0, np.nan, stored / float(depth_scale)).astype(np.float32)


def read_frame(rgb: Path, depth: Path, camera: Path) -> RgbdFrame:
    """Read a frame; the distortion that the camera file tells is undone."""
    file = read_camera(camera)
    frame = RgbdFrame(
        image=read_rgb(rgb, file.intrinsics),
        depth=read_depth(depth, file.depth_scale, file.intrinsics),
        camera=file.intrinsics,
        exposure=file.exposure,
    )
    return undistorted(frame)


def write_image(path: Path, image: npt.NDArray[Any]) -> None:
    """Write an image (H, W, 3) RGB or (H, W), uint8 or float 0..1, in the format of the suffix."""
    pixels = image if image.dtype == np.uint8 else np.rint(255 * np.clip(image, 0, 1))
    pixels = pixels.astype(np.uint8)
    if pixels.ndim == 3:
        pixels = np.ascontiguousarray(pixels[..., ::-1])  # cv2 writes blue first
    try:
        done, data = cv2.imencode(Path(path).suffix, pixels)
    except cv2.error:
        done = False
    if not done:
        raise InputError(f'cannot write {path}: {Path(path).suffix!r} is no known image format')
    _write_bytes(path, data.tobytes())


def write_video(path: Path, images: Sequence[npt.NDArray[Any]], rate: float = 15.0) -> None:
    """Write float images (H, W[, 3]) RGB, 0..1, as an MP4 of `rate` frames/s."""
    height, width = images[0].shape[:2]
    part = path.with_name(f'.{os.getpid()}.{path.name}')
    code = cv2.VideoWriter.fourcc(*'mp4v')
    video = cv2.VideoWriter(str(part), code, rate, (width, height))
    if not video.isOpened():
        raise InputError(f'cannot write {path}: no folder to write in, or OpenCV has no MP4')
    for image in images:
        pixels = np.rint(255 * np.clip(image, 0, 1)).astype(np.uint8)
        bgr = cv2.COLOR_GRAY2BGR if pixels.ndim == 2 else cv2.COLOR_RGB2BGR
        video.write(cv2.cvtColor(pixels, bgr))
    video.release()
    os.replace(part, path)


def write_json(path: Path, record: Mapping[str, Any]) -> None:
    """Write a record as JSON; NaN and infinity are refused, other programs cannot read them."""
    write_text(path, json.dumps(record, indent=1, allow_nan=False) + '\n')


def write_text(path: Path, text: str) -> None:
    """Write a text file."""
    _write_bytes(path, text.encode())


def _write_bytes(path: Path, data: bytes) -> None:
    path = Path(path)
    hidden = path.with_name(f'.{path.name}.{os.getpid()}')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        try:
            hidden.write_bytes(data)
            os.replace(hidden, path)
        finally:
            hidden.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f'cannot write {path}: {error.strerror or error}') from error


def _read_bytes(path: Path) -> bytes:
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror or error}') from error


def _decode(path: Path) -> npt.NDArray[Any]:
    data = np.frombuffer(_read_bytes(path), np.uint8)
    try:
        pixels = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    except cv2.error:
        pixels = None
    if pixels is None:
        raise InputError(f'{path} is not an image that can be read')
    return np.asarray(pixels)


def _check_size(path: Path, pixels: npt.NDArray[Any], camera: CameraIntrinsics) -> None:
    height, width = pixels.shape[:2]
    if (width, height) != (camera.width, camera.height):
        raise InputError(
            f'{path} is {width}x{height} but its camera is {camera.width}x{camera.height}'
        )
