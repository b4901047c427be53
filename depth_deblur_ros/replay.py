"""Every RGB-D pair of a bag through the solver, the results into another bag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
import json
import os
from pathlib import Path
import tempfile
from typing import Any, TextIO

from depth_deblur_ros.bag import BagReader, BagWriter
from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    check_exposure,
    DeblurResult,
    FloatImage,
    InputError,
    Outcome,
    RgbdFrame,
)
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.core.solver import deblur
from depth_deblur_ros.mcap_file import BagMessage
from depth_deblur_ros.messages import (
    camera_from_msg,
    depth_from_msg,
    header_fields,
    image_from_msg,
    stamp_ns,
)
from depth_deblur_ros.recording import choose_topics, Pair, PairReader, Topics
from depth_deblur_ros.results import motion_record, refused_result, result_messages, TYPES

Solver = Callable[[RgbdFrame, SolverParams], DeblurResult]


MAX_DURATION_S = 1e9


@dataclass(frozen=True, eq=False)
class SolvedPair:
    """A pair with its result; reason says why the solver did not take it, frame what it took."""

    pair: Pair
    frame: RgbdFrame | None
    result: DeblurResult
    reason: str = ''


@dataclass
class ReplaySummary:
    """What became of the frames of a bag."""

    pairs: int = 0
    outcomes: Counter[Outcome] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)  # among the failed, by reason
    dropped: Counter[str] = field(default_factory=Counter)  # colour frames without a pair
    damage: list[str] = field(default_factory=list)  # what could not be read, and where

    def count(self, solved: SolvedPair) -> None:
        """Count one pair."""
        self.pairs += 1
        self.outcomes[solved.result.outcome] += 1
        if solved.reason:
            self.refused[solved.reason] += 1

    @property
    def complete(self) -> bool:
        """Whether no frame failed or was lost."""
        lost = self.outcomes[Outcome.FAILED] + self.dropped.total() + len(self.damage)
        return lost == 0

    def __str__(self) -> str:
        outcomes = ', '.join(f'{self.outcomes[outcome]} {outcome.value}' for outcome in Outcome)
        lines = [f'{self.pairs} pairs: {outcomes}']
        for title, reasons in (('failed', self.refused), ('dropped', self.dropped)):
            lines += [f'{title} {count}: {reason}' for reason, count in reasons.most_common()]
        return '\n'.join([*lines, *(f'damaged: {note}' for note in self.damage)])


def replay(
    bag: Path,
    out: Path,
    *,
    params: SolverParams,
    solve: Solver = deblur,
    camera: CameraIntrinsics | None = None,
    exposure_s: float | None = None,
    topics: Mapping[str, str] | None = None,
    start: float = 0.0,
    duration: float | None = None,
    all_topics: bool = False,
    estimates: Path | None = None,
    progress: Callable[[int, int | None], None] | None = None,
    on_frame: Callable[[RgbdFrame, DeblurResult], None] | None = None,
    overwrite: bool = False,
    sync_slop_s: float = 0.02,
) -> ReplaySummary:
    """
    Solve every pair of bag and write the results to the bag out, which appears when all is done.

    camera counts more than camera_info, an exposure topic more than exposure_s; topics gives names
    for colour, depth, info, exposure; start and duration are seconds from the bag's start;
    all_topics copies the input's messages too; progress is told the frames done and of how many.
    """
    check_exposure(exposure_s)
    if Path(out).resolve() == Path(bag).resolve():
        raise InputError(f'{out} is the bag to read: the results need another name')
    with BagReader(bag) as reader:
        names = choose_topics(reader, topics or {}, with_info=camera is None)
        span = _span(reader, start, duration)
        total = reader.count(names.colour, *span) or None
        with BagWriter(out, overwrite=overwrite) as writer, _lines(estimates) as lines:
            copy = _copier(writer) if all_topics else None
            pairs = PairReader(reader, names, round(sync_slop_s * 1e9), copy)
            summary = ReplaySummary(dropped=pairs.dropped)
            for pair in pairs.pairs(*span):
                solved = solve_pair(pair, camera, exposure_s, params, solve)
                _write(writer, lines, solved)
                summary.count(solved)
                if on_frame and solved.frame and not solved.reason:
                    on_frame(solved.frame, solved.result)
                if progress:
                    progress(summary.pairs + summary.dropped.total(), total)
            summary.damage = reader.damage
            _check_some_solved(summary, pairs, names)
    return summary


def solve_pair(
    pair: Pair,
    camera: CameraIntrinsics | None,
    exposure_s: float | None,
    params: SolverParams,
    solve: Solver = deblur,
) -> SolvedPair:
    """Solve one pair; what cannot be solved is failed, with the reason and its image as it was."""
    frame = None
    try:
        frame = frame_from_pair(pair, camera, exposure_s)
        return SolvedPair(pair, frame, solve(frame, params))
    except InputError as error:
        image, depth = (frame.image, frame.depth) if frame else (_image(pair.colour), None)
        return SolvedPair(pair, frame, refused_result(image, depth), str(error))


def frame_from_pair(
    pair: Pair, camera: CameraIntrinsics | None = None, exposure_s: float | None = None
) -> RgbdFrame:
    """Read a pair; the camera given counts more than camera_info, the exposure given less."""
    return RgbdFrame(
        image=image_from_msg(pair.colour),
        depth=depth_from_msg(pair.depth),
        camera=camera or camera_from_msg(pair.info),
        exposure=exposure_s if pair.exposure is None else pair.exposure,
        stamp_ns=stamp_ns(pair.colour.header),
    )


def _image(msg: Any) -> FloatImage | None:
    try:
        return image_from_msg(msg)
    except InputError:
        return None


def _span(reader: BagReader, start: float, duration: float | None) -> tuple[int, int | None]:
    """Give the log times [ns] to read, from seconds after the bag's start."""
    length = (reader.end_ns - reader.start_ns) / 1e9
    if not 0 <= start <= length:
        raise InputError(
            f'start must lie in [0, {length:.3f}] s, the length of the bag, got {start}'
        )
    if duration is not None and not 0 < duration < MAX_DURATION_S:
        raise InputError(f'duration must lie in (0, {MAX_DURATION_S:g}) s, got {duration}')
    start_ns = reader.start_ns + round(start * 1e9)
    return start_ns, None if duration is None else start_ns + round(duration * 1e9)


