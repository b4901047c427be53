"""
Ask what damage does to the blind solver: the cases of `depth-deblur bench`, changed, once more.

usage: python scripts/bench_robust.py CASES -o OUT [--changes NAME ...], and what bench takes

Prints one row for each change: mean flow error and bad pixels of the blurred cases (1 px or more),
what became of all cases, the farthest motion, and the gain in PSNR over the changed input: mean of
the blurred cases and worst of all. OUT/inputs/CHANGE holds the changed cases, OUT/CHANGE results.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
import json
from pathlib import Path
from typing import Any

import cv2
from depth_deblur_ros import bench
from depth_deblur_ros.core.data import Outcome
from depth_deblur_ros.core.light import light_from_stored, stored_from_light
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.flags import Parser, solver_flags, solver_params
import numpy as np
import numpy.typing as npt

BLURRED = 1.0  # px
SHIFT = (8, 3)  # px to the right and down
QUALITY = 60  # of JPEG
Pixels = npt.NDArray[Any]


@dataclass(frozen=True, eq=False)
class Case:
    """What a folder holds: blurred and sharp BGR uint8, stored depth uint16, transfer, motion."""

    blurred: Pixels
    sharp: Pixels
    depth: Pixels
    transfer: str
    motion: dict[str, Any]


def noisy(case: Case, share: float) -> Case:
    """Add noise of this share of the full range, the same each time."""
    noise = np.random.default_rng(0).normal(0, 255 * share, case.blurred.shape)
    return replace(case, blurred=_as_8bit(case.blurred + noise))


def overexposed(case: Case) -> Case:
    """Let twice the light in, before and after the blur."""

    def twice(pixels: Pixels) -> Pixels:
        light = light_from_stored((pixels / np.float32(255)).astype(np.float32), case.transfer)
        return _as_8bit(255 * stored_from_light(np.minimum(2 * light, 1), case.transfer))

    return replace(case, blurred=twice(case.blurred), sharp=twice(case.sharp))


def compressed(case: Case) -> Case:
    """Write the picture as JPEG and read it again."""
    _, data = cv2.imencode('.jpg', case.blurred, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    return replace(case, blurred=cv2.imdecode(data, cv2.IMREAD_UNCHANGED))


def shifted(case: Case) -> Case:
    """Put the depth beside its place; what it leaves is a hole."""
    moved = np.zeros_like(case.depth)
    moved[SHIFT[1] :, SHIFT[0] :] = case.depth[: -SHIFT[1], : -SHIFT[0]]
    return replace(case, depth=moved)


def still(case: Case) -> Case:
    """Take the sharp picture, which knows no motion."""
    return replace(case, blurred=case.sharp, motion={'theta': [0, 0, 0], 'v': [0, 0, 0]})


CHANGES: dict[str, Callable[[Case], Case]] = {
    'clean': lambda case: case,
    'noise-1': lambda case: noisy(case, 0.01),
    'noise-2': lambda case: noisy(case, 0.02),
    'overexposed': overexposed,
    'jpeg': compressed,
    'depth-shift': shifted,
    'sharp': still,
}


def _as_8bit(values: npt.NDArray[np.floating[Any]]) -> Pixels:
    return np.rint(np.clip(values, 0, 255)).astype(np.uint8)


def read_case(folder: Path) -> Case:
    """Read a case whose truth is known."""
    names = ('rgb.png', 'truth/sharp.png', 'depth.png')
    pictures = [cv2.imread(str(folder / name), cv2.IMREAD_UNCHANGED) for name in names]
    camera, motion = (
        json.loads((folder / name).read_text()) for name in ('camera.json', 'truth/motion.json')
    )
    return Case(*pictures, camera['transfer'], motion)


def write_case(folder: Path, source: Path, case: Case) -> None:
    """Write a changed case, with camera and true depth of its source."""
    (folder / 'truth').mkdir(parents=True, exist_ok=True)
    for name in ('camera.json', 'truth/depth.png'):
        (folder / name).write_bytes((source / name).read_bytes())
    cv2.imwrite(str(folder / 'rgb.png'), case.blurred)
    cv2.imwrite(str(folder / 'truth/sharp.png'), case.sharp)
    cv2.imwrite(str(folder / 'depth.png'), case.depth)
    (folder / 'truth/motion.json').write_text(json.dumps(case.motion))


def solved(cases: list[Path], name: str, out: Path, params: SolverParams) -> list[bench.Row]:
    """Solve all cases under one change."""
    copies = []
    for source in cases:
        copies.append(out / 'inputs' / name / source.name)
        write_case(copies[-1], source, CHANGES[name](read_case(source)))
    rows = list(bench.solve_cases(copies, out / name, params))
    bench.write_tables(rows, out / name)
    return rows


def line(name: str, rows: list[bench.Row]) -> str:
    """Give one row of the table."""
    scores = {row.case: row.score for row in rows if row.score}
    blurred = [s for s in scores.values() if s.blur_px >= BLURRED] or list(scores.values())
    gains = {case: score.psnr - score.psnr_in for case, score in scores.items()}
    epe, bad, gain = np.mean([(s.epe, s.bad, s.psnr - s.psnr_in) for s in blurred], 0)
    far = max(scores, key=lambda case: scores[case].epe)
    worst = min(gains, key=lambda case: gains[case])
    counts = [str(sum(row.outcome == outcome for row in rows)) for outcome in Outcome]
    return (
        f'| {name} | {epe:.2f} | {bad:.1f} | {" / ".join(counts)} | {scores[far].epe:.1f} ({far}) '
        f'| {gain:+.2f} | {gains[worst]:+.2f} ({worst}) |'
    )


def main() -> None:
    """Print the table."""
    parser = Parser(description='Ask what damage does to the solver.')
    parser.add_argument('cases', type=Path)
    parser.add_argument('-o', '--out', type=Path, required=True)
    parser.add_argument('--changes', nargs='+', choices=CHANGES, default=list(CHANGES))
    solver_flags(parser)
    args = parser.parse_args()
    cases = [case for case in bench.find_cases(args.cases) if (case / 'truth').is_dir()]
    outcomes = ' / '.join(Outcome)
    heads = ('change', 'epe px', 'bad %', outcomes, 'farthest px', 'gain dB', 'worst dB')
    print(f'| {" | ".join(heads)} |\n{"|---" * len(heads)}|')
    for name in args.changes:
        print(line(name, solved(cases, name, args.out, solver_params(args))), flush=True)


if __name__ == '__main__':
    main()
