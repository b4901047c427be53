"""
Measure what tracking tells on the bags of make_streams.py, through replay.

usage: python scripts/bench_streams.py FOLDER [--imu KIND] [--mode MODE] [--live]

One line per bag: median error of the exposure; rms error of the angular and the linear velocity
over that of no motion, frames that tell none counting as such; sign and told in percent.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
import json
from pathlib import Path
import tempfile
from types import SimpleNamespace
from typing import Any

from depth_deblur_ros import replay as replaying
from depth_deblur_ros.bag import BagReader, decoded
from depth_deblur_ros.core.params import MODES, SolverParams
from depth_deblur_ros.gyro import Gyro
import numpy as np
import numpy.typing as npt

TRUTH, TOLD = '/ground_truth/motion', '/ground_truth/exposure'
LATE_NS = 50_000_000
Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Score:
    """The figures of one bag."""

    exposure: float
    turn: float
    shift: float
    sign: float
    told: float

    def __str__(self) -> str:
        return (
            f'| {100 * self.exposure:.1f} % | {self.turn:.3f} | {self.shift:.3f} '
            f'| {100 * self.sign:.0f} | {100 * self.told:.0f} |'
        )


def truth_of(bag: Path) -> tuple[Array, Array]:
    """Give the velocities (n, 6), angular first, and the exposures (n,) of a bag's frames."""
    twists, exposures = [], []
    with BagReader(bag) as reader:
        for message in reader.messages({TRUTH, TOLD}):
            content = decoded(message)
            if message.topic.name == TOLD:
                exposures.append(float(content.data))
            else:
                turn, shift = content.twist.angular, content.twist.linear
                twists.append([turn.x, turn.y, turn.z, shift.x, shift.y, shift.z])
    return np.array(twists), np.array(exposures)


def spoil(kind: str) -> None:
    """Let every gyro that is read from now on be wrong in this way."""
    take = Gyro.take

    def spoilt(self: Gyro, msg: Any) -> None:
        rate = np.array([getattr(msg.angular_velocity, axis) for axis in 'xyz'])
        rate = {'reversed': -rate, 'offset': rate + 0.2}.get(kind, rate)
        late = LATE_NS if kind == 'late' else 0
        stamp = msg.header.stamp.sec * 10**9 + msg.header.stamp.nanosec + late
        moved = SimpleNamespace(sec=stamp // 10**9, nanosec=stamp % 10**9)
        x, y, z = rate
        made = SimpleNamespace(
            header=SimpleNamespace(stamp=moved), angular_velocity=SimpleNamespace(x=x, y=y, z=z)
        )
        if kind != 'none':
            take(self, made)

    Gyro.take = spoilt  # type: ignore[method-assign]


def look_ahead_no_more() -> None:
    """Let replay know no more of the following frame than a live camera does."""
    given = replaying._with_next
    replaying._with_next = lambda pairs: ((pair, None) for pair, _ in given(pairs))


def score(records: list[dict[str, Any]], twists: Array, exposures: Array) -> Score:
    """Compare the estimates of a bag with its truth."""
    found, right = np.zeros_like(twists), []
    off = np.ones(len(records))
    for k, record in enumerate(records):
        if record['exposure'] is None:
            continue
        off[k] = abs(record['exposure'] / exposures[k] - 1)
        if record['sign_resolved']:
            found[k] = -np.array(record['theta'] + record['v']) / record['exposure']
            right.append(found[k, :3] @ twists[k, :3] > 0)
    miss, whole = np.square(found - twists), np.square(twists)
    return Score(
        exposure=float(np.median(off)),
        turn=float(np.sqrt(miss[:, :3].sum() / whole[:, :3].sum())),
        shift=float(np.sqrt(miss[:, 3:].sum() / whole[:, 3:].sum())),
        sign=float(np.mean(right)) if right else 0.5,
        told=len(right) / len(records),
    )


def measured(bag: Path, mode: str) -> Score:
    """Replay a bag and score it."""
    with tempfile.TemporaryDirectory() as folder:
        lines = Path(folder) / 'motion.jsonl'
        replaying.replay(
            bag, Path(folder) / 'out', params=SolverParams(mode=mode), estimates=lines
        )
        records = [json.loads(line) for line in lines.read_text().splitlines()]
    return score(records, *truth_of(bag))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description='Measure what tracking tells.')
    parser.add_argument('folder', type=Path)
    kinds = ('none', 'good', 'reversed', 'late', 'offset')
    parser.add_argument('--imu', choices=kinds, default='none')
    parser.add_argument('--mode', choices=MODES, default='full')
    parser.add_argument('--live', action='store_true', help='without looking ahead')
    args = parser.parse_args()
    spoil(args.imu)
    if args.live:
        look_ahead_no_more()
    print('| stream | exposure | angular | linear | sign % | told % |\n|---|---|---|---|---|---|')
    for bag in sorted(path for path in args.folder.iterdir() if not path.name.startswith('.')):
        print(f'| {bag.name} {measured(bag, args.mode)}', flush=True)


if __name__ == '__main__':
    main()
