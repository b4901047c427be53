"""
What the live node itself costs: how long after its stamp a result is out, less the solver's time.

The sample bag at 30 Hz, 640x480, over the transport profile; the solver takes no time at all, so
that what is left is the transport, decoding, pairing, handing over and publishing.
"""

from __future__ import annotations

import json
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time
from typing import Any

from depth_deblur_ros.core.data import DeblurResult, Motion, Outcome, RgbdFrame
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.messages import stamp_ns
from depth_deblur_ros.node import DeblurNode
from depth_deblur_ros.node import main as node_main
import numpy as np
import play_bag
import rclpy
from sensor_msgs.msg import Image

ROOT = Path(__file__).resolve().parents[1]
FRAMES, RATE = 300, 30.0


def no_work(frame: RgbdFrame, params: SolverParams) -> DeblurResult:
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


def listen(peer: Any, ages: list[float], player: subprocess.Popen[str]) -> None:
    """Collect the ages of the deblurred images until the player has ended."""
    peer.create_subscription(
        Image, 'deblurred/image', lambda m: ages.append(time.time() - stamp_ns(m.header) / 1e9), 10
    )
    while player.poll() is None:
        rclpy.spin_once(peer, timeout_sec=0.1)


def measure() -> None:
    """Run node, player and a listener, and print the figures."""
    own = [sys.executable, __file__]
    remaps = [w for old, new in play_bag.REMAP.items() for w in ('-r', f'{old}:={new}')]
    node = subprocess.Popen([*own, 'node', '--ros-args', *remaps])
    player = subprocess.Popen(
        [sys.executable, str(ROOT / 'scripts/play_bag.py'), '--frames', str(FRAMES)],
        stdout=subprocess.PIPE,
        text=True,
    )
    rclpy.init()
    peer = rclpy.create_node('listener')
    ages: list[float] = []
    begin, used = time.monotonic(), cpu_seconds(node.pid)
    try:
        listen(peer, ages, player)
        elapsed, used = time.monotonic() - begin, cpu_seconds(node.pid) - used
        assert player.stdout
        sent = len(json.loads(player.stdout.read())['stamps'])
    finally:
        node.terminate()
        node.wait(30)
        peer.destroy_node()
        rclpy.shutdown()
    p50, p99 = 1000 * np.percentile(ages, [50, 99])
    print(f'live node without a solver, 640x480 at {RATE:g} Hz, transport profile on')
    print(f'frames sent {sent}, results seen {len(ages)}')
    print(f'stamp to result seen  p50 {p50:6.1f} ms   p99 {p99:6.1f} ms')
    print(f'processor of the node {100 * used / elapsed:6.1f} %  (with its start)')


if __name__ == '__main__':
    if sys.argv[1:2] == ['node']:
        sys.exit(node_main(sys.argv, IdleNode))
    with tempfile.TemporaryDirectory() as logs:
        os.environ.update(private_environment(logs))
        measure()
