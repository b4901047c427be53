"""
Make bags of blurred streams with known motion, exposure and gyro: hand-held and driven cameras.

usage: python scripts/make_streams.py FOLDER [NAME ...] [--frames N] [--seed N]

Each bag holds the topics of make_sample_bag.py but the exposure, which changes in steps between 30
and 90 % of the frame interval and is not told, and a gyro. Truth stands on /ground_truth topics.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from depth_deblur_ros.bag import BagWriter
from depth_deblur_ros.core.data import CameraIntrinsics
from depth_deblur_ros.messages import camera_info_fields, header_fields
from make_sample_bag import FRAME_ID, picture_fields, SampleFrame, START_NS, twist_fields
import numpy as np
import numpy.typing as npt
from scene import make_scene, Scene
from sensor import depth_picture, photograph
from shake import driven, hand_held, render_blurred, Trajectory, true_motion

CAMERA = CameraIntrinsics(262.5, 262.5, 159.5, 119.5, 320, 240)
RATE, FRAMES = 30, 60  # Hz
LEAST_VIEWS = 9
SHARES = (0.5, 0.8, 0.35, 0.9, 0.6, 0.3)  # exposure over frame interval; each for 20 frames
HELD = 20  # frames

GYRO_RATE = 200  # Hz
GYRO_NOISE = 0.003  # rad/s per sample
GYRO_BIAS = np.array([0.012, -0.008, 0.005])  # rad/s
GYRO_LAG = 0.005  # s
Fields = dict[str, Any]


@dataclass(frozen=True, eq=False)
class Stream:
    """What is filmed: a room, a path, and where in SHARES the exposure starts."""

    scene_seed: int
    path: Trajectory
    first_share: int

    def exposure(self, number: int) -> float:
        """Give a frame's exposure [s]."""
        return SHARES[(self.first_share + number // HELD) % len(SHARES)] / RATE


APART = 100  # between the seeds of one set of streams and the next


def streams(seed: int) -> dict[str, Stream]:
    """Give the streams by name; other seeds give other rooms and paths of the same kinds."""
    other = APART * seed
    return {
        'hand1': Stream(3 + other, hand_held(seed=27 + other, turn=1.1, speed=0.4), 0),
        'hand2': Stream(5 + other, hand_held(seed=31 + other, turn=0.7, speed=0.5), 2),
        'hand3': Stream(8 + other, hand_held(seed=35 + other, turn=1.6, speed=0.3), 4),
        'robot1': Stream(4 + other, driven(seed=1 + other, turn=0.8, speed=0.6), 1),
        'robot2': Stream(6 + other, driven(seed=2 + other, turn=1.2, speed=0.4), 3),
        'robot3': Stream(7 + other, driven(seed=3 + other, turn=0.5, speed=0.8), 5),
    }


def stamp_of(time: float) -> int:
    """Give the stamp [ns] of a time on the path [s]."""
    return START_NS + round(1e9 * time)


def gyro_samples(path: Trajectory, until: float) -> Iterator[tuple[float, npt.NDArray[Any]]]:
    """Give stamp [s] and angular velocity (3,) [rad/s] of the camera as a cheap gyro tells it."""
    rng = np.random.default_rng(0)
    step = 1 / GYRO_RATE
    for number in range(round(until * GYRO_RATE)):
        time = number * step
        rate = -true_motion(path, time - GYRO_LAG, step).theta / step
        yield time, rate + GYRO_BIAS + rng.normal(0, GYRO_NOISE, 3)


def write_gyro(bag: BagWriter, path: Trajectory, until: float) -> None:
    """Write the gyro's messages up to a time on the path [s]."""
    for time, rate in gyro_samples(path, until):
        header = header_fields(stamp_of(time), FRAME_ID)
        angular = dict(zip('xyz', rate.tolist(), strict=True))
        fields = {'header': header, 'angular_velocity': angular}
        bag.write('/imu/data', 'sensor_msgs/msg/Imu', fields, stamp_of(time))


@dataclass(frozen=True, eq=False)
class Shot(SampleFrame):
    """One frame as the sensors give it, what is true of it, and for how long it was taken."""

    exposure: float  # s


def write_shot(bag: BagWriter, shot: Shot) -> None:
    """Write the messages of one frame."""
    header = header_fields(shot.stamp_ns, FRAME_ID)
    for topic, kind, fields in (
        ('/camera/rgb/camera_info', 'CameraInfo', camera_info_fields(CAMERA, header)),
        ('/camera/rgb/image_color', 'Image', picture_fields(shot.colour, 'rgb8', header)),
        ('/camera/depth/image', 'Image', picture_fields(shot.depth, '16UC1', header)),
    ):
        bag.write(topic, f'sensor_msgs/msg/{kind}', fields, shot.stamp_ns)
    twist = {'header': header, 'twist': twist_fields(shot.motion, shot.exposure)}
    bag.write('/ground_truth/motion', 'geometry_msgs/msg/TwistStamped', twist, shot.stamp_ns)
    told = {'data': shot.exposure}
    bag.write('/ground_truth/exposure', 'std_msgs/msg/Float32', told, shot.stamp_ns)


def rendered(stream: Stream, scene: Scene, number: int) -> Shot:
    """Render one frame."""
    rng = np.random.default_rng([0, number])
    middle, exposure = number / RATE, stream.exposure(number)
    pose = stream.path.pose(middle)
    light = render_blurred(scene, CAMERA, stream.path, middle, exposure, least=LEAST_VIEWS)
    colour = photograph(light, rng)
    depth = depth_picture(scene.depth(CAMERA, pose), scene.light(CAMERA, pose), rng)
    motion = true_motion(stream.path, middle, exposure)
    return Shot(stamp_of(middle), colour, depth, motion, exposure)


def main() -> None:
    """Write the bags."""
    parser = argparse.ArgumentParser(description='Make bags of blurred streams with known motion.')
    parser.add_argument('folder', type=Path)
    parser.add_argument('names', nargs='*', metavar='NAME', help=', '.join(streams(0)))
    parser.add_argument('--frames', type=int, default=FRAMES)
    parser.add_argument('--seed', type=int, default=0, help='of other rooms and paths')
    args = parser.parse_args()
    known = streams(args.seed)
    for name in set(args.names) - set(known):
        parser.error(f'{name} is none of {", ".join(known)}')
    for name in args.names or known:
        stream = known[name]
        scene = make_scene(stream.scene_seed)
        with BagWriter(args.folder / name) as bag:
            write_gyro(bag, stream.path, args.frames / RATE)
            for number in range(args.frames):
                write_shot(bag, rendered(stream, scene, number))
        print(f'{args.folder / name}: {args.frames} frames')


if __name__ == '__main__':
    main()
