"""
Time each mode of the solver, and what grows how with the size of the image and of the blur.

usage: python scripts/bench_speed.py [--short] [--check] [--write]

All is measured in one run against scikit-image's Richardson-Lucy deconvolution (RL: 25 x 25
kernel, 30 steps, three channels of 640x480, one thread), so that the ratios hold on any machine.
Writes out/speed.json and out/speed.svg, and compares with docs/speed.json by CPU time on one
thread, which other work on the machine changes least; the wall time is that of two threads.

--short: the modes at 640x480 alone, few runs; the rest stays as it was committed.
--check: exit 1 where a mode is 60 % slower than the committed figures. --write: renew
docs/speed.json and docs/speed.svg.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from functools import partial
import json
import os
from pathlib import Path
from statistics import median
import subprocess
import sys
import tempfile
import time
from typing import Any

os.environ.setdefault('OMP_WAIT_POLICY', 'passive')  # spinning threads are no work

from depth_deblur_ros.charts import chart, Curve, Panel
from depth_deblur_ros.compiling import tell_of_compiling
from depth_deblur_ros.core.data import CameraIntrinsics, Motion, RgbdFrame
from depth_deblur_ros.core.params import params_from_mapping, SolverParams
from depth_deblur_ros.core.solver import deblur
from depth_deblur_ros.flags import read_params
from depth_deblur_ros.memory import keep_freed_memory
import numpy as np
from speed_frames import blurred_frame, compute_bound, peers

ROOT = Path(__file__).resolve().parents[1]
COMMITTED, WRITTEN = ROOT / 'docs', ROOT / 'out'
SIZES = ((320, 240), (640, 480), (1280, 720), (1920, 1080))
BLURS = (3, 10, 20, 40)  # px
VGA, USUAL = (640, 480), 10
BARS = {
    'motion, tracking': 1 / 20,
    'motion, cold': 1 / 5,
    'fast, tracking': 1 / 6,
    'full, cold': 1.2,
}
CLEAN = 'motion, cold, clean picture'
BESIDE = ('fast, cold', CLEAN)  # no bar
RL = 'Richardson-Lucy, 30 steps'
SHOWN, REFUSED = 0.25, 0.60  # slower than committed
RED, PLAIN = '\033[31m', '\033[0m'
Row = dict[str, Any]


def measured(work: Callable[[], object], runs: int) -> Row:
    """Give the median wall and CPU time [s] of some runs; of more than one, the first is extra."""
    if runs > 1:
        work()
    wall, cpu = [], []
    for _ in range(runs):
        begin, used = time.perf_counter(), time.process_time()
        work()
        wall.append(time.perf_counter() - begin)
        cpu.append(time.process_time() - used)
    return {'wall': median(wall), 'cpu': median(cpu)}


def solve(frame: RgbdFrame, mode: str, start: Motion | None = None, threads: int = 2) -> Any:
    """Run the solver once."""
    return deblur(frame, SolverParams(mode=mode, threads=threads), start=start)


def modes(runs: int) -> dict[str, Row]:
    """Time the peers and the modes at the usual size and blur."""
    frame, motion = blurred_frame(*VGA, USUAL)
    near = Motion.from_vector(0.9 * motion.vector)  # what the frame before tells
    jobs = {name: (work, max(runs // 4, 2)) for name, work in peers(frame.image, USUAL).items()}
    for name, start in (
        ('motion, tracking', near),
        ('motion, cold', None),
        ('fast, tracking', near),
        ('fast, cold', None),
        ('full, cold', None),
    ):
        jobs[name] = (partial(solve, frame, name.split(',')[0], start), runs)
    clean, _ = blurred_frame(*VGA, USUAL, 'linear', 0.0)
    jobs[CLEAN] = (partial(solve, clean, 'motion'), max(runs // 4, 2))
    rows = {}
    for name, (work, count) in jobs.items():
        print(f'timing {name} ...', file=sys.stderr)
        rows[name] = measured(work, count)
        if name in BARS or name in BESIDE:
            rows[name]['cpu'] = measured(partial(work, threads=1), count)['cpu']  # type: ignore[call-arg]
    return with_ratios(rows)


def with_ratios(rows: dict[str, Row]) -> dict[str, Row]:
    """Add each row's ratio to Richardson-Lucy."""
    unit = rows[RL]
    return {
        name: {**row, 'of_rl': row['wall'] / unit['wall'], 'cpu_of_rl': row['cpu'] / unit['cpu']}
        for name, row in rows.items()
    }


