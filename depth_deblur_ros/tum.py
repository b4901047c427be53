"""
Folders in the format of the TUM RGB-D benchmark, and their way into a rosbag2 bag.

rgb.txt and depth.txt list 'stamp file', an association file lists 'stamp file stamp file ...',
groundtruth.txt lists 'stamp tx ty tz qx qy qz qw' (the colour camera in the world); '#' begins a
comment. Stamps are seconds in decimal; here they are whole nanoseconds, exactly.
[SEEBC12] Sturm, Engelhard, Endres, Burgard & Cremers, IROS 2012.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
import math
from pathlib import Path
from typing import Any

from depth_deblur_ros.core.data import CameraIntrinsics, InputError
from depth_deblur_ros.folders import CameraFile, read_camera, read_depth, read_pixels
from depth_deblur_ros.messages import camera_info_fields, depth_fields, header_fields
import numpy as np

COLOUR_TOPIC, INFO_TOPIC = '/camera/rgb/image_color', '/camera/rgb/camera_info'
DEPTH_TOPIC, POSE_TOPIC = '/camera/depth/image', '/ground_truth/pose'
CAMERA_FRAME, WORLD_FRAME = 'openni_rgb_optical_frame', 'world'
DEPTH_SCALE = 5000.0  # stored values per metre
COLOUR_FOLDERS, DEPTH_FOLDERS = ('rgb', 'color'), ('depth',)
IMAGES = ('.png', '.jpg', '.jpeg')
MAX_STAMP_S = 2**31  # what builtin_interfaces/Time can hold

# The calibrations that the benchmark publishes: fx fy cx cy and plumb_bob distortion.
_PUBLISHED: dict[str, tuple[tuple[float, ...], tuple[float, ...] | None]] = {
    'tum_fr1': ((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    'tum_fr2': ((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    'tum_fr3': ((535.4, 539.2, 320.1, 247.6), None),
}
PRESETS = tuple(_PUBLISHED)

Stamped = dict[int, Path]  # stamp [ns] -> file
Message = tuple[str, str, dict[str, Any]]  # topic, type, fields


@dataclass(frozen=True)
class TumPair:
    """A colour image and its depth; a depth may serve several colour images."""

    rgb_ns: int
    rgb: Path
    depth_ns: int
    depth: Path


@dataclass(frozen=True)
class ImportSummary:
    """What went into a bag; regrouped: pairs of an association file that stamps do not tell."""

    colour: int
    depth: int
    poses: int
    regrouped: int

    def __str__(self) -> str:
        text = f'{self.colour} colour images, {self.depth} depth images, {self.poses} poses'
        if self.regrouped:
            text += f'; {self.regrouped} pairs are not nearest by stamp, replay pairs them anew'
        return text


def preset_camera(name: str) -> CameraFile:
    """Give a published calibration of the benchmark's cameras."""
    if name not in _PUBLISHED:
        raise InputError(f'preset must be one of {", ".join(PRESETS)}, got {name!r}')
    (fx, fy, cx, cy), distortion = _PUBLISHED[name]
    return CameraFile(CameraIntrinsics(fx, fy, cx, cy, 640, 480, distortion), DEPTH_SCALE, None)


def tum_camera(folder: Path, camera: Path | None = None, preset: str | None = None) -> CameraFile:
    """Read the camera given, else the folder's camera.json, else take the preset."""
    if camera is None and (folder / 'camera.json').is_file():
        camera = folder / 'camera.json'
    if camera is not None:
        return read_camera(camera)
    if preset is None:
        raise InputError(f'{folder} has no camera.json: name a camera file or a preset')
    return preset_camera(preset)


def tum_pairs(folder: Path) -> list[TumPair]:
    """List the pairs: the association file's, else each colour image with the nearest depth."""
    folder = Path(folder)
    if not _has_lists(folder) and (associations := _association_file(folder)):
        return _read_associations(associations)
    colour, depth = tum_images(folder)
    nearest = {stamp: _nearest(stamp, depth) for stamp in colour}
    return [TumPair(s, file, nearest[s], depth[nearest[s]]) for s, file in colour.items()]


