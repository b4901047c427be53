"""
Let the live node run for long at 30 Hz, 640x480, while everything around it goes wrong at random.

usage: python scripts/soak.py [--seconds S] [--seed N]; prints one line of JSON.
The publisher drops messages, repeats stamps, jumps in time, sends images that are black, cut, or
of another size, and is killed and started again; the node's parameters are changed and it goes
through its life cycle. In every status the accounts must balance: arrived = published + dropped +
waiting. Memory is what is resident and the process's own, and is given for each twentieth of the
time too. A service that does not answer on a busy machine is counted and the soak goes on; a node
that has ended stops it, and its last words are told.
"""

from __future__ import annotations

import argparse
from collections import Counter
import json
import os
from pathlib import Path
import random
import signal
import subprocess
import sys
import tempfile
import time
from typing import Any

from bench_node import private_environment
from diagnostic_msgs.msg import DiagnosticArray
from lifecycle_msgs.msg import State, Transition
from lifecycle_msgs.srv import ChangeState, GetState
import numpy as np
import play_bag
from rcl_interfaces.srv import SetParameters
import rclpy
from rclpy.parameter import Parameter
from rclpy.qos import QoSProfile
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import Image

NODE = 'import sys; from depth_deblur_ros.deblur_node import main; sys.exit(main())'
RATE = 30.0
EVENT_S = (2.0, 8.0)  # between two events
PATIENCE_S = 120.0  # for a service: the machine may be busy
PARTS = 20  # of the time, for the course of the memory
SETTLED = 0.25  # of the time: until then buffers and pools grow to their size
COLOUR, DEPTH = '/camera/rgb/image_color', '/camera/depth/image'


def memory_mb(pid: int) -> float:
    """Give the memory [MB] of a process that is resident and its own."""
    pages = Path(f'/proc/{pid}/statm').read_text().split()
    return (int(pages[1]) - int(pages[2])) * os.sysconf('SC_PAGE_SIZE') / 1e6


def play(seed: int) -> None:
    """Send frames with faults until this process is killed."""
    rng = random.Random(seed)
    rclpy.init()
    node = rclpy.create_node('player')
    frames = play_bag.bag_frames()
    publishers = {t: node.create_publisher(k, t, 10) for t, k in play_bag.KINDS.items()}
    shift, begin = 0, time.monotonic()
    for number in range(10**9):
        time.sleep(max(0.0, begin + number / RATE - time.monotonic()))
        if rng.random() < 0.005:  # the clock jumps
            shift += round(rng.uniform(-3, 3) * 1e9)
        stamp = time.time_ns() + shift - (33_000_000 if rng.random() < 0.01 else 0)
        for topic, data in frames[number % len(frames)]:
            if rng.random() > 0.03:
                publishers[topic].publish(_message(topic, data, stamp, rng))


def _message(topic: str, data: bytearray, stamp: int, rng: random.Random) -> Any:
    kind = play_bag.KINDS[topic]
    if kind is play_bag.Float32:
        return bytes(data)
    play_bag.STAMP.pack_into(data, 4, *divmod(stamp, 1_000_000_000))
    return broken(bytes(data), rng) if kind is Image and rng.random() < 0.01 else bytes(data)


def broken(data: bytes, rng: random.Random) -> Image:
    """Give an image that is black, cut, of another size, or lies about itself."""
    image = deserialize_message(data, Image)
    fault = rng.randrange(5)
    if fault == 0:
        image.data = bytes(len(image.data))
    elif fault == 1:
        image.data = image.data[: rng.randrange(len(image.data))]
    elif fault == 2:
        image.height //= 2
    elif fault == 3:
        image.width, image.height = 16384, 16384
    else:
        image.encoding, image.step = rng.choice(['', 'yuv422', '64FC9']), rng.randrange(2**32)
    return image