def papers_method() -> Row:
    """Time the paper's method once."""
    frame, _ = blurred_frame(*VGA, USUAL)
    params = params_from_mapping(read_params(ROOT / 'config/paper.yaml'))
    begin, used = time.perf_counter(), time.process_time()
    deblur(frame, params)
    return {'wall': time.perf_counter() - begin, 'cpu': time.process_time() - used}


def growth() -> list[Row]:
    """Time mode full over sizes and blurs; cost is CPU time per pixel and (1 + blur / 10)."""
    rows = []
    for width, height in SIZES:
        for blur in BLURS:
            frame, _ = blurred_frame(width, height, blur)
            row = measured(partial(solve, frame, 'full'), 1 if width > 640 else 2)
            cost = row['cpu'] / (width * height * (1 + blur / 10))
            rows.append({'size': [width, height], 'blur': blur, 'cost': cost, **row})
            print(
                f'  {width}x{height} {blur:3d} px  {row["wall"]:7.2f} s wall  '
                f'{row["cpu"]:7.2f} s CPU  {1e9 * cost:6.0f} ns/px',
                flush=True,
            )
    return rows


def threads(runs: int) -> Row:
    """Say how much two threads gain in mode full, and in a kernel that only calculates."""
    frame, _ = blurred_frame(*VGA, USUAL)
    gains = {}
    for name, work in (
        ('full', lambda n: partial(solve, frame, 'full', None, n)),
        ('compute bound', compute_bound),
    ):
        # In turns: the machine's own speed drifts.
        walls = [[measured(work(n), 1)['wall'] for n in (1, 2)] for _ in range(runs + 1)]
        one, two = zip(*walls[1:], strict=True)
        gains[name] = median(one) / median(two)
    return gains


def first_results() -> Row:
    """Time new processes from start to first result, and ask the system for their peak memory."""
    rows: Row = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, size, cold in (
            ('first run ever, VGA', VGA, True),
            ('kernels cached, VGA', VGA, False),
            ('kernels cached, 1080p', SIZES[-1], False),
        ):
            frame, _ = blurred_frame(*size, USUAL)
            np.savez(f'{folder}/frame.npz', image=frame.image, depth=frame.depth)
            env = dict(os.environ)
            if cold:
                env['NUMBA_CACHE_DIR'] = f'{folder}/cache'
            begin = time.perf_counter()
            command = [sys.executable, __file__, '--one', f'{folder}/frame.npz']
            text = subprocess.run(command, env=env, check=True, capture_output=True, text=True)
            rows[name] = {'wall': time.perf_counter() - begin, **json.loads(text.stdout)}
    return rows


def one_result(path: str) -> None:
    """Solve the frame of a file and print the process's CPU time [s] and peak memory [MB]."""
    with np.load(path) as arrays:
        image, depth = arrays['image'], arrays['depth']
    height, width = depth.shape
    focal = 0.82 * width
    camera = CameraIntrinsics(focal, focal, width / 2 - 0.5, height / 2 - 0.5, width, height)
    tell_of_compiling(lambda text: print(text, file=sys.stderr))  # as the command line does
    solve(RgbdFrame(image, depth, camera), 'full')
    # Not ru_maxrss: a process begins with that of whoever started it.
    status = Path('/proc/self/status').read_text().split()
    peak = int(status[status.index('VmHWM:') + 1]) / 1024
    print(json.dumps({'cpu': time.process_time(), 'peak_mb': peak}))


