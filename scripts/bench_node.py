"""
What the live node itself costs: how long after its stamp a result is out, less the solver's time.

The sample bag at 30 Hz, 640x480, over the transport profile; the solver takes no time at all, so
that what is left is the transport, decoding, pairing, handing over and publishing. Frames
are taken one by one: what tracking costs belongs to the solver.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time

from depth_deblur_ros.core.data import DeblurResult, Motion, Outcome, RgbdFrame
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.messages import stamp_ns
from depth_deblur_ros.node import DeblurNode
from depth_deblur_ros.node import main as node_main
from diagnostic_msgs.msg import DiagnosticArray
import numpy as np
import play_bag
import rclpy
from sensor_msgs.msg import Image

ROOT = Path(__file__).resolve().parents[1]
FRAMES, RATE = 300, 30.0


def no_work(
    frame: RgbdFrame, params: SolverParams, *, start: Motion | None = None
) -> DeblurResult:
    """Give the frame back."""
    still = Motion(np.zeros(3), np.zeros(3))
    depth = np.nan_to_num(frame.depth)
    return DeblurResult(frame.image, depth, still, Outcome.SHARP, True, 1.0, 0.0, 0.0)


class IdleNode(DeblurNode):
    """The live node without a solver."""

    def __init__(self) -> None:
        super().__init__(solve=no_work, first=lambda: None)


def cpu_seconds(pid: int) -> float:
    """Give the processor time that a process has used."""
    fields = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf('SC_CLK_TCK')


def private_environment(folder: str) -> dict[str, str]:
    """Keep the traffic to this machine and apart from other nodes."""
    return {
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
        'ROS_DOMAIN_ID': str(1 + os.getpid() % 100),
        'ROS_LOG_DIR': folder,
        'FASTRTPS_DEFAULT_PROFILES_FILE': str(ROOT / 'config/fastdds.xml'),
    }


class Listener:
    """What is seen from outside: the ages of the images when they come, and what the node says."""

    def __init__(self, pid: int) -> None:
        self.ages: list[float] = []
        self.said: dict[str, str] = {}
        self._pid, self._begun = pid, (0.0, 0.0)
        self.node = rclpy.create_node('listener')
        self.node.create_subscription(Image, 'deblurred/image', self._see, 10)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._hear, 10)

    def spin(self, player: subprocess.Popen[str]) -> None:
        """Listen until the player has ended, and the node has said so."""
        while player.poll() is None:
            rclpy.spin_once(self.node, timeout_sec=0.1)
        end = time.monotonic() + 1.5
        while time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.1)

    def load(self) -> float:
        """Give the share of a processor that the node has taken since the first image."""
        time_then, used_then = self._begun
        return (cpu_seconds(self._pid) - used_then) / (time.monotonic() - time_then)

    def _see(self, message: Image) -> None:
        self.ages.append(time.time() - stamp_ns(message.header) / 1e9)
        if len(self.ages) == 1:
            self._begun = time.monotonic(), cpu_seconds(self._pid)

    def _hear(self, message: DiagnosticArray) -> None:
        self.said = {entry.key: entry.value for entry in message.status[0].values}


def measure() -> None:
    """Run node, player and a listener, and print the figures."""
    own = [sys.executable, __file__]
    remaps = [w for old, new in play_bag.REMAP.items() for w in ('-r', f'{old}:={new}')]
    alone = ('-p', 'neighbours:=ignore')
    node = subprocess.Popen([*own, 'node', '--ros-args', *remaps, *alone])
    player = subprocess.Popen(
        [sys.executable, str(ROOT / 'scripts/play_bag.py'), '--frames', str(FRAMES)],
        stdout=subprocess.PIPE,
        text=True,
    )
    rclpy.init()
    listener = Listener(node.pid)
    try:
        listener.spin(player)
        load = listener.load()
        assert player.stdout
        sent = len(json.loads(player.stdout.read())['stamps'])
    finally:
        node.terminate()
        node.wait(30)
        listener.node.destroy_node()
        rclpy.shutdown()
    report(sent, listener, load)


def report(sent: int, listener: Listener, load: float) -> None:
    """Print the figures."""
    said = listener.said
    published = [1000 * float(said[f'latency {p} [s]']) for p in ('p50', 'p99')]
    seen = 1000 * np.percentile(listener.ages, [50, 99])
    print(f'live node without a solver, 640x480 at {RATE:g} Hz, transport profile on')
    print(f'frames sent {sent}, published {said["published"]}, seen {len(listener.ages)}')
    print(f'dropped {said["dropped"]}, lost in transport {said["colour lost in transport"]}')
    for name, (p50, p99) in (('published', published), ('seen outside', seen)):
        print(f'stamp to result {name:12}  p50 {p50:6.1f} ms   p99 {p99:6.1f} ms')
    print(f'processor of the node         {100 * load:6.1f} %')


if __name__ == '__main__':
    if sys.argv[1:2] == ['node']:
        sys.exit(node_main(sys.argv, IdleNode))
    with tempfile.TemporaryDirectory() as logs:
        os.environ.update(private_environment(logs))
        measure()