class Soak:
    """The node, its publisher, and what is done to them."""

    def __init__(self, seconds: float, seed: int, logs: Path) -> None:
        self._seconds, self._logs = seconds, logs
        self._rng = random.Random(seed)
        self.events: Counter[str] = Counter()
        self.unbalanced: list[str] = []
        self.totals: Counter[str] = Counter()
        self._values: dict[str, str] = {}
        self.memory: list[tuple[float, float]] = []
        self.heard = 0
        self._clients: dict[str, Any] = {}

    def run(self) -> dict[str, Any]:
        """Run for the time and give the figures."""
        rclpy.init()
        self._peer = rclpy.create_node('soak')
        self._peer.create_subscription(DiagnosticArray, '/diagnostics', self._status, 50)
        quality = QoSProfile(depth=30)
        self._peer.create_subscription(Image, 'deblurred/image', self._hear, quality)
        remaps = [w for old, new in play_bag.REMAP.items() for w in ('-r', f'{old}:={new}')]
        settings = ['-p', 'mode:=motion', '-p', 'threads:=1']
        log = (self._logs / 'node').open('w')
        self._node = subprocess.Popen(
            [sys.executable, '-c', NODE, '--ros-args', *remaps, *settings], stderr=log, stdout=log
        )
        self._player = self._started_player()
        try:
            self._go_on()
            self._player.kill()
            self._player.wait()
            self._settle()
            self._node.send_signal(signal.SIGINT)
            code = self._node.wait(PATIENCE_S)
        finally:
            for process in (self._node, self._player):
                process.kill()
                process.wait()
            log.close()
            self._peer.destroy_node()
            rclpy.shutdown()
        return self._figures(code)

    def _go_on(self) -> None:
        begin = time.monotonic()
        event = begin + 10
        sampled = begin
        while (now := time.monotonic()) < begin + self._seconds and self._node.poll() is None:
            rclpy.spin_once(self._peer, timeout_sec=0.05)
            if now >= sampled:
                self.memory.append((now - begin, memory_mb(self._node.pid)))
                sampled = now + 1
            if now >= event:
                action = self._rng.choice([self._kill, self._change, self._pause, self._rest])
                if self._is_active():
                    action()
                event = time.monotonic() + self._rng.uniform(*EVENT_S)

    def _settle(self) -> None:
        """Wait until nothing waits any more, by a status that is new."""
        self._values = {}
        end = time.monotonic() + PATIENCE_S
        while self._values.get('waiting') != '0' and time.monotonic() < end:
            rclpy.spin_once(self._peer, timeout_sec=0.1)

    def _started_player(self) -> subprocess.Popen[bytes]:
        seed = str(self._rng.randrange(2**31))
        return subprocess.Popen([sys.executable, __file__, 'play', seed])

    def _hear(self, _: Image) -> None:
        self.heard += 1

    def _status(self, message: DiagnosticArray) -> None:
        values = {entry.key: entry.value for entry in message.status[0].values}
        if 'arrived' not in values:
            return
        counts = {k: int(values[k]) for k in ('arrived', 'published', 'dropped', 'waiting')}
        by_reason = sum(int(n) for key, n in values.items() if key.startswith('dropped: '))
        if counts['arrived'] != counts['published'] + counts['dropped'] + counts['waiting']:
            self.unbalanced.append(str(counts))
        if counts['dropped'] != by_reason:
            self.unbalanced.append(f'{counts} {by_reason}')
        if counts['arrived'] < int(self._values.get('arrived', 0)):
            self._book()  # it was configured anew and counts from nothing
        self._values = values

    def _book(self) -> None:
        for key, value in self._values.items():
            if key.split(': ')[0] in ('arrived', 'published', 'dropped', 'failed', 'outcome'):
                self.totals[key] += int(value)

    def _kill(self) -> None:
        self.events['publisher killed'] += 1
        self._player.kill()
        self._player.wait()
        self._player = self._started_player()

    def _change(self) -> None:
        self.events['parameters changed'] += 1
        name, value = self._rng.choice([
            ('sync_slop_s', self._rng.uniform(0.0, 0.05)),
            ('exposure_s', self._rng.uniform(0.001, 0.05)),
            ('jpeg_quality', self._rng.randint(1, 100)),
            ('prior', self._rng.uniform(0.1, 10.0)),
            ('rectified', self._rng.random() < 0.5),
            ('transfer', self._rng.choice(['srgb', 'linear'])),
        ])  # fmt: skip
        request = SetParameters.Request()
        request.parameters = [Parameter(name, value=value).to_parameter_msg()]
        self._call(SetParameters, '/depth_deblur/set_parameters', request)

    def _pause(self) -> None:
        self.events['deactivated and activated'] += 1
        self._through(Transition.TRANSITION_DEACTIVATE, Transition.TRANSITION_ACTIVATE)

    def _rest(self) -> None:
        self.events['cleaned up and configured anew'] += 1
        self._through(
            Transition.TRANSITION_DEACTIVATE,
            Transition.TRANSITION_CLEANUP,
            Transition.TRANSITION_CONFIGURE,
            Transition.TRANSITION_ACTIVATE,
        )

    def _is_active(self) -> bool:
        """Whether the node is active; go on to it where a step had no answer in time."""
        found = self._call(GetState, '/depth_deblur/get_state', GetState.Request())
        state = found.current_state.id if found else None
        if state == State.PRIMARY_STATE_UNCONFIGURED:
            self._through(Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
        elif state == State.PRIMARY_STATE_INACTIVE:
            self._through(Transition.TRANSITION_ACTIVATE)
        return bool(state == State.PRIMARY_STATE_ACTIVE)

    def _through(self, *transitions: int) -> None:
        for number in transitions:
            request = ChangeState.Request()
            request.transition.id = number
            done = self._call(ChangeState, '/depth_deblur/change_state', request)
            if not done:
                return
            if not done.success:
                self.unbalanced.append(f'transition {number} was refused')

    def _call(self, kind: Any, service: str, request: Any) -> Any:
        """Call a service of the node; None where it does not answer."""
        client = self._clients.get(service) or self._peer.create_client(kind, service)
        self._clients[service] = client
        end = time.monotonic() + PATIENCE_S
        future = None
        while time.monotonic() < end and self._node.poll() is None:
            rclpy.spin_once(self._peer, timeout_sec=0.1)
            if future is None and client.service_is_ready():
                future = client.call_async(request)
            if future and future.done():
                return future.result()
        self.events[f'no answer from {service}'] += 1
        return None

    def _figures(self, code: int) -> dict[str, Any]:
        self._book()
        times, memory = np.array(self.memory).T
        late = times > SETTLED * self._seconds
        slope = np.polyfit(times[late], memory[late], 1)[0] if late.sum() > 2 else 0.0
        parts = [m for m in np.array_split(memory, PARTS) if m.size]
        return {
            'seconds': round(float(times[-1])),
            'exit code': code,
            'last words': '' if code == 0 else (self._logs / 'node').read_text()[-2000:],
            'unbalanced': self.unbalanced[:5],
            'events': dict(self.events),
            'counts': dict(sorted(self.totals.items())),
            'images heard': self.heard,
            'memory [MB]': [round(float(memory[late].mean())), round(float(memory[late].max()))],
            'its course [MB]': [round(float(part.mean())) for part in parts],
            'slope [MB/min]': round(60 * float(slope), 2),
        }


def main() -> None:
    """Run and print the figures."""
    parser = argparse.ArgumentParser(description='Run the live node while all goes wrong.')
    parser.add_argument('--seconds', type=float, default=3600.0)
    parser.add_argument('--seed', type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as logs:
        os.environ.update(private_environment(logs))
        print(json.dumps(Soak(args.seconds, args.seed, Path(logs)).run()))


if __name__ == '__main__':
    if sys.argv[1:2] == ['play']:
        play(int(sys.argv[2]))
    else:
        main()