def _nearest(stamp: int, others: Stamped) -> int:
    return min(others, key=lambda other: abs(other - stamp))


def tum_images(folder: Path) -> tuple[Stamped, Stamped]:
    """List the colour and the depth images of a folder, each once, by stamp."""
    if not folder.is_dir():
        raise InputError(f'{folder} is not a folder')
    if _has_lists(folder):
        colour = _once((s, f, 'rgb.txt') for s, f in _read_list(folder / 'rgb.txt'))
        depth = _once((s, f, 'depth.txt') for s, f in _read_list(folder / 'depth.txt'))
    elif associations := _association_file(folder):
        pairs = _read_associations(associations)
        colour = _once((p.rgb_ns, p.rgb, associations.name) for p in pairs)
        depth = _once((p.depth_ns, p.depth, associations.name) for p in pairs)
    else:
        colour, depth = (_named_by_stamp(folder, f) for f in (COLOUR_FOLDERS, DEPTH_FOLDERS))
    for kind, images in (('colour', colour), ('depth', depth)):
        if not images:
            raise InputError(f'{folder} lists no {kind} images')
    return colour, depth


def tum_poses(folder: Path) -> list[tuple[int, tuple[float, ...]]]:
    """Read groundtruth.txt, where there: stamp [ns] and (tx, ty, tz, qx, qy, qz, qw)."""
    path = folder / 'groundtruth.txt'
    return [_pose(where, words) for where, words in _rows(path, 8)] if path.is_file() else []


def import_tum(
    folder: Path,
    bag: Path,
    *,
    camera: Path | None = None,
    preset: str | None = None,
    overwrite: bool = False,
) -> ImportSummary:
    """Write each image and pose of a folder once into a bag, on the benchmark's topics."""
    from depth_deblur_ros.bag import BagWriter

    folder = Path(folder)
    colour, depth = tum_images(folder)
    poses = tum_poses(folder)
    lens = tum_camera(folder, camera, preset)
    entries: list[tuple[int, int, Any]] = []
    entries += [(stamp, 0, file) for stamp, file in colour.items()]
    entries += [(stamp, 1, file) for stamp, file in depth.items()]
    entries += [(stamp, 2, pose) for stamp, pose in poses]
    messages = (_colour_messages, _depth_messages, _pose_messages)
    with BagWriter(bag, overwrite=overwrite) as writer:
        for stamp, kind, what in sorted(entries, key=lambda entry: entry[:2]):
            for topic, type_name, fields in messages[kind](stamp, what, lens):
                writer.write(topic, type_name, fields, stamp)
    regrouped = sum(p.depth_ns != _nearest(p.rgb_ns, depth) for p in tum_pairs(folder))
    return ImportSummary(len(colour), len(depth), len(poses), regrouped)


def _colour_messages(stamp: int, file: Path, lens: CameraFile) -> list[Message]:
    header = header_fields(stamp, CAMERA_FRAME)
    pixels = read_pixels(file, lens.intrinsics)
    if pixels.dtype != np.uint8:
        raise InputError(f'{file} must hold 8 bit samples, got {pixels.dtype}')
    image = {
        'header': header,
        'height': pixels.shape[0],
        'width': pixels.shape[1],
        'encoding': 'rgb8' if pixels.ndim == 3 else 'mono8',
        'step': pixels.strides[0],
        'data': pixels.ravel(),
    }
    return [
        (INFO_TOPIC, 'sensor_msgs/msg/CameraInfo', camera_info_fields(lens.intrinsics, header)),
        (COLOUR_TOPIC, 'sensor_msgs/msg/Image', image),
    ]


