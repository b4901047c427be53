"""
Quality on cases whose truth is known: PSNR, SSIM and the error of the flow over the exposure.

A case is a folder with rgb.png, depth.png and camera.json; truth/ beside them, where there, holds
sharp.png, depth.png and motion.json (theta, v). A case's tier is its name up to the first '-'.
One blurred image does not tell the sign of the motion, so the better sign counts.
[WBSS04] Wang, Bovik, Sheikh & Simoncelli, IEEE Trans. Image Processing 13, 2004: SSIM.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, fields
import json
import math
from pathlib import Path

from depth_deblur_ros.core.data import DeblurResult, FloatImage, InputError, Motion, RgbdFrame
from depth_deblur_ros.core.geometry import warp
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.core.solver import deblur, restore_known
from depth_deblur_ros.folders import read_frame, write_image, write_json, write_text
from depth_deblur_ros.results import motion_record
import numpy as np
import numpy.typing as npt
from scipy.ndimage import uniform_filter

Image8 = npt.NDArray[np.uint8]

CASE_FILES = ('rgb.png', 'depth.png', 'camera.json')
BAD_PX, BAD_SHARE = 3.0, 0.05  # a pixel's flow is bad when off by more than both, as in KITTI
PSNR_LIMIT = 99.0  # dB, of two equal images


@dataclass(frozen=True)
class Score:
    """How far a result is from the truth; *_in is what the blurred input scores."""

    blur_px: float  # mean length of the true blur
    psnr_in: float  # dB, 8 bit, whole image
    psnr: float
    ssim_in: float
    ssim: float
    epe: float  # px, mean end-point error of the flow over the exposure
    bad: float  # %, pixels whose flow is bad


@dataclass(frozen=True)
class Row:
    """One case: what became of it, and its score where the truth is known."""

    case: str
    outcome: str  # as in motion.json; 'error' when the case could not be read
    seconds: float | None = None
    score: Score | None = None
    error: str | None = None

    @property
    def tier(self) -> str:
        """The case's name up to the first '-'."""
        return self.case.split('-')[0]


def find_cases(folder: Path) -> list[Path]:
    """List the sub-folders that hold at least one of a case's files, by name."""
    if not folder.is_dir():
        raise InputError(f'{folder} is not a folder of cases')
    cases = [
        f for f in sorted(folder.iterdir()) if any((f / name).exists() for name in CASE_FILES)
    ]
    if not cases:
        raise InputError(f'{folder} holds no case (a folder with {", ".join(CASE_FILES)})')
    return cases


def solve_cases(
    cases: Sequence[Path], results: Path, params: SolverParams, *, oracle: bool = False
) -> Iterator[Row]:
    """Solve case by case, with the true motion if oracle; a broken case gives a row too."""
    for case in cases:
        try:
            yield _solve_case(case, results / case.name, params, oracle=oracle)
        except InputError as error:
            yield Row(case.name, 'error', error=str(error))


def _solve_case(case: Path, target: Path, params: SolverParams, *, oracle: bool) -> Row:
    frame = read_frame(*(case / name for name in CASE_FILES))
    if oracle:
        result = restore_known(frame, read_motion(case / 'truth/motion.json'), params)
    else:
        result = deblur(frame, params)
    write_image(target / 'deblurred.png', result.image)
    write_json(target / 'motion.json', motion_record(result, frame.stamp_ns, frame.exposure))
    score = _score(case, frame, result) if (case / 'truth').is_dir() else None
    return Row(case.name, result.outcome.value, result.seconds, score)


def _score(case: Path, frame: RgbdFrame, result: DeblurResult) -> Score:
    """Compare a result with the case's truth."""
    truth = read_frame(case / 'truth/sharp.png', case / 'truth/depth.png', case / 'camera.json')
    motion = read_motion(case / 'truth/motion.json')
    sharp, blurred, found = (_as_8bit(image) for image in (truth.image, frame.image, result.image))
    epe, bad = flow_error(truth, motion, result.motion)
    return Score(
        blur_px=flow_error(truth, motion, Motion(np.zeros(3), np.zeros(3)))[0],
        psnr_in=psnr(blurred, sharp),
        psnr=psnr(found, sharp),
        ssim_in=ssim(blurred, sharp),
        ssim=ssim(found, sharp),
        epe=epe,
        bad=bad,
    )


def read_motion(path: Path) -> Motion:
    """Read the motion that a truth/motion.json tells."""
    try:
        record = json.loads(path.read_text())
        return Motion(record['theta'], record['v'])
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror}') from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f'{path} must be JSON with theta [rad] and v [m]: {error}') from error


