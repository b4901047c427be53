"""
Make the sample bag: what a hand-held RGB-D camera sees of a rendered room, and its true motion.

usage: python scripts/make_sample_bag.py bags/sample [--overwrite] [--pictures DIR]
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
from depth_deblur_ros.bag import BagWriter
from depth_deblur_ros.core.data import CameraIntrinsics, Motion
from depth_deblur_ros.messages import camera_info_fields, header_fields
import numpy as np
import numpy.typing as npt
from scene import make_scene
from sensor import depth_picture, photograph
from shake import hand_held, render_blurred, true_motion

CAMERA = CameraIntrinsics(525.0, 525.0, 319.5, 239.5, 640, 480)
PATH = hand_held(seed=27, turn=1.1, speed=0.4)
SCENE_SEED, NOISE_SEED = 3, 0
FRAMES, RATE, EXPOSURE = 10, 30, 0.02  # Hz, s
START_NS = 1_700_000_000_000_000_000
Fields = dict[str, Any]

FRAME_ID = 'camera_rgb_optical_frame'


@dataclass(frozen=True, eq=False)
class SampleFrame:
    """One frame as the sensors give it."""

    stamp_ns: int  # mid-exposure
    colour: npt.NDArray[np.uint8]  # (H, W, 3) RGB
    depth: npt.NDArray[np.uint16]  # (H, W), millimetres, 0 = hole
    motion: Motion


def middle_of(number: int) -> float:
    """Give the time [s] of a frame's mid-exposure on the path."""
    return number / RATE


def stamp_of(number: int) -> int:
    """Give a frame's stamp [ns]."""
    return START_NS + round(1_000_000_000 * number / RATE)


def render_frames() -> Iterator[SampleFrame]:
    """Render the frames one by one."""
    scene = make_scene(SCENE_SEED)
    for number in range(FRAMES):
        rng = np.random.default_rng([NOISE_SEED, number])
        middle = middle_of(number)
        pose = PATH.pose(middle)
        colour = photograph(render_blurred(scene, CAMERA, PATH, middle, EXPOSURE), rng)
        depth = depth_picture(scene.depth(CAMERA, pose), scene.light(CAMERA, pose), rng)
        motion = true_motion(PATH, middle, EXPOSURE)
        yield SampleFrame(stamp_of(number), colour, depth, motion)


def twist_fields(motion: Motion, exposure: float = EXPOSURE) -> Fields:
    """Give the geometry_msgs/Twist of the camera's own velocity in its optical frame."""
    linear, angular = -motion.v / exposure, -motion.theta / exposure
    return {
        'linear': dict(zip('xyz', linear.tolist(), strict=True)),
        'angular': dict(zip('xyz', angular.tolist(), strict=True)),
    }


def picture_fields(pixels: npt.NDArray[Any], encoding: str, header: Fields) -> Fields:
    """Give the fields of a sensor_msgs/Image."""
    size = {'height': pixels.shape[0], 'width': pixels.shape[1], 'step': pixels.strides[0]}
    return {'header': header, **size, 'encoding': encoding, 'data': pixels.tobytes()}


def write_frame(bag: BagWriter, frame: SampleFrame) -> None:
    """Write the messages of one frame; its exposure comes before it, as from a camera driver."""
    header = header_fields(frame.stamp_ns, FRAME_ID)
    info = camera_info_fields(CAMERA, header)
    colour = picture_fields(frame.colour, 'rgb8', header)
    depth = picture_fields(frame.depth, '16UC1', header)
    truth = {'header': header, 'twist': twist_fields(frame.motion)}
    opened = frame.stamp_ns - round(EXPOSURE * 5e8)
    bag.write('/camera/rgb/exposure', 'std_msgs/msg/Float32', {'data': EXPOSURE}, opened)
    bag.write('/camera/rgb/camera_info', 'sensor_msgs/msg/CameraInfo', info, frame.stamp_ns)
    bag.write('/camera/rgb/image_color', 'sensor_msgs/msg/Image', colour, frame.stamp_ns)
    bag.write('/camera/depth/image', 'sensor_msgs/msg/Image', depth, frame.stamp_ns)
    bag.write('/ground_truth/motion', 'geometry_msgs/msg/TwistStamped', truth, frame.stamp_ns)


def main() -> None:
    """Write the bag, and the frames as pictures where asked for."""
    parser = argparse.ArgumentParser(description='Make the sample bag.')
    parser.add_argument('bag', type=Path)
    parser.add_argument('--overwrite', action='store_true', help='replace the bag if it is there')
    parser.add_argument('--pictures', type=Path, metavar='DIR', help='write the frames as PNG too')
    args = parser.parse_args()
    with BagWriter(args.bag, overwrite=args.overwrite) as bag:
        for number, frame in enumerate(render_frames()):
            write_frame(bag, frame)
            if args.pictures:
                args.pictures.mkdir(parents=True, exist_ok=True)
                cv2.imwrite(str(args.pictures / f'rgb{number}.png'), frame.colour[..., ::-1])
                cv2.imwrite(str(args.pictures / f'depth{number}.png'), frame.depth)
            print(f'frame {number}: {(frame.depth == 0).mean():.0%} holes')


if __name__ == '__main__':
    main()
