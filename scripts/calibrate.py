"""
Ask whether the covariance of the motion is right, on rendered frames with known motion.

usage: python scripts/calibrate.py [--frames N] [--first N] [--modes MODE ...] [--workers N]
       [--blurs LOW HIGH] [--vga] [--keep FILE.jsonl] [--plot FILE.svg] [--worst FOLDER]

Rooms, paths and blurs (2 to 40 px on 320x240) are drawn anew, from numbers that nothing else in
the project uses; the solver's constants were set on some of the first 1800, so --first 1800 asks
frames that are new to it. Prints, for each mode and axis of the motion, how many of the true
motions lie within one and three standard deviations of what was solved, but for the sign; the
plot tells it for all numbers of deviations. --worst draws the five frames with the worst flow;
with --keep a run that was ended goes on where it was.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass, replace
from functools import lru_cache, partial
import json
from pathlib import Path

from depth_deblur_ros.charts import chart, Curve, Panel
from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    DeblurResult,
    Motion,
    Outcome,
    RgbdFrame,
)
from depth_deblur_ros.core.geometry import blur_length
from depth_deblur_ros.core.params import MODES, SolverParams
from depth_deblur_ros.core.solver import deblur
from depth_deblur_ros.folders import write_image
from draw_worst import both_ways
import numpy as np
import numpy.typing as npt
from scene import make_scene, Scene
from scipy.stats import norm
from sensor import depth_picture, photograph
from shake import hand_held, render_blurred, true_motion

CAMERA = CameraIntrinsics(262.5, 262.5, 159.5, 119.5, 320, 240)
AXES = ('theta_x', 'theta_y', 'theta_z', 'v_x', 'v_y', 'v_z')
FRAMES, PER_ROOM = 300, 10
FIRST_ROOM, FIRST_PATH = 5000, 9000  # seeds
BLURS = (2.0, 40.0)  # px, mean over the picture; even in the logarithm
EXPOSURES = (0.008, 0.033)  # s
FASTEST = 6.0  # times the speed of an ordinary hand
LEAST_VIEWS = 17
WILD_PX, WILD_SHARE, WORST = 2.0, 0.25, 5
Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Shot:
    """One rendered frame, its true motion and mean blur [px]."""

    frame: RgbdFrame
    motion: Motion
    blur: float


@lru_cache(maxsize=1)
def room(number: int) -> Scene:
    """Furnish a room, which ten frames share."""
    return make_scene(FIRST_ROOM + number)


def take(
    number: int,
    blurs: tuple[float, float] = BLURS,
    camera: CameraIntrinsics = CAMERA,
) -> Shot:
    """Render a frame with a mean blur between two lengths [px]."""
    rng = np.random.default_rng([FIRST_PATH, number])
    scene = room(number // PER_ROOM)
    middle, exposure = rng.uniform(0, 10), rng.uniform(*EXPOSURES)
    speeds = np.array([rng.uniform(0.3, 1.5), rng.uniform(0.1, 0.8)])
    wanted = np.exp(rng.uniform(*np.log(blurs)))
    for _ in range(2):  # the second time as fast as makes that blur
        path = hand_held(FIRST_PATH + number, *speeds)
        pose, motion = path.pose(middle), true_motion(path, middle, exposure)
        view = scene.depth(camera, pose)
        length = blur_length(motion.vector, view.depth, camera)
        speeds *= min(wanted / length, FASTEST)
    light = render_blurred(scene, camera, path, middle, exposure, least=LEAST_VIEWS)
    colour = (photograph(light, rng) / 255).astype(np.float32)
    depth = depth_picture(view, scene.light(camera, pose), rng).astype(np.float32) / 1000
    depth[depth == 0] = np.nan
    return Shot(RgbdFrame(colour, depth, camera), motion, length)


@dataclass(frozen=True, eq=False)
class Answer:
    """What became of a shot: error (6,) in standard deviations and of the flow [px] if solved."""

    number: int
    blur: float
    outcome: Outcome
    error: list[float] | None = None
    miss: float = 0.0


Shoot = Callable[[int], Shot]


def deviations(shot: Shot, result: DeblurResult) -> tuple[Array, float]:
    """Give the error of each axis (6,) in standard deviations, and of the flow [px]."""
    found, true, camera = result.motion, shot.motion.vector, shot.frame.camera
    misses = [blur_length(found.vector - s * true, result.depth, camera) for s in (1, -1)]
    sign = 1 if misses[0] <= misses[1] else -1
    assert found.covariance is not None
    spread = np.sqrt(np.diag(found.covariance))
    return np.asarray((found.vector - sign * true) / spread), min(misses)


def asked(number: int, shoot: Shoot, modes: Sequence[str]) -> list[Answer]:
    """Render a frame and solve it in each mode."""
    shot, answers = shoot(number), []
    for mode in modes:
        # The image does not count here.
        result = deblur(shot.frame, SolverParams(mode=mode, threads=1, reweightings=1, cg_steps=1))
        answer = Answer(number, shot.blur, result.outcome)
        if result.outcome is Outcome.SOLVED:
            error, miss = deviations(shot, result)
            answer = replace(answer, error=error.tolist(), miss=miss)
        answers.append(answer)
    return answers


def all_asked(
    numbers: Sequence[int], work: Callable[[int], list[Answer]], workers: int
) -> Iterator[list[Answer]]:
    """Ask frame after frame, in so many processes."""
    if workers == 1:
        yield from map(work, numbers)
        return
    with ProcessPoolExecutor(workers) as pool:
        yield from pool.map(work, numbers)


def read_kept(path: Path, modes: Sequence[str]) -> dict[int, list[Answer]]:
    """Read the frames that were asked before in all of these modes."""
    lines = path.read_text().splitlines() if path.exists() else []
    kept = {}
    for record in map(json.loads, lines):
        if set(modes) <= set(record):
            answers = [Answer(**record[mode]) for mode in modes]
            kept[answers[0].number] = answers
    return kept


def printed(mode: str, answers: Sequence[Answer]) -> None:
    """Print the table of one mode."""
    solved = [answer for answer in answers if answer.error is not None]
    counts = [f'{sum(a.outcome == o for a in answers)} {o}' for o in Outcome]
    misses = [answer.miss for answer in solved]
    print(f'mode {mode}: {", ".join(counts)}')
    print(f'flow error {np.mean(misses):.2f} px, median {np.median(misses):.2f} px')
    wild = [a for a in solved if a.miss > max(WILD_PX, WILD_SHARE * a.blur)]
    told = ', '.join(f'{a.number} ({a.miss:.1f} of {a.blur:.1f} px)' for a in wild)
    print(f'{len(wild)} wrong by more than {WILD_PX} px and {WILD_SHARE:.0%}: {told}')
    far = np.abs([answer.error for answer in solved])
    for k, name in enumerate(AXES):
        within = [100 * (far[:, k] <= bound).mean() for bound in (1, 3)]
        print(f'{name:8s} within 1 sigma {within[0]:5.1f} %, within 3 sigma {within[1]:5.1f} %')


def plotted(columns: dict[str, tuple[Answer, ...]]) -> str:
    """Draw the share of errors within so many deviations, as it is and as it should be."""
    at = np.linspace(0, 4, 81)
    errors = {
        mode: np.array([answer.error for answer in answers if answer.error is not None])
        for mode, answers in columns.items()
    }
    panels = []
    for k, name in enumerate(AXES):
        curves = [
            Curve(f'mode {mode}', at, (np.abs(own[:, k, None]) <= at).mean(0), colour=2 * m)
            for m, (mode, own) in enumerate(errors.items())
        ]
        curves.append(Curve('normal distribution', at, 2 * norm.cdf(at) - 1, colour=4))
        panels.append(Panel(name, tuple(curves), 'standard deviations', 'share'))
    count = max(len(own) for own in errors.values())
    title = f'share of {count} frames whose error lies within so many standard deviations'
    return chart(panels, 3, title)


def draw_worst(answers: Sequence[Answer], shoot: Shoot, folder: Path) -> None:
    """Draw the frames whose flow is most wrong, and with their true motion."""
    worst = sorted(answers, key=lambda answer: answer.miss, reverse=True)[:WORST]
    for answer in worst:
        shot = shoot(answer.number)
        write_image(folder / f'{answer.number}.jpg', both_ways(shot.frame, shot.motion))


def gathered(args: argparse.Namespace, shoot: Shoot) -> dict[str, tuple[Answer, ...]]:
    """Ask all frames that were not asked before, and keep what they say; by mode."""
    numbers = range(args.first, args.first + args.frames)
    kept = read_kept(args.keep, args.modes) if args.keep else {}
    missing = [number for number in numbers if number not in kept]
    work = partial(asked, shoot=shoot, modes=args.modes)
    for number, answers in zip(missing, all_asked(missing, work, args.workers), strict=True):
        kept[number] = answers
        if args.keep:
            record = dict(zip(args.modes, map(asdict, answers), strict=True))
            with args.keep.open('a') as file:
                file.write(json.dumps(record) + '\n')
    rows = [kept[number] for number in numbers]
    return dict(zip(args.modes, zip(*rows, strict=True), strict=True))


def main() -> None:
    """Render, solve, and print the tables."""
    parser = argparse.ArgumentParser(description='Ask whether the covariance is right.')
    parser.add_argument('--frames', type=int, default=FRAMES)
    parser.add_argument('--first', type=int, default=0)
    parser.add_argument('--modes', nargs='+', choices=MODES, default=['full', 'motion'])
    parser.add_argument('--workers', type=int, default=1)
    parser.add_argument('--blurs', nargs=2, type=float, default=BLURS)
    parser.add_argument('--vga', action='store_true')
    parser.add_argument('--keep', type=Path)
    parser.add_argument('--plot', type=Path)
    parser.add_argument('--worst', type=Path)
    args = parser.parse_args()
    camera = CAMERA.scaled(640, 480) if args.vga else CAMERA
    shoot = partial(take, blurs=tuple(args.blurs), camera=camera)
    columns = gathered(args, shoot)
    for mode, answers in columns.items():
        printed(mode, answers)
    if args.plot:
        args.plot.write_text(plotted(columns))
    if args.worst:
        draw_worst(columns[args.modes[0]], shoot, args.worst)


if __name__ == '__main__':
    main()
