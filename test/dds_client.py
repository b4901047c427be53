"""
A client of the live node on another DDS than ROS's, Eclipse Cyclone DDS: images in, results out.

usage: python dds_client.py FRAMES WIDTH HEIGHT; prints one line of JSON. Knows of ROS only the
names and the layouts of its messages.
"""

from dataclasses import dataclass
import json
import os
import sys
import time

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import array, float64, int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

WIDTH, HEIGHT = int(sys.argv[2]), int(sys.argv[3])


@dataclass
class Time(IdlStruct, typename='builtin_interfaces::msg::dds_::Time_'):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename='std_msgs::msg::dds_::Header_'):
    stamp: Time
    frame_id: str


@dataclass
class Image(IdlStruct, typename='sensor_msgs::msg::dds_::Image_'):
    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: sequence[uint8]


@dataclass
class Region(IdlStruct, typename='sensor_msgs::msg::dds_::RegionOfInterest_'):
    x_offset: uint32
    y_offset: uint32
    height: uint32
    width: uint32
    do_rectify: bool


@dataclass
class CameraInfo(IdlStruct, typename='sensor_msgs::msg::dds_::CameraInfo_'):
    header: Header
    height: uint32
    width: uint32
    distortion_model: str
    d: sequence[float64]
    k: array[float64, 9]
    r: array[float64, 9]
    p: array[float64, 12]
    binning_x: uint32
    binning_y: uint32
    roi: Region


@dataclass
class Vector3(IdlStruct, typename='geometry_msgs::msg::dds_::Vector3_'):
    x: float64
    y: float64
    z: float64


@dataclass
class Twist(IdlStruct, typename='geometry_msgs::msg::dds_::Twist_'):
    linear: Vector3
    angular: Vector3


@dataclass
class TwistStamped(IdlStruct, typename='geometry_msgs::msg::dds_::TwistStamped_'):
    header: Header
    twist: Twist


def quality(reliable):
    """Give the QoS of a ROS topic; Cyclone drops nothing while the other side keeps up."""
    kind = Policy.Reliability.Reliable(duration(seconds=1)) if reliable else None
    return Qos(kind or Policy.Reliability.BestEffort, Policy.History.KeepLast(10))


def messages(number):
    """Give camera_info, colour and depth of one frame."""
    header = Header(Time(1_700_000_000 + number, 0), 'camera')
    k = [WIDTH, 0.0, WIDTH / 2, 0.0, WIDTH, HEIGHT / 2, 0.0, 0.0, 1.0]
    p = [*k[:3], 0.0, *k[3:6], 0.0, *k[6:], 0.0]
    none = Region(0, 0, 0, 0, False)
    info = CameraInfo(header, HEIGHT, WIDTH, 'plumb_bob', [0.0] * 5, k, k, p, 0, 0, none)
    grey = bytes([10 + number]) * (3 * WIDTH * HEIGHT)
    colour = Image(header, HEIGHT, WIDTH, 'rgb8', 0, 3 * WIDTH, grey)
    metres = (2000).to_bytes(2, 'little') * (WIDTH * HEIGHT)
    return info, colour, Image(header, HEIGHT, WIDTH, '16UC1', 0, 2 * WIDTH, metres)


def exchange(writers, readers, number, patience):
    """Send one frame; give what each reader has got when all have got something."""
    for writer, message in zip(writers, messages(number), strict=True):
        writer.write(message)
    got = [[] for _ in readers]
    end = time.monotonic() + patience
    while time.monotonic() < end and not all(got):
        got = [found + reader.take(10) for found, reader in zip(got, readers, strict=True)]
        time.sleep(0.005)
    return got


def main():
    """Send frames one by one, each until its results have come."""
    frames = int(sys.argv[1])
    peer = DomainParticipant(int(os.environ['ROS_DOMAIN_ID']))
    kinds = {'rgb/camera_info': CameraInfo, 'rgb/image_rect_color': Image}
    kinds['depth_registered/image_rect'] = Image
    writers = [
        DataWriter(peer, Topic(peer, f'rt/{name}', kind), qos=quality(True))
        for name, kind in kinds.items()
    ]
    images = DataReader(peer, Topic(peer, 'rt/deblurred/image', Image), qos=quality(True))
    twists = DataReader(peer, Topic(peer, 'rt/motion', TwistStamped), qos=quality(True))
    patient = time.monotonic() + 30
    while not (
        all(w.get_matched_subscriptions() for w in writers)
        and all(r.get_matched_publications() for r in (images, twists))
    ):
        assert time.monotonic() < patient, 'the node is not there'
        time.sleep(0.1)
    time.sleep(1)
    for number in range(-5, 0):  # until both sides have met; what is sent earlier may be lost
        if all(exchange(writers, (images, twists), number, patience=3)):
            break
    seen, moved = [], []
    for number in range(frames):
        pictures, motions = exchange(writers, (images, twists), number, patience=5)
        seen += [(m.header.stamp.sec, m.data[0], len(m.data)) for m in pictures]
        moved += [(m.header.stamp.sec, m.twist.angular.z) for m in motions]
    sys.stdout.write(json.dumps({'images': seen, 'twists': moved}) + '\n')


if __name__ == '__main__':
    main()
