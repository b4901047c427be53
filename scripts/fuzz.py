"""
Throw garbage at every decoder; whatever it is, nothing but an InputError may come out.

usage: python scripts/fuzz.py DECODER [flags of libFuzzer, such as -runs=100000 or a corpus]
       python scripts/fuzz.py --list
Coverage-guided by atheris (pip install '.[fuzz]'), beginning with sound inputs. A finding is
written to crash-... in the working folder; `python scripts/fuzz.py DECODER crash-...` shows it.
"""

from __future__ import annotations

import atexit
from collections.abc import Callable
import json
import os
from pathlib import Path
import shutil
import struct
import sys
import tempfile
from types import SimpleNamespace
from typing import Any

import cv2
from depth_deblur_ros.bag import BagReader, BagWriter, decoded
from depth_deblur_ros.core.data import InputError
from depth_deblur_ros.core.params import params_from_mapping
from depth_deblur_ros.flags import read_params
from depth_deblur_ros.folders import read_camera
from depth_deblur_ros.mcap_file import BagMessage, Topic
from depth_deblur_ros.messages import (
    camera_from_msg,
    depth_fields,
    depth_from_msg,
    header_fields,
    image_fields,
    image_from_msg,
)
import numpy as np
import zstandard

IMAGE, COMPRESSED = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CompressedImage'
INFO, FLOAT = 'sensor_msgs/msg/CameraInfo', 'std_msgs/msg/Float32'
ENCODINGS = ['rgb8', 'bgr8', 'mono8', 'mono16', 'bayer_rggb8', '16UC1', '32FC1', 'rgba8', '']
FORMATS = ['rgb8; jpeg compressed bgr8', '16UC1; compressedDepth png', '32FC1; compressedDepth']


class Bytes:
    """Numbers and text out of the fuzzer's bytes."""

    def __init__(self, data: bytes) -> None:
        self._data = data

    def take(self, count: int) -> bytes:
        """Give the next bytes, zeros behind the last."""
        taken, self._data = self._data[:count], self._data[count:]
        return taken.ljust(count, b'\0')

    def number(self, size: int) -> int:
        """Give a number of this many bytes."""
        return int.from_bytes(self.take(size), 'little')

    def floats(self, count: int) -> list[float]:
        """Give this many numbers; any, NaN too."""
        return [float(x) for x in np.frombuffer(self.take(8 * count), np.float64)]

    def rest(self) -> bytes:
        """Give all that is left."""
        return self._data


def image(data: bytes) -> None:
    """Read an Image whose fields need not fit together, as colour and as depth."""
    source = Bytes(data)
    message = SimpleNamespace(
        encoding=ENCODINGS[source.number(1) % len(ENCODINGS)],
        width=source.number(2),
        height=source.number(2),
        step=source.number(3),
        is_bigendian=source.number(1) % 2,
        data=source.rest(),
    )
    both(message)


def compressed(data: bytes) -> None:
    """Read a CompressedImage, as colour and as depth."""
    source = Bytes(data)
    form = FORMATS[source.number(1) % len(FORMATS)]
    both(SimpleNamespace(format=form, data=source.rest()))


def both(message: Any) -> None:
    """Read a message as colour and as depth; what comes out is what the solver may be given."""
    for read in (image_from_msg, depth_from_msg):
        try:
            found = read(message)
        except InputError:
            continue
        assert found.dtype == np.float32
        assert found.flags.c_contiguous
        if read is image_from_msg:
            assert found.size == 0 or (found.min() >= 0 and found.max() <= 1)
        else:
            assert found.ndim == 2
            assert not (found <= 0).any()
            assert not np.isinf(found).any()


def camera_info(data: bytes) -> None:
    """Read a CameraInfo."""
    source = Bytes(data)
    rectified = bool(source.number(1) % 2)
    roi = SimpleNamespace(
        x_offset=source.number(4),
        y_offset=source.number(4),
        width=source.number(2),
        height=source.number(2),
    )
    info = SimpleNamespace(
        width=source.number(2),
        height=source.number(2),
        binning_x=source.number(4),
        binning_y=source.number(4),
        roi=roi,
        distortion_model=['plumb_bob', 'equidistant', ''][source.number(1) % 3],
        k=source.floats(9),
        p=source.floats(12),
        d=source.floats(source.number(1) % 16),
    )
    camera = camera_from_msg(info, rectified=rectified)
    assert np.isfinite([camera.fx, camera.fy, camera.cx, camera.cy]).all()


def cdr(data: bytes) -> None:
    """Read the bytes of a message of each type that comes in."""
    for kind in (IMAGE, COMPRESSED, INFO, FLOAT):
        topic = Topic('/topic', kind, '', 'cdr', {})
        try:
            message = decoded(BagMessage(0, topic, data))
        except InputError:
            continue
        if kind in (IMAGE, COMPRESSED):
            both(message)
        elif kind == INFO:
            try:
                camera_from_msg(message)
            except InputError:
                continue


def bag(data: bytes) -> None:
    """Read a file of a bag to its end."""
    path = _file('fuzz.mcap', data)
    with BagReader(path) as reader:
        for message in reader.messages(reader.topics):
            try:
                decoded(message)
            except InputError:
                continue


def packed(data: bytes) -> None:
    """Read a packed file of a bag to its end."""
    with BagReader(_file('fuzz.mcap.zstd', data)) as reader:
        list(reader.messages(reader.topics))


