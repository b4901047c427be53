"""
Ask whether the covariance of the motion is right, on rendered frames with known motion.

usage: python scripts/calibrate.py [--frames N] [--mode MODE] [--plot FILE.svg]

Rooms, paths and blurs (2 to 40 px) are drawn anew for each frame, from numbers that nothing else
in the project uses. Prints, for each axis of the motion, how many of the true motions lie within
one and three standard deviations of what was solved, but for the sign; the plot tells it for all
numbers of deviations.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
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
import numpy as np
import numpy.typing as npt
from scene import make_scene
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
Array = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Shot:
    """One rendered frame, its true motion and mean blur [px]."""

    frame: RgbdFrame
    motion: Motion
    blur: float


def take(number: int) -> Shot:
    """Render a frame."""
    rng = np.random.default_rng([FIRST_PATH, number])
    scene = make_scene(FIRST_ROOM + number // PER_ROOM)
    middle, exposure = rng.uniform(0, 10), rng.uniform(*EXPOSURES)
    speeds = np.array([rng.uniform(0.3, 1.5), rng.uniform(0.1, 0.8)])
    wanted = np.exp(rng.uniform(*np.log(BLURS)))
    for _ in range(2):  # the second time as fast as makes that blur
        path = hand_held(FIRST_PATH + number, *speeds)
        pose, motion = path.pose(middle), true_motion(path, middle, exposure)
        view = scene.depth(CAMERA, pose)
        length = blur_length(motion.vector, view.depth, CAMERA)
        speeds *= min(wanted / length, FASTEST)
    light = render_blurred(scene, CAMERA, path, middle, exposure, least=LEAST_VIEWS)
    colour = (photograph(light, rng) / 255).astype(np.float32)
    depth = depth_picture(view, scene.light(CAMERA, pose), rng).astype(np.float32) / 1000
    depth[depth == 0] = np.nan
    return Shot(RgbdFrame(colour, depth, CAMERA), motion, length)


def deviations(shot: Shot, result: DeblurResult) -> tuple[Array, float]:
    """Give the error of each axis (6,) in standard deviations, and of the flow [px]."""
    found, true, depth = result.motion, shot.motion.vector, result.depth
    misses = [blur_length(found.vector - s * true, depth, CAMERA) for s in (1, -1)]
    sign = 1 if misses[0] <= misses[1] else -1
    assert found.covariance is not None
    spread = np.sqrt(np.diag(found.covariance))
    return np.asarray((found.vector - sign * true) / spread), min(misses)


def plotted(errors: Array) -> str:
    """Draw the share of errors (n, 6) within so many deviations, as it is and as it should be."""
    at = np.linspace(0, 4, 81)
    panels = []
    for k, name in enumerate(AXES):
        within = (np.abs(errors[:, k, None]) <= at).mean(0)
        curves = (
            Curve('errors', at, within),
            Curve('normal distribution', at, 2 * norm.cdf(at) - 1, colour=4),
        )
        panels.append(Panel(name, curves, 'standard deviations', 'share'))
    title = f'share of {len(errors)} frames whose error lies within so many standard deviations'
    return chart(panels, 3, title)


def main() -> None:
    """Render, solve, and print the table."""
    parser = argparse.ArgumentParser(description='Ask whether the covariance is right.')
    parser.add_argument('--frames', type=int, default=FRAMES)
    parser.add_argument('--mode', choices=MODES, default='full')
    parser.add_argument('--plot', type=Path)
    args = parser.parse_args()
    params, errors, misses = SolverParams(mode=args.mode), [], []
    outcomes = dict.fromkeys(Outcome, 0)
    for number in range(args.frames):
        shot = take(number)
        result = deblur(shot.frame, params)
        outcomes[result.outcome] += 1
        if result.outcome is Outcome.SOLVED:
            error, miss = deviations(shot, result)
            errors.append(error)
            misses.append(miss)
    print(', '.join(f'{count} {outcome}' for outcome, count in outcomes.items()))
    print(f'flow error {np.mean(misses):.2f} px, median {np.median(misses):.2f} px')
    far = np.abs(errors)
    for k, name in enumerate(AXES):
        within = [100 * (far[:, k] <= bound).mean() for bound in (1, 3)]
        print(f'{name:8s} within 1 sigma {within[0]:5.1f} %, within 3 sigma {within[1]:5.1f} %')
    if args.plot:
        args.plot.write_text(plotted(np.array(errors)))


if __name__ == '__main__':
    main()
