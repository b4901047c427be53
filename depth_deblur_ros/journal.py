"""
What an unfinished replay has done, so that another one can go on behind it.

Beside the bag to be written stands a hidden folder, with one folder for each attempt:
  BAG/     the bag as far as it goes
  lines    JSON: first the facts of the run, then one line for each pair
  state    how many pairs are done, and what the solver remembers of them
They are written in this order, pair by pair, so that what the state counts is there.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from contextlib import closing, suppress
import fcntl
import json
import os
from pathlib import Path
import pickle
import shutil
from typing import Any, NamedTuple
import zlib

from depth_deblur_ros.core.data import InputError
from depth_deblur_ros.mcap_file import BagMessage, McapFile
from depth_deblur_ros.results import RESULT, TYPES

RESULTS = {f'/{topic}' for topic in TYPES}
LAST_TOPIC = f'/{RESULT}'  # of a pair
_DAMAGED = (OSError, ValueError, KeyError, TypeError, EOFError, pickle.UnpicklingError)


class Done(NamedTuple):
    """A pair that is done: its motion record, why it was refused, the checksum of its messages."""

    record: dict[str, Any]
    reason: str
    drawn: bool
    checksum: int


class Journal:
    """
    The folder of an attempt, and what an earlier attempt has left.

    facts are what the results depend on: an attempt with others cannot be gone on with. resume
    keeps what earlier attempts did. Raises InputError where another process is at it.
    """

    def __init__(self, out: Path, facts: Mapping[str, Any], *, resume: bool) -> None:
        out = Path(out).absolute()
        self._all = _folder(out)
        self._facts = json.loads(json.dumps(facts))
        self._name = out.name
        self._resume = resume
        self.count = 0

    def __enter__(self) -> Journal:
        try:
            self._all.mkdir(parents=True, exist_ok=True)
            self._lock = (self._all / 'lock').open('w')
            self._lock_all()
            attempts = self._attempts() if self._resume else []
            best = max(attempts, key=lambda a: (a.count, a.folder.name), default=None)
            for folder in self._all.iterdir():
                if folder.is_dir() and not (best and folder == best.folder):
                    shutil.rmtree(folder)
            self.folder = self._all / f'{int(best.folder.name) + 1 if best else 1:04d}'
            self.folder.mkdir()
            self._lines = (self.folder / 'lines').open('w', encoding='utf-8')
            self._lines.write(json.dumps(self._facts) + '\n')
        except OSError as error:
            raise InputError(f'cannot write {self._all}: {error.strerror}') from error
        self._before = best.pairs() if best else iter(())
        self.earlier = best.count if best else 0
        self.state = best.state if best else None
        return self

    def __exit__(self, kind: type[BaseException] | None, error: Any, _: object) -> None:
        with suppress(OSError):  # a full disk has been told of already
            self._lines.close()
        self._lock.close()
        refused = isinstance(error, InputError) and error.__cause__ is None
        if kind is None or refused or not max(self.count, self.earlier):
            shutil.rmtree(self._all, ignore_errors=True)
        elif isinstance(error, InputError):
            raise InputError(f'{error}; --resume goes on from there') from error

    def done_before(self) -> tuple[Done, list[BagMessage]] | None:
        """Give the next pair of the earlier attempt with its messages; None behind the last."""
        found = next(self._before, None)
        if found is None and self.count < self.earlier and self.state is not None:
            raise InputError(f'{self._all} is damaged: remove it, or leave out --resume')
        return found

    def add(self, done: Done, state: Any = None) -> None:
        """Note a pair, whose messages are in the bag already, and what the solver remembers."""
        self.count += 1
        try:
            self._lines.write(json.dumps(done._asdict()) + '\n')
            self._lines.flush()
            if self.count > self.earlier:
                (self.folder / 'state.new').write_bytes(pickle.dumps((self.count, state)))
                os.replace(self.folder / 'state.new', self.folder / 'state')
        except OSError as error:
            raise InputError(f'cannot write {self.folder}: {error.strerror}') from error

    def records(self) -> Iterator[dict[str, Any]]:
        """Give the motion record of each pair."""
        with (self.folder / 'lines').open(encoding='utf-8') as lines:
            next(lines)
            for line in lines:
                yield json.loads(line)['record']

    def _lock_all(self) -> None:
        try:
            fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self._lock.close()
            raise InputError(f'{self._name} is being written by another process') from None

    def _attempts(self) -> list[_Attempt]:
        """Give the earlier attempts at the same run; refuse to go on with another one."""
        attempts = [
            _Attempt(folder, self._name) for folder in self._all.iterdir() if folder.is_dir()
        ]
        begun = [attempt for attempt in attempts if attempt.count]
        for attempt in begun:
            for name, value in attempt.facts.items():
                if self._facts.get(name) != value:
                    raise InputError(
                        f'the unfinished {self._name} was made with {name} {value}, not '
                        f'{self._facts.get(name)}: leave out --resume to start anew'
                    )
        return begun


def pairs_done(out: Path) -> int:
    """Count the pairs that the attempts at this bag have done so far; from any process."""
    count = 0
    with suppress(OSError):  # they come and go
        for lines in _folder(Path(out).absolute()).glob('*/lines'):
            count = max(count, lines.read_bytes().count(b'\n') - 1)
    return count


def _folder(out: Path) -> Path:
    return out.parent / f'.{out.name}.unfinished'


class _Attempt:
    """What one attempt left."""

    def __init__(self, folder: Path, name: str) -> None:
        self.folder, self._name = folder, name
        self.facts: dict[str, Any] = {}
        self.count, self.state = 0, None
        try:
            self.count, self.state = pickle.loads((folder / 'state').read_bytes())
            with (folder / 'lines').open(encoding='utf-8') as lines:
                self.facts = json.loads(lines.readline())
        except _DAMAGED:
            self.count = 0  # it was killed before its first pair was done

    def pairs(self) -> Iterator[tuple[Done, list[BagMessage]]]:
        """Give the pairs that are whole."""
        groups = self._groups()
        with (self.folder / 'lines').open(encoding='utf-8') as lines:
            next(lines)
            for _, line, group in zip(range(self.count), lines, groups, strict=False):
                done = Done(**json.loads(line))
                if checksum(message.data for message in group) != done.checksum:
                    return
                yield done, group

    def _groups(self) -> Iterator[list[BagMessage]]:
        """Give the messages of pair after pair, as they stand in the bag."""
        file = McapFile(self.folder / self._name / f'{self._name}.mcap')
        group: list[BagMessage] = []
        with closing(file):
            for message in (m for block in file.blocks for m in file.read(block)):
                if message.topic.name in RESULTS:
                    group.append(message)
                if message.topic.name == LAST_TOPIC:
                    yield group
                    group = []


def checksum(parts: Iterable[bytes]) -> int:
    """Give the checksum of a pair's messages."""
    value = 0
    for part in parts:
        value = zlib.crc32(part, value)
    return value
