"""
Break the bags of make_streams.py off for a second, in each of some ways.

usage: python scripts/break_streams.py STREAMS OUT [--kinds KIND ...] [--seed N]

gap: the second is missing. back: then come frames that are a second older. static: the camera
stands still. dark: a black picture without depth. hidden: a picture of one colour, with depth.
The last AFTER frames of each bag are those after the break. plain is no break: the whole stream
with pictures of one colour, with the depth and the gyro that it has.
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from depth_deblur_ros.bag import BagReader, BagWriter, decoded
from depth_deblur_ros.core.data import Motion
from depth_deblur_ros.mcap_file import BagMessage
from make_streams import CAMERA, RATE, Shot, stamp_of, Stream, streams, write_gyro, write_shot
import numpy as np
from play_bag import STAMP
from scene import make_scene
from sensor import depth_picture, photograph
from shake import true_motion

BEFORE, BREAK, AFTER = 20, 30, 10  # frames
KINDS = ('gap', 'back', 'static', 'dark', 'hidden')
PLAIN = 'plain'
GREY = 0.2  # light of what covers the lens in one colour
WITHOUT_HEADER = '/ground_truth/exposure'
Frame = list[BagMessage]


@dataclass(frozen=True, eq=False)
class Source:
    """A stream that was made, and its frames as they stand in the bag."""

    stream: Stream
    frames: list[Frame]


def frames_of(bag: Path) -> list[Frame]:
    """Give the messages of each frame of a bag, without the gyro's."""
    found: dict[int, Frame] = defaultdict(list)
    with BagReader(bag) as reader:
        for message in reader.messages(set(reader.topics) - {'/imu/data'}):
            found[message.log_ns].append(message)
    return [found[log_ns] for log_ns in sorted(found)]


def copy(bag: BagWriter, frame: Frame, log_ns: int, stamp_ns: int | None = None) -> None:
    """Write a frame at another time, and with another stamp where one is given."""
    for message in frame:
        data = bytearray(message.data)
        if stamp_ns is not None and message.topic.name != WITHOUT_HEADER:
            STAMP.pack_into(data, 4, *divmod(stamp_ns, 1_000_000_000))
        bag.write_bytes(message.topic.name, message.topic.type, bytes(data), log_ns)


def standing(source: Source, kind: str) -> Iterator[Shot]:
    """Give what the camera sees during a break in which frames go on."""
    scene, pose = make_scene(source.stream.scene_seed), source.stream.path.pose(BEFORE / RATE)
    light, view = scene.light(CAMERA, pose), scene.depth(CAMERA, pose)
    still = Motion(np.zeros(3), np.zeros(3))
    for number in range(BEFORE, BEFORE + BREAK):
        rng = np.random.default_rng([1, number])
        shown = {'dark': np.zeros_like(light), 'hidden': np.full_like(light, GREY)}
        depth = depth_picture(view, light, rng)
        yield Shot(
            stamp_of(number / RATE),
            photograph(shown.get(kind, light), rng),
            np.zeros_like(depth) if kind == 'dark' else depth,
            still,
            source.stream.exposure(number),
        )


def write_plain(bag: BagWriter, source: Source) -> None:
    """Write the stream as it is where nothing has texture."""
    stream, grey = source.stream, np.full((CAMERA.height, CAMERA.width, 3), GREY, np.float32)
    write_gyro(bag, stream.path, len(source.frames) / RATE)
    for number, frame in enumerate(source.frames):
        (depth,) = (decoded(m) for m in frame if m.topic.name == '/camera/depth/image')
        write_shot(
            bag,
            Shot(
                stamp_of(number / RATE),
                photograph(grey, np.random.default_rng([2, number])),
                np.frombuffer(bytes(depth.data), np.uint16).reshape(grey.shape[:2]),
                true_motion(stream.path, number / RATE, stream.exposure(number)),
                stream.exposure(number),
            ),
        )


def write_broken(bag: BagWriter, source: Source, kind: str) -> None:
    """Write one broken bag."""
    if kind == PLAIN:
        write_plain(bag, source)
        return
    frames, whole = source.frames, BEFORE + BREAK
    if kind == 'back':
        order = [*range(whole - BEFORE, whole), *range(AFTER)]
        for place, number in enumerate(order):
            copy(bag, frames[number], stamp_of(place / RATE))
        return
    for number in range(BEFORE):
        copy(bag, frames[number], stamp_of(number / RATE))
    if kind != 'gap':
        for shot in standing(source, kind):
            write_shot(bag, shot)
    for number in range(whole, whole + AFTER):
        stamp = stamp_of(number / RATE)
        # Who stood still goes on from where he was.
        copy(bag, frames[number - BREAK * (kind == 'static')], stamp, stamp)


def main() -> None:
    """Write the bags."""
    parser = argparse.ArgumentParser(description='Break streams off for a second.')
    parser.add_argument('streams', type=Path)
    parser.add_argument('out', type=Path)
    parser.add_argument('--kinds', nargs='*', choices=(*KINDS, PLAIN), default=KINDS)
    parser.add_argument('--seed', type=int, default=0, help='that the streams were made with')
    args = parser.parse_args()
    for name, stream in streams(args.seed).items():
        if (args.streams / name).exists():
            source = Source(stream, frames_of(args.streams / name))
            for kind in args.kinds:
                with BagWriter(args.out / f'{name}-{kind}') as bag:
                    write_broken(bag, source, kind)
            print(f'{name}: {", ".join(args.kinds)}')


if __name__ == '__main__':
    main()
