"""
How many frames a second the live node gets through, and what it costs beside the solver.

A bag's frames at 30 Hz, over the transport profile; first with a solver that takes no time at all,
frames taken one by one, so that what is left is the transport, decoding, pairing, handing over and
publishing, then with the real one, in the modes motion and fast, frames tracked. `lockstep.py`
tells how good the results are.

usage: python scripts/bench_node.py [--bag BAG] [--threads N]
"""

from __future__ import annotations

import argparse
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
from geometry_msgs.msg import TwistStamped
import numpy as np
import play_bag
import rclpy
from sensor_msgs.msg import Image

ROOT = Path(__file__).resolve().parents[1]
FRAMES, RATE = 300, 30.0
PATIENCE_S = 60.0


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
    """What is seen from outside: the ages of motions when they come, what the node says."""

    def __init__(self, pid: int, pictures: bool) -> None:
        self.ages: list[float] = []
        self.state, self.said = '', dict[str, str]()
        self._pid, self._begun = pid, 0.0
        self.node = rclpy.create_node('listener')
        self.node.create_subscription(TwistStamped, 'displacement', self._see, 10)
        self.node.create_subscription(DiagnosticArray, '/diagnostics', self._hear, 10)
        if pictures:
            self.node.create_subscription(Image, 'deblurred/image', lambda _: None, 10)

    def await_node(self) -> None:
        """Listen until the node waits for frames."""
        end = time.monotonic() + PATIENCE_S
        while not self.state.startswith('nothing on'):
            if time.monotonic() > end:
                raise TimeoutError(f'the node is not ready: {self.state!r}')
            rclpy.spin_once(self.node, timeout_sec=0.1)

    def spin(self, player: subprocess.Popen[bytes]) -> None:
        """Listen until the player has ended, and the node has said so."""
        while player.poll() is None:
            rclpy.spin_once(self.node, timeout_sec=0.1)
        end = time.monotonic() + 1.5
        while time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.1)

    def load(self) -> float:
        """Give the processor time that the node has taken for each motion since the first [s]."""
        return (cpu_seconds(self._pid) - self._begun) / max(len(self.ages) - 1, 1)

    def _see(self, message: TwistStamped) -> None:
        self.ages.append(time.time() - stamp_ns(message.header) / 1e9)
        if len(self.ages) == 1:
            self._begun = cpu_seconds(self._pid)

    def _hear(self, message: DiagnosticArray) -> None:
        self.state = message.status[0].message
        self.said = {entry.key: entry.value for entry in message.status[0].values}


def measure(mode: str, bag: Path, threads: int) -> str:
    """Run node, player and a listener, without a solver where there is no mode; give a line."""
    own = [sys.executable, __file__]
    remaps = [w for old, new in play_bag.REMAP.items() for w in ('-r', f'{old}:={new}')]
    told = [f'mode:={mode}', f'threads:={threads}'] if mode else ['neighbours:=ignore']
    options = [w for option in told for w in ('-p', option)]
    node = subprocess.Popen([*own, 'solve' if mode else 'idle', '--ros-args', *remaps, *options])
    rclpy.init()
    listener = Listener(node.pid, pictures=mode != 'motion')
    try:
        listener.await_node()
        play = [sys.executable, str(ROOT / 'scripts/play_bag.py'), '--bag', str(bag)]
        player = subprocess.Popen(
            [*play, '--frames', str(FRAMES), '--rate', str(RATE)],
            stdout=subprocess.DEVNULL,
        )
        listener.spin(player)
        load = listener.load()
    finally:
        node.terminate()
        node.wait(30)
        listener.node.destroy_node()
        rclpy.shutdown()
    return line(mode or 'no solver', listener, load)


def line(what: str, listener: Listener, load: float) -> str:
    """Give the figures of one run."""
    said = listener.said
    kinds = 'solver', 'latency'
    pairs = [[float(said[f'{kind} {p} [s]']) for p in ('p50', 'p99')] for kind in kinds]
    pairs.append(np.percentile(listener.ages, [50, 99]).tolist())
    times = ' | '.join(f'{1000 * p50:.1f} / {1000 * p99:.1f}' for p50, p99 in pairs)
    rate = RATE * int(said['published']) / FRAMES
    lost = f'{said["dropped"]}, {said["colour lost in transport"]}'
    return f'| {what} | {rate:.1f} | {lost} | {times} | {1000 * load:.1f} |'


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description='How many frames a second the node gets through.')
    parser.add_argument('--bag', type=Path, default=play_bag.BAG)
    parser.add_argument('--threads', type=int, default=2)
    args = parser.parse_args()
    print(f'{FRAMES} frames at {RATE:g} Hz, transport profile on; p50 / p99 in ms')
    print('| solver | Hz | overtaken, lost | solved | published | seen outside | CPU a frame |')
    print('|---|---|---|---|---|---|---|')
    for mode in ('', 'motion', 'fast'):
        print(measure(mode, args.bag, args.threads), flush=True)


if __name__ == '__main__':
    if sys.argv[1:2] in (['idle'], ['solve']):
        sys.exit(node_main(sys.argv, IdleNode if sys.argv[1] == 'idle' else DeblurNode))
    with tempfile.TemporaryDirectory() as logs:
        os.environ.update(private_environment(logs))
        main()