def camera_json(data: bytes) -> None:
    """Read a camera.json."""
    read_camera(_file('camera.json', data))


def yaml(data: bytes) -> None:
    """Read a ROS parameter file."""
    params_from_mapping(read_params(_file('params.yaml', data)))


DECODERS: dict[str, Callable[[bytes], None]] = {
    f.__name__: f for f in (image, compressed, camera_info, cdr, bag, packed, camera_json, yaml)
}
_FOLDER = Path(tempfile.gettempdir()) / f'fuzz-{os.getpid()}'


def _file(name: str, data: bytes) -> Path:
    _FOLDER.mkdir(exist_ok=True)
    path = _FOLDER / name
    path.write_bytes(data)
    return path


def seeds(name: str) -> list[bytes]:
    """Give a few sound inputs."""
    picture = np.arange(48 * 64, dtype=np.uint16).reshape(48, 64)
    files = [
        cv2.imencode(kind, picture.astype(np.uint8))[1].tobytes() for kind in ('.png', '.jpg')
    ]
    deep = bytes(12) + cv2.imencode('.png', picture)[1].tobytes()
    header = header_fields(10**9, 'camera')
    k = [60.0, 0, 31.5, 0, 60.0, 23.5, 0, 0, 1.0]
    p = [*k[:3], 0, *k[3:6], 0, *k[6:], 0]
    calibrated = b'\1' + bytes(12) + struct.pack('<HH8xB21dB', 64, 48, 0, *k, *p, 0)
    camera = dict.fromkeys(['fx', 'fy', 'cx', 'cy'], 60.5) | {'width': 64, 'height': 48}
    told = {**camera, 'depth_scale': 5000, 'exposure': 0.02, 'transfer': 'srgb'}
    target = _FOLDER / 'seed'
    shutil.rmtree(target, ignore_errors=True)
    with BagWriter(target) as writer:
        small = picture[:2, :3].astype(np.float32) / np.float32(255)
        cdrs = [
            writer.write('/image', IMAGE, image_fields(small, header), 1),
            writer.write('/depth', IMAGE, depth_fields(small + 1, header), 2),
            writer.write('/jpeg', COMPRESSED, {'format': FORMATS[0], 'data': files[0]}, 3),
            writer.write('/info', INFO, {'width': 3, 'height': 2, 'k': range(9)}, 4),
            writer.write('/exposure', FLOAT, {'data': 0.5}, 5),
        ]
    whole = (target / 'seed.mcap').read_bytes()
    return {
        'image': [b'\0\3\0\2\0\x09\0\0\0' + bytes(18), b'\6\3\0\2\0\x0c\0\0\0' + bytes(24)],
        'compressed': [b'\0' + files[0], b'\0' + files[1], b'\1' + deep, b'\2' + deep],
        'camera_info': [bytes(200), calibrated],
        'cdr': cdrs,
        'bag': [whole, whole[: len(whole) // 2]],
        'packed': [zstandard.compress(whole)],
        'camera_json': [json.dumps(told).encode()],
        'yaml': [b'/**:\n  ros__parameters:\n    mode: fast\n    prior: 2.0\n'],
    }[name]


def decode(name: str, data: bytes) -> bool:
    """Decode; give whether it was taken. Whatever but an InputError comes out is a finding."""
    try:
        DECODERS[name](data)
    except InputError as error:
        assert '\n' not in str(error), 'an error has one line'
        return False
    return True


def one(name: str, data: bytes) -> None:
    """Decode, as the fuzzer wants it."""
    decode(name, data)


def main() -> int:
    """Fuzz one decoder."""
    if sys.argv[1:2] == ['--list'] or sys.argv[1:2] == []:
        print('\n'.join(DECODERS))
        return 0
    try:
        import atheris
    except ModuleNotFoundError:
        print("fuzz: skipped, atheris is not installed: pip install '.[fuzz]'")
        return 0
    name = sys.argv.pop(1)
    if name not in DECODERS:
        print(f'fuzz: {name!r} is none of {", ".join(DECODERS)}', file=sys.stderr)
        return 2
    for module in [m for n, m in sys.modules.items() if n.startswith('depth_deblur_ros')]:
        _instrument(atheris, module)
    _instrument(atheris, sys.modules['__main__'])
    atexit.register(shutil.rmtree, _FOLDER, ignore_errors=True)
    corpus = _FOLDER / 'corpus'
    corpus.mkdir(parents=True, exist_ok=True)
    for number, seed in enumerate(seeds(name)):
        (corpus / str(number)).write_bytes(seed)
    given = [word for word in sys.argv[1:] if not word.startswith('-')]
    atheris.Setup([*sys.argv, *([] if given else [str(corpus)])], lambda data: one(name, data))
    atheris.Fuzz()
    return 0


def _instrument(atheris: Any, module: Any) -> None:
    """Let the fuzzer see which lines of a module's functions run."""
    for name, found in list(vars(module).items()):
        if getattr(found, '__module__', None) != module.__name__:
            continue
        if isinstance(found, type(main)):
            setattr(module, name, atheris.instrument_func(found))
        elif isinstance(found, type):
            for member, function in list(vars(found).items()):
                if isinstance(function, type(main)) and not member.startswith('__'):
                    setattr(found, member, atheris.instrument_func(function))


if __name__ == '__main__':
    sys.exit(main())
