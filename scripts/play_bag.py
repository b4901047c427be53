"""
Play the frames of the sample bag in real time, stamped with the time at which they are sent.

usage: python scripts/play_bag.py [--frames N] [--rate HZ] [--bag BAG]; prints one line of JSON.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
import struct
import time
from typing import Any

from depth_deblur_ros.bag import BagReader
import rclpy
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float32

BAG = Path(__file__).resolve().parents[1] / 'bags/sample'
KINDS: dict[str, Any] = {
    '/camera/rgb/exposure': Float32,
    '/camera/rgb/camera_info': CameraInfo,
    '/camera/rgb/image_color': Image,
    '/camera/depth/image': Image,
}
REMAP = {
    'rgb/image_rect_color': '/camera/rgb/image_color',
    'depth_registered/image_rect': '/camera/depth/image',
    'rgb/camera_info': '/camera/rgb/camera_info',
    'exposure': '/camera/rgb/exposure',
}
PATIENCE_S = 60.0
STAMP = struct.Struct('<iI')  # begins every message with a header, after four bytes of CDR


def bag_frames(bag: Path = BAG) -> list[list[tuple[str, bytearray]]]:
    """Give the messages of each frame, one of a topic each: topic and serialised message."""
    frames: list[list[tuple[str, bytearray]]] = [[]]
    with BagReader(bag) as reader:
        for message in reader.messages(KINDS.keys()):
            if message.topic.name in {topic for topic, _ in frames[-1]}:
                frames.append([])
            frames[-1].append((message.topic.name, bytearray(message.data)))
    return frames


def play(node: Any, frames: int, rate: float, bag: Path = BAG) -> list[int]:
    """Send this many frames, the bag's over and over; give their stamps [ns]."""
    source = bag_frames(bag)
    there = {topic for frame in source for topic, _ in frame}
    publishers = {
        t: node.create_publisher(kind, t, QoSProfile(depth=10))
        for t, kind in KINDS.items()
        if t in there
    }
    patient = time.monotonic() + PATIENCE_S
    while not all(p.get_subscription_count() for p in publishers.values()):
        if time.monotonic() > patient:
            raise TimeoutError('nobody subscribes')
        time.sleep(0.02)
    time.sleep(0.3)  # for the other side to know, too
    stamps, begin = [], time.monotonic()
    for number in range(frames):
        time.sleep(max(0.0, begin + number / rate - time.monotonic()))
        stamps.append(time.time_ns())
        for topic, data in source[number % len(source)]:
            if KINDS[topic] is not Float32:
                STAMP.pack_into(data, 4, *divmod(stamps[-1], 1_000_000_000))
            publishers[topic].publish(bytes(data))
    time.sleep(1.0)  # for the last message to arrive
    return stamps


def main() -> None:
    """Play and say what was sent."""
    parser = argparse.ArgumentParser(description='Play the sample bag in real time.')
    parser.add_argument('--frames', type=int, default=300)
    parser.add_argument('--rate', type=float, default=30.0, metavar='HZ')
    parser.add_argument('--bag', type=Path, default=BAG)
    args = parser.parse_args()
    rclpy.init()
    node = rclpy.create_node('player')
    stamps = play(node, args.frames, args.rate, args.bag)
    print(json.dumps({'stamps': stamps}))
    node.destroy_node()
    rclpy.shutdown()


if __name__ == '__main__':
    main()
