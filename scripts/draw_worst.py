"""
Draw the cases that `depth-deblur bench` did worst on: what was found above, the truth below.

usage: python scripts/draw_worst.py CASES TABLE.json -o FOLDER [--count N]

TABLE.json is what bench (or bench_robust.py) left of these cases. Each picture shows blurred,
restored, and depth with the flow: solved again in the upper row, with the true motion known in
the lower. The cases with the largest share of wrong pixels come first, then by flow error.
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path

from depth_deblur_ros.bench import CASE_FILES, read_motion
from depth_deblur_ros.core.data import Motion, RgbdFrame
from depth_deblur_ros.core.solver import deblur, restore_known
from depth_deblur_ros.folders import read_frame, write_image
from depth_deblur_ros.report import draw_frame
import numpy as np
import numpy.typing as npt

COUNT = 5


def both_ways(frame: RgbdFrame, motion: Motion) -> npt.NDArray[np.uint8]:
    """Draw a frame as it is solved, and below with its true motion known."""
    return np.vstack(
        [draw_frame(frame, deblur(frame)), draw_frame(frame, restore_known(frame, motion))]
    )


def worst_cases(table: Path, count: int) -> list[str]:
    """Name the cases of a table that have most wrong pixels, or else the largest flow error."""
    rows = [row for row in json.loads(table.read_text())['cases'] if row['score']]
    rows.sort(key=lambda row: (row['score']['bad'], row['score']['epe']), reverse=True)
    return [row['case'] for row in rows[:count]]


def main() -> None:
    """Draw them, the worst first."""
    parser = argparse.ArgumentParser(description='Draw the worst cases of a bench.')
    parser.add_argument('cases', type=Path)
    parser.add_argument('table', type=Path)
    parser.add_argument('-o', '--out', type=Path, required=True)
    parser.add_argument('--count', type=int, default=COUNT)
    args = parser.parse_args()
    for rank, name in enumerate(worst_cases(args.table, args.count), 1):
        case = args.cases / name
        picture = both_ways(
            read_frame(*(case / file for file in CASE_FILES)),
            read_motion(case / 'truth/motion.json'),
        )
        write_image(args.out / f'{rank}_{name}.jpg', picture)
        print(args.out / f'{rank}_{name}.jpg')


if __name__ == '__main__':
    main()