def _as_8bit(image: FloatImage) -> Image8:
    """Give the image (H, W, C) as it stands in a PNG."""
    return np.atleast_3d(np.rint(255 * image)).astype(np.uint8)


def mean_row(rows: Sequence[Row]) -> Row:
    """Average the rows that have a score; the outcome counts the outcomes of all."""
    scores = [row.score for row in rows if row.score]
    counts = {o: sum(r.outcome == o for r in rows) for o in sorted({r.outcome for r in rows})}
    seconds = [row.seconds for row in rows if row.seconds is not None]
    return Row(
        case=f'{rows[0].tier} MEAN ({len(scores)})',
        outcome=', '.join(f'{count} {outcome}' for outcome, count in counts.items()),
        seconds=float(np.mean(seconds)) if seconds else None,
        score=Score(*np.mean([list(asdict(s).values()) for s in scores], 0)) if scores else None,
    )


def with_means(rows: Sequence[Row]) -> list[Row]:
    """Give the rows tier by tier, each tier followed by its mean."""
    table = []
    for tier in sorted({row.tier for row in rows}):
        members = [row for row in rows if row.tier == tier]
        table += [*members, mean_row(members)]
    return table


def table_head() -> str:
    """Give the line above the rows of a printed table."""
    names = [f.name for f in fields(Score)]
    return f'{"case":<34}' + ''.join(f'{name:>9}' for name in [*names, 'seconds']) + '  outcome'


def table_line(row: Row) -> str:
    """Give one row of a printed table."""
    return f'{row.case[:33]:<34}' + ''.join(f'{c:>9}' for c in _cells(row)) + f'  {_ending(row)}'


def write_tables(rows: Sequence[Row], results: Path) -> None:
    """Write RESULTS/table.json and RESULTS/table.md."""
    write_json(results / 'table.json', {'cases': [asdict(row) for row in rows]})
    names = ['case', *(f.name for f in fields(Score)), 'seconds', 'outcome']
    lines = [f'| {" | ".join(names)} |', '|---' + '|--:' * (len(names) - 2) + '|---|']
    for row in with_means(rows):
        lines.append(f'| {" | ".join([row.case, *_cells(row), _ending(row)])} |')
    write_text(results / 'table.md', '\n'.join(lines) + '\n')


def psnr(a: Image8, b: Image8) -> float:
    """Give the peak signal-to-noise ratio [dB] of two 8-bit images."""
    error = float(np.mean((a / 255.0 - b / 255.0) ** 2))
    return min(-10 * math.log10(max(error, 1e-10)), PSNR_LIMIT)


def ssim(a: Image8, b: Image8) -> float:
    """Give the structural similarity of two 8-bit colour images, the mean over the channels."""
    side = 7  # px, window; [WBSS04] (13) with its constants and the sample covariance
    c1, c2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2
    x, y = a.astype(np.float64), b.astype(np.float64)

    def local(u: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        mean: npt.NDArray[np.float64] = uniform_filter(u, (side, side, 1))
        return mean

    mx, my, unbias = local(x), local(y), side**2 / (side**2 - 1)
    vx, vy, cov = (
        unbias * (local(p) - q) for p, q in ((x * x, mx * mx), (y * y, my * my), (x * y, mx * my))
    )
    s = (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    rim = side // 2
    return float(s[rim:-rim, rim:-rim].mean())


def flow_error(truth: RgbdFrame, true: Motion, found: Motion) -> tuple[float, float]:
    """Give the mean end-point error [px] and the share of bad pixels [%], for the better sign."""
    known = np.isfinite(truth.depth)
    flow = _exact_flow(truth, true)[known]
    errors = []
    for sign in (1, -1):
        miss = flow - _exact_flow(truth, Motion(sign * found.theta, sign * found.v))[known]
        e = np.hypot(miss[:, 0], miss[:, 1])
        bad = (e > BAD_PX) & (e > BAD_SHARE * np.hypot(flow[:, 0], flow[:, 1]))
        errors.append((float(e.mean()), 100 * float(bad.mean())))
    return min(errors)


def _exact_flow(frame: RgbdFrame, motion: Motion) -> npt.NDArray[np.float64]:
    start, end = (warp(motion.vector, t, frame.depth, frame.camera) for t in (-0.5, 0.5))
    return end - start


def _cells(row: Row) -> list[str]:
    values = asdict(row.score).values() if row.score else [None] * len(fields(Score))
    return ['-' if value is None else f'{value:.3f}' for value in (*values, row.seconds)]


def _ending(row: Row) -> str:
    return f'{row.outcome}: {row.error}' if row.error else row.outcome
