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
from typing import TextIO

from depth_deblur_ros.bag import BagReader, BagWriter
from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    check_exposure,
    DeblurResult,
    InputError,
    Outcome,
    RgbdFrame,
)
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.core.solver import deblur
from depth_deblur_ros.frames import Given, solve_anyhow, SolvedPair, Solver
from depth_deblur_ros.mcap_file import BagMessage
from depth_deblur_ros.messages import stamp_ns
from depth_deblur_ros.recording import choose_topics, PairReader, Topics
from depth_deblur_ros.results import motion_record, TYPES

MAX_DURATION_S = 1e9


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
                solved = solve_anyhow(pair, Given(camera, exposure_s), params, solve)
                _write(writer, lines, solved)
                summary.count(solved)
                if on_frame and solved.frame and not solved.reason:
                    on_frame(solved.frame, solved.result)
                if progress:
                    progress(summary.pairs + summary.dropped.total(), total)
            summary.damage = reader.damage
            _check_some_solved(summary, pairs, names)
    return summary


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
    end_ns = None if duration is None else start_ns + round(duration * 1e9)
    return start_ns if start else 0, end_ns  # the times of a damaged bag are not to be trusted


def _copier(writer: BagWriter) -> Callable[[BagMessage], None]:
    results = {f'/{topic}' for topic in TYPES}

    def copy(message: BagMessage) -> None:
        if message.topic.name not in results:
            writer.copy(message)

    return copy


def _write(writer: BagWriter, lines: TextIO | None, solved: SolvedPair) -> None:
    for topic, fields in solved.messages():
        writer.write(f'/{topic}', TYPES[topic], fields, solved.pair.log_ns)
    if lines:
        stamp = stamp_ns(solved.pair.colour.header)
        exposure = solved.frame.exposure if solved.frame else None
        lines.write(json.dumps(motion_record(solved.result, stamp, exposure)) + '\n')


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
