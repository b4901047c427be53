"""
Many bags: which, where their results go, and all of them through a pool of processes.

Each bag has a process of its own, so that one that breaks costs no other. In the folder of the
results a bag that is there is whole, and need not be done again.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from concurrent.futures import CancelledError, FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from dataclasses import asdict, replace
import glob
import json
import os
from pathlib import Path
import signal
import subprocess
from typing import Any, Protocol

from depth_deblur_ros.bag import BagReader
from depth_deblur_ros.core.data import InputError
from depth_deblur_ros.folders import write_json
from depth_deblur_ros.job import Done, Job, Progress, run_apart
from depth_deblur_ros.journal import pairs_done
from depth_deblur_ros.recording import choose_topics

SETTINGS = 'replay.json'  # in the folder of the results
POLL_S = 0.5  # between two looks at what is done
_PLACES = ('bag', 'out', 'estimates', 'pictures', 'report', 'overwrite', 'resume')


class Place(Protocol):
    """Where jobs are done."""

    def submit(self, job: Job) -> Future[Done]:
        """Let a job be done when there is room."""


class Pool:
    """
    Processes on this machine, so many at a time; an exception inside `with` interrupts them.

    threads of each: as told, else its share of the cores.
    """

    def __init__(self, workers: int, threads: int | None = None) -> None:
        if workers < 1:
            raise InputError(f'workers must be at least 1, got {workers}')
        self.threads = threads or max(1, cores() // workers)
        self._executor = ThreadPoolExecutor(workers)
        self._begun: list[subprocess.Popen[bytes]] = []

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        self._executor.shutdown(wait=kind is None, cancel_futures=True)
        for process in self._begun if kind else ():
            process.send_signal(signal.SIGINT)
        self._executor.shutdown()

    def submit(self, job: Job) -> Future[Done]:
        """Let a job be done when there is room."""
        job = replace(job, params=replace(job.params, threads=self.threads))
        return self._executor.submit(run_apart, job, self._begun.append)


def cores() -> int:
    """Give how many cores this process may use."""
    return len(os.sched_getaffinity(0))


def find_bags(names: Sequence[str]) -> list[Path]:
    """Give the bags of these names and patterns; refuse two of one name, or none."""
    found: list[Path] = []
    for name in names:
        bags = sorted(glob.glob(name)) if is_pattern(name) else [name]
        if not bags:
            raise InputError(f'no bag fits {name}')
        found += [Path(bag) for bag in bags]
    by_name: dict[str, Path] = {}
    for bag in found:
        if (other := by_name.setdefault(_name(bag), bag)) is not bag:
            raise InputError(f'{other} and {bag} would both become {_name(bag)}')
    return found


def is_pattern(name: str) -> bool:
    """Whether a name stands for others."""
    return glob.has_magic(name) and not Path(name).exists()


def jobs_of(bags: Sequence[Path], whole: Job) -> list[Job]:
    """Give a job for each bag; out, estimates and pictures of the whole are folders."""
    return [
        replace(
            whole,
            bag=bag.absolute(),
            out=whole.out.absolute() / _name(bag),
            estimates=whole.estimates and whole.estimates.absolute() / f'{_name(bag)}.jsonl',
            pictures=whole.pictures and whole.pictures.absolute() / _name(bag),
        )
        for bag in bags
    ]


def note_settings(whole: Job) -> None:
    """Note in the results' folder what they depend on; refuse a folder of other settings."""
    told = asdict(whole)
    settings = json.loads(json.dumps(told.pop('params')))
    settings |= json.loads(json.dumps({k: v for k, v in told.items() if k not in _PLACES}))
    settings.pop('threads')
    path = whole.out / SETTINGS
    if path.exists() and not whole.overwrite:
        before = _read_settings(path)
        for name in settings:
            if before.get(name) != settings[name]:
                raise InputError(
                    f'the results in {whole.out} are of {name} {before.get(name)}, not '
                    f'{settings[name]}: take another folder, or --overwrite'
                )
    write_json(path, settings)


def _read_settings(path: Path) -> dict[str, Any]:
    try:
        found = json.loads(path.read_bytes())
    except ValueError as error:
        raise InputError(f'{path} is not JSON: {error}') from error
    if not isinstance(found, dict):
        raise InputError(f'{path} must be one JSON object, got {type(found).__name__}')
    return found


def replay_many(
    jobs: Sequence[Job], place: Place, progress: Progress | None = None
) -> Iterator[tuple[Job, Done | None]]:
    """
    Do all jobs; give each as it ends, None for one whose results are there already.

    progress is told the frames done of all bags, and of how many.
    """
    todo = [job for job in jobs if job.overwrite or not job.out.exists()]
    yield from ((job, None) for job in jobs if job not in todo)
    futures = {place.submit(job): job for job in todo}
    counts = {job.out: _frames(job) for job in todo}
    done, waiting = 0, set(futures)
    while waiting:
        finished, waiting = wait(waiting, POLL_S, return_when=FIRST_COMPLETED)
        for future in finished:
            done += counts[futures[future].out]
            yield futures[future], _outcome(future)
        if progress:
            open_ends = [futures[future].out for future in waiting]
            begun = sum(min(counts[out], pairs_done(out)) for out in open_ends)
            progress(done + begun, sum(counts.values()) or None)


def _outcome(future: Future[Done]) -> Done:
    """Give how a job ended, even where its place broke down."""
    try:
        return future.result()
    except (Exception, CancelledError) as error:
        return Done(2, f'{type(error).__name__}: {error}'.rstrip(': '))


def _name(bag: Path) -> str:
    return bag.resolve().name.removesuffix('.zstd').removesuffix('.mcap')


def _frames(job: Job) -> int:
    """Count the colour frames, as far as they are known before the work; for progress alone."""
    try:
        with BagReader(job.bag) as reader:
            names = choose_topics(reader, job.topics, with_info=job.camera is None)
            return reader.count(names.colour)
    except (InputError, OSError):
        return 0