def print_modes(rows: dict[str, Row], committed: dict[str, Row]) -> list[str]:
    """Print the table; give the rows that are too much slower than committed."""
    refused = []
    head = (
        f'{"640x480, 10 px":<28}{"s, two":>8}{"of RL":>8}{"bar":>7}{"CPU s, one":>11}{"of RL":>7}'
    )
    print(f'{head}  now : committed')
    for name, row in rows.items():
        before = committed.get(name, {}).get('cpu_of_rl')
        change = row['cpu_of_rl'] / before if before else None
        bar = f'{BARS[name]:.2f}' if name in BARS else '-'
        then = '-' if change is None else f'{change:.2f}'
        if change and name in BARS and change > 1 + SHOWN:
            then = f'{RED}{then}{PLAIN}'
        if change and name in BARS and change > 1 + REFUSED:
            refused.append(name)
        print(
            f'{name:<28}{row["wall"]:8.3f}{row["of_rl"]:8.3f}{bar:>7}'
            f'{row["cpu"]:11.3f}{row["cpu_of_rl"]:7.3f}  {then}'
        )
    return refused


def draw(rows: list[Row]) -> str:
    """Draw the time against the blur, one line for each size."""
    curves = []
    for k, size in enumerate(SIZES):
        own = [row for row in rows if row['size'] == list(size)]
        x, y = (np.array([row[key] for row in own], float) for key in ('blur', 'cpu'))
        curves.append(Curve(f'{size[0]}x{size[1]}', x, y, k))
    panel = Panel('Mode full, CPU time', tuple(curves), 'blur [px]', 's', logarithmic=True)
    return chart([panel], title='CPU time of a frame by size and blur')


def write_whole(path: Path, text: str) -> None:
    """Write a file under another name first."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + '.part')
    part.write_text(text)
    part.replace(path)


def main() -> int:
    """Measure, print, compare, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[1])
    for flag in ('--short', '--check', '--write'):
        parser.add_argument(flag, action='store_true')
    parser.add_argument('--runs', type=int, default=20)
    parser.add_argument('--one', help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        one_result(args.one)
        return 0
    keep_freed_memory()  # as the live node and replay do
    then = COMMITTED / 'speed.json'
    committed = json.loads(then.read_text()) if then.exists() else {'modes': {}}
    found: Row = {**committed, 'modes': modes(3 if args.short else args.runs)}
    if not args.short:
        found['modes']["the paper's method"] = papers_method()
        found['modes'] = with_ratios(found['modes'])
    refused = print_modes(found['modes'], committed['modes'])
    if not args.short:
        measure_more(found, args.runs)
    for place in [WRITTEN, COMMITTED] if args.write else [WRITTEN]:
        write_whole(place / 'speed.json', json.dumps(found, indent=1) + '\n')
        if 'growth' in found:
            write_whole(place / 'speed.svg', draw(found['growth']))
    if refused:
        print(f'{RED}over {REFUSED:.0%} slower than committed: {", ".join(refused)}{PLAIN}')
    return int(bool(refused) and args.check)


def measure_more(found: Row, runs: int) -> None:
    """Measure and print growth, threads, first results and memory."""
    print('mode full, cold')
    found['growth'] = growth()
    found['threads'] = threads(max(runs // 4, 2))
    print('two threads gain', ', '.join(f'{n}: {g:.2f}' for n, g in found['threads'].items()))
    found['first'] = first_results()
    for name, row in found['first'].items():
        print(
            f'{name:<28}{row["wall"]:7.1f} s from start to result, {row["cpu"]:5.1f} s CPU, '
            f'peak {row["peak_mb"]:.0f} MB'
        )


if __name__ == '__main__':
    sys.exit(main())
