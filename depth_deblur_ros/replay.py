"""Every RGB-D pair of a bag through the solver, the results into another bag."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
import json
import os
from pathlib import Path
import tempfile
from typing import Any

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
from depth_deblur_ros.frames import Given, Pair, solve_anyhow
from depth_deblur_ros.journal import checksum, Done, Journal
from depth_deblur_ros.mcap_file import BagMessage
from depth_deblur_ros.messages import stamp_ns
from depth_deblur_ros.recording import choose_topics, PairReader, Topics
from depth_deblur_ros.results import motion_record, TYPES
from depth_deblur_ros.tracking import Solver, Tracker

MAX_DURATION_S = 1e9


@dataclass
class ReplaySummary:
    """What became of the frames of a bag."""

    pairs: int = 0
    outcomes: Counter[Outcome] = field(default_factory=Counter)
    refused: Counter[str] = field(default_factory=Counter)  # among the failed, by reason
    dropped: Counter[str] = field(default_factory=Counter)  # colour frames without a pair
    unread: Counter[str] = field(default_factory=Counter)  # other messages, by topic
    damage: list[str] = field(default_factory=list)  # what could not be read, and where

    def count(self, outcome: str, reason: str) -> None:
        """Count one pair; reason says why the solver did not take it."""
        self.pairs += 1
        self.outcomes[Outcome(outcome)] += 1
        if reason:
            self.refused[reason] += 1

    @property
    def complete(self) -> bool:
        """Whether no frame failed or was lost."""
        lost = self.outcomes[Outcome.FAILED] + self.dropped.total() + self.unread.total()
        return lost + len(self.damage) == 0

    def __str__(self) -> str:
        outcomes = ', '.join(f'{self.outcomes[outcome]} {outcome.value}' for outcome in Outcome)
        lines = [f'{self.pairs} pairs: {outcomes}']
        for title, reasons in (('failed', self.refused), ('dropped', self.dropped)):
            lines += [f'{title} {count}: {reason}' for reason, count in reasons.most_common()]
        lines += [f'unreadable {count}: {topic}' for topic, count in self.unread.most_common()]
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
    on_frame: Callable[[int, RgbdFrame, DeblurResult], None] | None = None,
    overwrite: bool = False,
    resume: bool = False,
    sync_slop_s: float = 0.02,
) -> ReplaySummary:
    """
    Solve every pair of bag and write the results to the bag out, which appears when all is done.

    camera counts more than camera_info, an exposure topic more than exposure_s; topics gives names
    for colour, depth, info, exposure; start and duration are seconds from the bag's start;
    all_topics copies the input's messages too; progress is told the frames done and of how many;
    on_frame is given the frames that were solved now, with their numbers; resume goes on behind
    the last pair of a run of the same kind that was killed.
    """
    check_exposure(exposure_s)
    if Path(out).resolve() == Path(bag).resolve():
        raise InputError(f'{out} is the bag to read: the results need another name')
    target = BagWriter(out, overwrite=overwrite)
    _check_place(estimates)
    given = Given(camera, exposure_s, params.rectified)
    with BagReader(bag) as reader:
        names = choose_topics(reader, topics or {}, with_info=camera is None)
        span = _span(reader, start, duration)
        total = reader.count(names.colour, *span) or None
        facts = _facts(reader, params, given) | {
            'topics': asdict(names),
            'span': span,
            'all_topics': all_topics,
            'sync_slop_s': sync_slop_s,
        }
        with (
            Journal(out, facts, resume=resume) as journal,
            target.inside(journal.folder) as writer,
        ):
            copy = _copier(writer) if all_topics else None
            tracker = Tracker(solve)
            slop_ns = round(sync_slop_s * 1e9)
            pairs = PairReader(reader, names, slop_ns, copy, on_imu=tracker.gyro.take)
            summary = ReplaySummary(dropped=pairs.dropped, unread=pairs.unread)
            work = _Work(writer, journal, tracker, params, given, on_frame)
            for pair, following in _with_next(pairs.pairs(*span)):
                done = work.finish(pair, following)
                summary.count(done.record['outcome'], done.reason)
                if progress:
                    progress(summary.pairs + summary.dropped.total(), total)
            summary.damage = reader.damage
            _check_some_solved(summary, pairs, names)
            _write_estimates(estimates, journal)
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


@dataclass
class _Work:
    """What is done with each pair: solved, written and noted, or taken from an earlier attempt."""

    writer: BagWriter
    journal: Journal
    tracker: Tracker
    params: SolverParams
    given: Given
    on_frame: Callable[[int, RgbdFrame, DeblurResult], None] | None
    _drawn: int = 0

    def finish(self, pair: Pair, following: Pair | None) -> Done:
        """Do one pair, so that it need not be done again."""
        found = self.journal.done_before()
        if found:
            done, messages = found
            for message in messages:
                topic = message.topic
                self.writer.write_bytes(topic.name, topic.type, message.data, pair.log_ns)
        else:
            if self.journal.count == self.journal.earlier > 0:
                self.tracker.restore(self.journal.state)
            done = self._solved(pair, following)
        self._drawn += done.drawn
        self.writer.flush()
        self.journal.add(done, None if found else self.tracker.state())
        return done

    def _solved(self, pair: Pair, following: Pair | None) -> Done:
        solved = solve_anyhow(pair, self.given, self.params, self.tracker, following)
        sent = [
            self.writer.write(f'/{topic}', TYPES[topic], fields, pair.log_ns)
            for topic, fields in solved.messages()
        ]
        if self.on_frame and solved.frame and not solved.reason:
            self.on_frame(self._drawn, solved.frame, solved.result)
        exposure = solved.frame.exposure if solved.frame else None
        record = motion_record(solved.result, stamp_ns(pair.colour.header), exposure)
        drawn = solved.frame is not None and not solved.reason
        return Done(record, solved.reason, drawn, checksum(sent))


def _with_next(pairs: Iterator[Pair]) -> Iterator[tuple[Pair, Pair | None]]:
    """Give each pair with the one that follows it."""
    pair = next(pairs, None)
    while pair is not None:
        following = next(pairs, None)
        yield pair, following
        pair = following


def _facts(reader: BagReader, params: SolverParams, given: Given) -> dict[str, Any]:
    """Give what the results depend on."""
    files = [(file.name, file.stat().st_size, file.stat().st_mtime_ns) for file in reader.files]
    return {'bag': files, 'parameters': asdict(params), 'given': asdict(given)}


def _check_place(path: Path | None) -> None:
    """Refuse a place for estimates that cannot be written, before any work."""
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=path.parent).close()
    except OSError as error:
        raise InputError(f'cannot write {path}: {error.strerror}') from error
    if path.is_dir():
        raise InputError(f'cannot write {path}: it is a folder')


def _write_estimates(path: Path | None, journal: Journal) -> None:
    """Write one line for each pair into a file that appears when it is whole."""
    if path is None:
        return
    hidden = path.with_name(f'.{path.name}.unfinished')
    try:
        with hidden.open('w', encoding='utf-8') as file:
            file.writelines(json.dumps(record) + '\n' for record in journal.records())
        os.replace(hidden, path)
    except OSError as error:
        with suppress(OSError):
            hidden.unlink()
        raise InputError(f'cannot write {path}: {error.strerror}') from error


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
        dropped += ''.join(f'; {n} unreadable on {topic}' for topic, n in summary.unread.items())
        raise InputError(f'no pair on {names.colour} and {names.depth}{dropped}{damage}')
    if summary.refused.total() == summary.pairs:
        reason = summary.refused.most_common(1)[0][0]
        raise InputError(f'none of the {summary.pairs} pairs can be solved: {reason}')
