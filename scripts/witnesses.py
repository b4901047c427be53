"""
Ask the witnesses that need no truth about real frames: reblur residual, ringing, and the score.

usage: python scripts/witnesses.py FOLDER [--workers N]

FOLDER is in the format of the TUM data set, with a camera.json. Each frame is solved by itself;
then it is restored once more under motions that are wrong: half as long again, and turned by a
right angle. Prints a table of medians over the solved frames:

residual: how far the blurred result is from the frame, root mean square [grey levels];
ringing: differences from the surroundings (sigma 4 px) in the flattest part of the frame, in the
  result over the frame;
and in how many of the frames the wrong motion has more of it than the one that was found.
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
import math
from pathlib import Path

import cv2
from depth_deblur_ros.core.data import DeblurResult, FloatImage, Motion, Outcome, RgbdFrame
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.core.solver import deblur, restore_known
from depth_deblur_ros.folders import read_frame
from depth_deblur_ros.misfit import energies_of
from depth_deblur_ros.tum import tum_pairs, TumPair
import numpy as np

SURROUNDINGS, SMOOTH, FLAT = 4.0, 3.0, 30  # px, px, percent
FOUND = 'as found'
Witnesses = dict[str, tuple[float, float]]


def wrong_motions(motion: Motion) -> Mapping[str, Motion]:
    """Give motions that are wrong: by their length, and by their direction."""
    longer = Motion(1.5 * motion.theta, 1.5 * motion.v, rolling=1.5 * motion.rolling)
    turn = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]])
    turned = Motion(turn @ motion.theta, turn @ motion.v, rolling=turn @ motion.rolling)
    return {'half as long again': longer, 'turned by 90 degrees': turned}


def residual(frame: RgbdFrame, result: DeblurResult) -> float:
    """Give the root mean square [grey levels] of the blurred result minus the frame."""
    return math.sqrt(2 * energies_of(frame, result, 0.0)[-1].terms['misfit'])


def ringing(frame: RgbdFrame, result: DeblurResult) -> float:
    """Give how much more the flat parts differ from their surroundings than before."""
    smooth = cv2.GaussianBlur(frame.image.mean(2), (0, 0), SMOOTH)
    steep = np.hypot(*np.gradient(smooth))
    flat = steep <= np.percentile(steep, FLAT)
    before, after = (_detail(image.mean(2))[flat] for image in (frame.image, result.image))
    return float(np.sqrt(np.square(after).mean() / max(np.square(before).mean(), 1e-12)))


def _detail(grey: FloatImage) -> FloatImage:
    return np.asarray(grey - cv2.GaussianBlur(grey, (0, 0), SURROUNDINGS))


def asked(pair: TumPair, folder: Path) -> tuple[Outcome, float, Witnesses]:
    """Solve a frame; its outcome, its quality and what the witnesses say of each motion."""
    frame = read_frame(pair.rgb, pair.depth, folder / 'camera.json')
    params = SolverParams(threads=1)
    result = deblur(frame, params)
    if result.outcome is not Outcome.SOLVED:
        return result.outcome, result.quality, {}
    told = {FOUND: (residual(frame, result), ringing(frame, result))}
    for name, motion in wrong_motions(result.motion).items():
        image = restore_known(frame, motion, params).image
        other = replace(result, motion=motion, image=image)
        told[name] = residual(frame, other), ringing(frame, other)
    return result.outcome, result.quality, told


def main() -> None:
    """Ask about all frames of a folder and print the table."""
    parser = argparse.ArgumentParser(description='Ask about frames whose truth is not known.')
    parser.add_argument('folder', type=Path)
    parser.add_argument('--workers', type=int, default=1)
    args = parser.parse_args()
    pairs = tum_pairs(args.folder)
    with ProcessPoolExecutor(args.workers) as pool:
        answers = list(pool.map(partial(asked, folder=args.folder), pairs))
    told = [witnesses for _, _, witnesses in answers if witnesses]
    quality = np.median([own for outcome, own, _ in answers if outcome is Outcome.SOLVED])
    print(f'{len(pairs)} frames, {len(told)} solved, quality {quality:.2f}')
    print('| motion | residual | more | ringing | more |\n|---|---|---|---|---|')
    own = np.array([witnesses[FOUND] for witnesses in told])
    for name in told[0]:
        found = np.array([witnesses[name] for witnesses in told])
        more, (left, rings) = (found > own).sum(0), np.median(found, 0)
        print(f'| {name} | {left:.2f} | {more[0]} | {rings:.2f} | {more[1]} |')


if __name__ == '__main__':
    main()
