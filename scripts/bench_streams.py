"""
Measure what tracking tells on the bags of make_streams.py, through replay.

usage: python scripts/bench_streams.py FOLDER [--imu KIND] [--mode MODE] [--live | --no-ahead]

One line per bag: median error of the exposure; rms error of the angular and the linear velocity
over that of no motion, frames that tell none counting as such; sign and told in percent; the rms
errors again over the frames that tell a velocity. Of a bag
of break_streams.py: the first right frame after the break, and how many of the frames are right.
Through replay, or with --live through the live node, over DDS.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
import json
import math
from pathlib import Path
import tempfile
from types import SimpleNamespace
from typing import Any

from break_streams import AFTER, KINDS
from depth_deblur_ros import replay as replaying
from depth_deblur_ros.bag import BagReader, decoded
from depth_deblur_ros.core.params import MODES, SolverParams
from depth_deblur_ros.gyro import Gyro
import numpy as np
import numpy.typing as npt

TRUTH, TOLD = '/ground_truth/motion', '/ground_truth/exposure'
LATE_NS = 50_000_000
RIGHT, SLOW = 0.25, 0.1  # of the velocity; of the usual one, below which an error is none
AWAY = 2.0  # m; at this depth, a shift counts as much as a turn
HEAD = (
    '| stream | exposure | angular | linear | sign % | told % | angular, told | linear, told |\n'
    '|---|---|---|---|---|---|---|---|'
)
Array = npt.NDArray[np.float64]
Record = dict[str, Any]


@dataclass(frozen=True)
class Score:
    """The figures of one bag."""

    exposure: float
    turn: float
    shift: float
    sign: float
    told: float
    told_turn: float  # of the frames that tell one
    told_shift: float
    errors: tuple[float, ...]  # of each frame's exposure

    def __str__(self) -> str:
        return (
            f'| {100 * self.exposure:.1f} % | {self.turn:.3f} | {self.shift:.3f} '
            f'| {100 * self.sign:.0f} | {100 * self.told:.0f} '
            f'| {self.told_turn:.3f} | {self.told_shift:.3f} |'
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


def velocities(records: list[Record]) -> Array:
    """Give the velocities (n, 6) that are told, angular first; NaN where none is."""
    found = np.full((len(records), 6), np.nan)
    for k, record in enumerate(records):
        if record['exposure'] is not None and record['sign_resolved']:
            found[k] = -np.array([*record['theta'], *record['v']]) / record['exposure']
    return found


def score(records: list[Record], twists: Array, exposures: Array) -> Score:
    """Compare the estimates of a bag with its truth."""
    told = velocities(records)
    known = ~np.isnan(told[:, 0])
    off = [
        1.0 if record['exposure'] is None else abs(record['exposure'] / exposure - 1)
        for record, exposure in zip(records, exposures, strict=True)
    ]
    right = np.sum(told[known, :3] * twists[known, :3], axis=1) > 0
    return Score(
        exposure=float(np.median(off)),
        turn=_error(np.nan_to_num(told), twists, slice(0, 3)),
        shift=_error(np.nan_to_num(told), twists, slice(3, 6)),
        sign=float(np.mean(right)) if known.any() else 0.5,
        told=float(np.mean(known)),
        told_turn=_error(told[known], twists[known], slice(0, 3)),
        told_shift=_error(told[known], twists[known], slice(3, 6)),
        errors=tuple(off),
    )


def _error(found: Array, true: Array, part: slice) -> float:
    """Give the rms error of a part of velocities (n, 6) over that of no motion; 1 without any."""
    whole = float(np.square(true[:, part]).sum())
    return math.sqrt(np.square(found - true)[:, part].sum() / whole) if whole else 1.0


def right_again(records: list[Record], twists: Array) -> str:
    """Tell which frame after a break has the first right velocity, and how many have one."""
    scale = np.repeat([1.0, 1 / AWAY], 3)
    found, true = velocities(records)[-AFTER:] * scale, twists[-AFTER:] * scale
    usual = np.sqrt(np.mean(np.square(twists * scale).sum(axis=1)))
    size = np.maximum(np.linalg.norm(true, axis=1), SLOW * usual)
    right = np.linalg.norm(found - true, axis=1) <= RIGHT * size
    first = str(1 + int(np.argmax(right))) if right.any() else 'none'
    return f'| {first} | {right.sum()} of {AFTER} |'


def replayed(bag: Path, mode: str) -> list[Record]:
    """Replay a bag and give its estimates."""
    with tempfile.TemporaryDirectory() as folder:
        lines = Path(folder) / 'motion.jsonl'
        replaying.replay(
            bag, Path(folder) / 'out', params=SolverParams(mode=mode), estimates=lines
        )
        return [json.loads(line) for line in lines.read_text().splitlines()]


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description='Measure what tracking tells.')
    parser.add_argument('folder', type=Path)
    kinds = ('none', 'good', 'reversed', 'late', 'offset')
    parser.add_argument('--imu', choices=kinds, default='none')
    parser.add_argument('--mode', choices=MODES, default='full')
    how = parser.add_mutually_exclusive_group()
    how.add_argument('--live', action='store_true', help='through the live node')
    how.add_argument('--no-ahead', action='store_true', help='replay that knows no next frame')
    args = parser.parse_args()
    estimates: Callable[[Path, str], list[Record]] = replayed
    if args.live:
        from lockstep import live  # needs ROS

        if args.imu not in ('none', 'good'):
            parser.error('the live node is given a good gyro or none')
        estimates = partial(live, imu=args.imu == 'good')
    spoil(args.imu)
    if args.no_ahead:
        look_ahead_no_more()
    print(HEAD)
    errors: list[float] = []
    for bag in sorted(path for path in args.folder.iterdir() if not path.name.startswith('.')):
        records, (twists, exposures) = estimates(bag, args.mode), truth_of(bag)
        if bag.name.partition('-')[2] in KINDS:
            print(f'| {bag.name} {right_again(records, twists)}', flush=True)
        else:
            found = score(records, twists, exposures)
            errors += found.errors
            print(f'| {bag.name} {found}', flush=True)
    if errors:
        print(f'exposure of all frames: {100 * np.median(errors):.1f} % (median)')


if __name__ == '__main__':
    main()
