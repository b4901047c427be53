"""Processes and a ROS peer for the tests of the live node; all traffic stays on loopback."""

from collections import defaultdict
import itertools
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from depth_deblur_ros.core.data import CameraIntrinsics
from depth_deblur_ros.messages import (
    camera_info_fields,
    depth_fields,
    filled,
    header_fields,
    image_fields,
)
from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from sensor_msgs.msg import CameraInfo, Image

ROOT = Path(__file__).resolve().parents[1]
PROFILE = ROOT / 'config/fastdds.xml'
STUB = (sys.executable, str(ROOT / 'test/stub_node.py'))
NODE = (
    sys.executable,
    '-c',
    'import sys; from depth_deblur_ros.deblur_node import main; sys.exit(main())',
)
CAMERA = CameraIntrinsics(60.0, 60.0, 31.5, 23.5, 64, 48)
COLOUR, DEPTH, INFO = 'rgb/image_rect_color', 'depth_registered/image_rect', 'rgb/camera_info'
_DOMAINS = itertools.count(os.getpid())


def private_domain(monkeypatch):
    """Keep this test's traffic to itself and to this machine."""
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    monkeypatch.setenv('ROS_DOMAIN_ID', str(1 + next(_DOMAINS) % 100))
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', str(PROFILE))


class Process:
    """A process in a group of its own, with what it says."""

    def __init__(self, command, log, **environment):
        self.log = log
        with open(log, 'w') as file:
            self.process = subprocess.Popen(
                [str(word) for word in command],
                stdout=file,
                stderr=subprocess.STDOUT,
                env={**os.environ, **environment},
                start_new_session=True,
            )

    @property
    def pid(self):
        return self.process.pid

    def stop(self, number=signal.SIGINT, timeout=60):
        """Send a signal to the group and give the exit code."""
        if self.process.poll() is None:
            os.killpg(self.pid, number)
        return self.wait(timeout)

    def wait(self, timeout=60):
        return self.process.wait(timeout)

    def kill(self):
        if self.process.poll() is None:
            os.killpg(self.pid, signal.SIGKILL)
            self.process.wait(10)

    def text(self):
        return Path(self.log).read_text()

    def json(self):
        return json.loads(self.text().splitlines()[-1])


class Peer:
    """A node of our own in this process: publishes, listens, calls; spins only while it waits."""

    def __init__(self):
        self.context = rclpy.Context()
        rclpy.init(context=self.context)
        self.node = rclpy.create_node('peer', context=self.context)
        self._executor = SingleThreadedExecutor(context=self.context)
        self._executor.add_node(self.node)
        self.heard = defaultdict(list)
        self._publishers = {}
        self.listen(DiagnosticArray, '/diagnostics')

    def close(self):
        self._executor.shutdown()
        self.node.destroy_node()
        rclpy.shutdown(context=self.context)

    def listen(self, kind, topic, qos=10):
        self.node.create_subscription(kind, topic, self.heard[topic].append, qos)
        return self.heard[topic]

    def until(self, condition, timeout=30.0):
        """Spin until something holds; fail after the time."""
        end = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < end, f'not within {timeout} s; last: {self.status()}'
            self._executor.spin_once(timeout_sec=0.05)

    def spin(self, seconds):
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self._executor.spin_once(timeout_sec=0.05)

    def status(self):
        """Give the node's newest line and values."""
        heard = self.heard['/diagnostics']
        if not heard:
            return '', {}
        status = heard[-1].status[0]
        return status.message, {entry.key: entry.value for entry in status.values}

    def settled(self, published=None, arrived=None, timeout=30.0):
        """Wait for a status with these counts in which nothing waits any more; give its values."""
        self.heard['/diagnostics'].clear()  # an old one may be settled, too
        wanted = {'published': published, 'arrived': arrived, 'waiting': 0}

        def holds():
            values = self.status()[1]
            return values and all(
                want is None or values[name] == str(want) for name, want in wanted.items()
            )

        self.until(holds, timeout)
        return self.status()[1]

    def advertise(self, kinds, qos=10):
        """Publish on these topics; wait for whoever listens, and for him to know."""
        new = [topic for topic in kinds if topic not in self._publishers]
        for topic in new:
            self._publishers[topic] = self.node.create_publisher(kinds[topic], topic, qos)
        self.until(lambda: all(self._publishers[t].get_subscription_count() for t in new))
        if new:
            self.spin(0.7)

    def send(self, topic, kind, message, qos=10):
        self.advertise({topic: kind}, qos)
        self._publishers[topic].publish(message)

    def send_frame(self, stamp, *, image=None, depth=None, info=True, names=(COLOUR, DEPTH, INFO)):
        """Publish camera_info, colour and depth of one stamp [ns]."""
        self.advertise(dict(zip(names, (Image, Image, CameraInfo), strict=True)))
        header = header_fields(stamp, 'camera_optical_frame')
        if info:
            fields = camera_info_fields(CAMERA, header)
            self.send(names[2], CameraInfo, filled(CameraInfo(), fields))
        self.send(names[0], Image, colour_message(stamp, image))
        self.send(names[1], Image, depth_message(stamp, depth))

    def call(self, kind, service, request, timeout=30.0):
        client = self.node.create_client(kind, service)
        self.until(client.service_is_ready, timeout)
        future = client.call_async(request)
        self.until(future.done, timeout)
        self.node.destroy_client(client)
        return future.result()


def colour_message(stamp, image=None):
    if image is None:
        image = np.full((48, 64, 3), 0.25, np.float32)
    header = header_fields(stamp, 'camera_optical_frame')
    return filled(Image(), image_fields(image, header))


def depth_message(stamp, depth=None):
    if depth is None:
        depth = np.full((48, 64), 2, np.float32)
    return filled(Image(), depth_fields(depth, header_fields(stamp, 'camera_optical_frame')))


def total_dropped(values):
    return sum(int(n) for key, n in values.items() if key.startswith('dropped: '))


def assert_all_accounted(values):
    """What arrived was published, dropped for a reason that is named, or still waits."""
    assert int(values['dropped']) == total_dropped(values)
    known = int(values['published']) + int(values['dropped']) + int(values['waiting'])
    assert int(values['arrived']) == known
    assert values['arrived'] == values['colour arrived']


def qos(reliability, depth=10):
    return QoSProfile(depth=depth, reliability=reliability)