def _depth_messages(stamp: int, file: Path, lens: CameraFile) -> list[Message]:
    depth = read_depth(file, lens.depth_scale, lens.intrinsics)
    fields = depth_fields(depth, header_fields(stamp, CAMERA_FRAME))
    return [(DEPTH_TOPIC, 'sensor_msgs/msg/Image', fields)]


def _pose_messages(stamp: int, pose: tuple[float, ...], _: CameraFile) -> list[Message]:
    position = dict(zip('xyz', pose[:3], strict=True))
    orientation = dict(zip('xyzw', pose[3:], strict=True))
    fields = {
        'header': header_fields(stamp, WORLD_FRAME),
        'pose': {'position': position, 'orientation': orientation},
    }
    return [(POSE_TOPIC, 'geometry_msgs/msg/PoseStamped', fields)]


def _has_lists(folder: Path) -> bool:
    return (folder / 'rgb.txt').is_file() and (folder / 'depth.txt').is_file()


def _association_file(folder: Path) -> Path | None:
    found = sorted(folder.glob('assoc*.txt'))
    if len(found) > 1:
        names = ', '.join(path.name for path in found)
        raise InputError(f'{folder} has more than one association file: {names}')
    return found[0] if found else None


def _read_list(path: Path) -> Iterator[tuple[int, Path]]:
    for where, words in _rows(path, 2):
        yield _stamp_ns(words[0], where), path.parent / words[1]


def _read_associations(path: Path) -> list[TumPair]:
    folder, pairs = path.parent, []
    for where, (rgb_time, rgb, depth_time, depth, *_) in _rows(path, 4):
        stamps = _stamp_ns(rgb_time, where), _stamp_ns(depth_time, where)
        pairs.append(TumPair(stamps[0], folder / rgb, stamps[1], folder / depth))
    return sorted(pairs, key=lambda pair: pair.rgb_ns)


def _named_by_stamp(folder: Path, names: tuple[str, ...]) -> Stamped:
    for name in names:
        if (folder / name).is_dir():
            files = sorted(f for f in (folder / name).iterdir() if f.suffix.lower() in IMAGES)
            return _once((_stamp_ns(f.stem, f'{f}: its name'), f, name) for f in files)
    raise InputError(f'{folder} has neither lists nor a folder {" or ".join(names)}')


def _once(images: Iterator[tuple[int, Path, str]]) -> Stamped:
    """Order by stamp; refuse two files at one stamp."""
    found: Stamped = {}
    for stamp, file, where in images:
        if found.setdefault(stamp, file) != file:
            raise InputError(f'{where} has two files at {stamp} ns: {found[stamp]} and {file}')
    return dict(sorted(found.items()))


def _rows(path: Path, columns: int) -> Iterator[tuple[str, list[str]]]:
    """Give place and words of each line that is no comment."""
    try:
        lines = path.read_text().splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f'cannot read {path}: {error}') from error
    for number, line in enumerate(lines, 1):
        words = line.replace(',', ' ').split()
        if words and not words[0].startswith('#'):
            if len(words) < columns:
                raise InputError(f'{path}:{number} must have {columns} columns, got {line!r}')
            yield f'{path}:{number}', words


def _stamp_ns(text: str, where: str) -> int:
    try:
        seconds = Decimal(text)
    except InvalidOperation:
        raise InputError(f'{where} must be a stamp in seconds, got {text!r}') from None
    if not seconds.is_finite() or not 0 <= seconds < MAX_STAMP_S:
        raise InputError(f'{where} must be a stamp in [0, {MAX_STAMP_S}) s, got {text}')
    return int((seconds * 1_000_000_000).to_integral_value())


def _pose(where: str, words: list[str]) -> tuple[int, tuple[float, ...]]:
    try:
        values = tuple(float(word) for word in words[1:8])
    except ValueError:
        raise InputError(f'{where} must hold numbers, got {" ".join(words)}') from None
    if not all(math.isfinite(value) for value in values):
        raise InputError(f'{where} must be finite, got {" ".join(words)}')
    return _stamp_ns(words[0], where), values
