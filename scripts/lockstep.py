"""
A bag through the live node over DDS, frame by frame: each is sent when the last has its result.

So nothing is dropped, whatever the machine has to do. The traffic stays on this machine.
"""

from __future__ import annotations

from collections import defaultdict
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time
from typing import Any

from bench_node import private_environment
from depth_deblur_ros.bag import BagReader
from depth_deblur_ros.mcap_file import BagMessage
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped
import play_bag
import rclpy
from sensor_msgs.msg import Imu

IMU = '/imu/data'
KINDS = {IMU: Imu, **{t: k for t, k in play_bag.KINDS.items() if not t.endswith('exposure')}}
READY_S, PATIENCE_S = 120.0, 20.0
Record = dict[str, Any]


class Player:
    """Sends the frames of a bag and hears what the node says of each."""

    def __init__(self) -> None:
        self.node = rclpy.create_node('player')
        self._send = {t: self.node.create_publisher(k, t, 20) for t, k in KINDS.items()}
        self._moves: list[Any] = []
        self._results: list[Any] = []
        self._begun = False  # before the first result, the node prepares itself
        self.node.create_subscription(TwistStamped, 'displacement', self._moves.append, 10)
        self.node.create_subscription(DiagnosticStatus, 'result', self._results.append, 10)

    def meet(self) -> None:
        """Wait for the node to listen and to be heard."""
        end = time.monotonic() + READY_S
        heard = ('displacement', 'result')
        while not (
            all(p.get_subscription_count() for p in self._send.values())
            and all(self.node.count_publishers(topic) for topic in heard)
        ):
            if time.monotonic() > end:
                raise TimeoutError('the node is not there')
            rclpy.spin_once(self.node, timeout_sec=0.05)
        time.sleep(1.0)  # for the other side to know, too

    def exchange(self, messages: list[BagMessage]) -> Record:
        """Send one frame, and what came before it; give what the node says of it."""
        self._moves.clear()
        self._results.clear()
        for message in messages:
            self._send[message.topic.name].publish(message.data)
        end = time.monotonic() + (PATIENCE_S if self._begun else READY_S)
        while not (self._moves and self._results) and time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.05)
        if not (self._moves and self._results):
            raise TimeoutError('a frame had no result')
        self._begun = True
        return record_of(self._moves[-1], self._results[-1])


def record_of(move: TwistStamped, result: DiagnosticStatus) -> Record:
    """Give what an estimates file would say."""
    values = {entry.key: entry.value for entry in result.values}
    turn, shift = move.twist.angular, move.twist.linear
    return {
        'theta': [-turn.x, -turn.y, -turn.z],
        'v': [-shift.x, -shift.y, -shift.z],
        'exposure': float(values['exposure']) if 'exposure' in values else None,
        'sign_resolved': values['sign_resolved'] == 'true',
    }


def frames_of(bag: Path, imu: bool) -> list[list[BagMessage]]:
    """Give the messages of each frame of a bag, each gyro reading with the frame that follows."""
    frames, waiting = defaultdict(list), []
    with BagReader(bag) as reader:
        for message in reader.messages(KINDS.keys() - (set() if imu else {IMU})):
            if message.topic.name == IMU:
                waiting.append(message)
                continue
            frames[message.log_ns] += [*waiting, message]
            waiting = []
    return list(frames.values())


def live(bag: Path, mode: str, imu: bool) -> list[Record]:
    """Give what the live node says of each frame of a bag, with the gyro's readings or without."""
    remaps = [w for old, new in {**play_bag.REMAP, 'imu': IMU}.items() for w in _remap(old, new)]
    main = 'import sys; from depth_deblur_ros.deblur_node import main; sys.exit(main())'
    with tempfile.TemporaryDirectory() as logs:
        os.environ.update(private_environment(logs))
        command = [sys.executable, '-c', main, '--ros-args', *remaps, '-p', f'mode:={mode}']
        node = subprocess.Popen(command)
        rclpy.init()
        player = Player()
        try:
            player.meet()
            return [player.exchange(messages) for messages in frames_of(bag, imu)]
        finally:
            node.terminate()
            node.wait(30)
            player.node.destroy_node()
            rclpy.shutdown()


def _remap(old: str, new: str) -> tuple[str, str]:
    return '-r', f'{old}:={new}'