def _copier(writer: BagWriter) -> Callable[[BagMessage], None]:
    results = {f'/{topic}' for topic in TYPES}

    def copy(message: BagMessage) -> None:
        if message.topic.name not in results:
            writer.copy(message)

    return copy


def _write(writer: BagWriter, lines: TextIO | None, solved: SolvedPair) -> None:
    pair, frame, result = solved.pair, solved.frame, solved.result
    stamp, exposure = stamp_ns(pair.colour.header), frame.exposure if frame else None
    header = header_fields(stamp, pair.colour.header.frame_id)
    camera = frame.camera if frame else None
    for topic, fields in result_messages(result, camera, exposure, header, solved.reason):
        writer.write(f'/{topic}', TYPES[topic], fields, pair.log_ns)
    if lines:
        lines.write(json.dumps(motion_record(result, stamp, exposure)) + '\n')


@contextmanager
def _lines(path: Path | None) -> Iterator[TextIO | None]:
    """Give a text file that takes its name when all is written."""
    if path is None:
        yield None
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        handle, hidden = tempfile.mkstemp(prefix=f'.{path.name}.', dir=path.parent, text=True)
    except OSError as error:
        raise InputError(f'cannot write {path}: {error.strerror}') from error
    try:
        with open(handle, 'w', encoding='utf-8') as file:
            yield file
        os.replace(hidden, path)
    except BaseException:
        os.unlink(hidden)
        raise


def _check_some_solved(summary: ReplaySummary, pairs: PairReader, names: Topics) -> None:
    """Refuse a bag of which nothing could be used: that is bad input, not a failed frame."""
    damage = ''.join(f'; {note}' for note in summary.damage)
    if not summary.pairs and pairs.nearest_miss_s is not None:
        raise InputError(
            f'no colour frame on {names.colour} has a depth on {names.depth} within '
            f'{pairs.slop_s:g} s: the nearest is {pairs.nearest_miss_s:g} s away{damage}'
        )
    if not summary.pairs:
        dropped = ''.join(f'; {n} x {reason}' for reason, n in summary.dropped.items())
        raise InputError(f'no pair on {names.colour} and {names.depth}{dropped}{damage}')
    if summary.refused.total() == summary.pairs:
        reason = summary.refused.most_common(1)[0][0]
        raise InputError(f'none of the {summary.pairs} pairs can be solved: {reason}')
