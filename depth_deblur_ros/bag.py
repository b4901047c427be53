"""
Messages out of mcap bags, results into one.

A bag is written into a hidden folder beside its target, which takes its name when it is whole.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
import heapq
import itertools
from pathlib import Path
import shutil
import tempfile
from typing import Any

from depth_deblur_ros.core.data import InputError
from depth_deblur_ros.mcap_file import BagMessage, Block, McapFile, Topic
import numpy as np
from rosbags.interfaces import Connection, Nodetype
from rosbags.rosbag2 import CompressionFormat, CompressionMode, ReaderError, StoragePlugin, Writer
from rosbags.rosbag2.metadata import parse_qos
from rosbags.serde import SerdeError
from rosbags.typesys import get_types_from_msg, get_typestore, Stores, TypesysError
import yaml

_TYPES = get_typestore(Stores.ROS2_JAZZY)


class BagReader:
    """Read a rosbag2 bag, folder or file, in the order of the log times."""

    def __init__(self, path: Path) -> None:
        self.path = Path(path)
        self._missing: list[str] = []
        self._stated: int | None = None  # messages, says metadata.yaml
        self._files: list[McapFile] = []
        try:
            self._found = self._paths()
            for file in self._found:
                self._files.append(McapFile(file))
            blocks = [(block, file) for file in self._files for block in file.blocks]
            self._blocks = sorted(
                blocks, key=lambda entry: (entry[0][:2], entry[1].name, entry[0].record)
            )
            filled = [block for block, _ in self._blocks if block.end_ns or block.counts]
            if not filled:
                raise InputError(f'{path} holds no messages; {"; ".join(self.damage) or "empty"}')
        except InputError:
            self.close()
            raise
        self.start_ns = filled[0].start_ns
        self.end_ns = max(block.end_ns for block in filled)
        self.topics = {t.name: t for file in self._files for t in file.topics.values()}

    def __enter__(self) -> BagReader:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def files(self) -> list[Path]:
        """The files that are read."""
        return self._found

    def close(self) -> None:
        """Close the files."""
        for file in self._files:
            file.close()

    @property
    def damage(self) -> list[str]:
        """What could not be read so far, and where; how many messages, when all has been read."""
        notes = [*self._missing, *(note for file in self._files for note in file.damage)]
        given = sum(sum(file.given.values()) for file in self._files)
        if sum(len(file.given) for file in self._files) < len(self._blocks):
            return notes
        stated = [file.stated for file in self._files]
        known = [count for count in stated if count is not None]
        total = self._stated if self._missing or len(known) < len(stated) else sum(known)
        if not notes and given >= (total or 0):
            return notes
        if total is None:
            return [*notes, f'{given} messages read; nothing tells how many are lost']
        return [*notes, f'{max(0, total - given)} of {total} messages lost']

    def messages(
        self, topics: Collection[str], start_ns: int = 0, end_ns: int | None = None
    ) -> Iterator[BagMessage]:
        """Give the messages of the topics with start <= log time < end."""
        heap: list[tuple[int, int, BagMessage]] = []
        number = itertools.count()  # keeps the file's order where log times are equal
        for block, file in self._between(start_ns, end_ns):
            while heap and heap[0][0] < block.start_ns:
                yield heapq.heappop(heap)[2]
            for message in file.read(block):
                late = end_ns is not None and message.log_ns >= end_ns
                if message.topic.name in topics and message.log_ns >= start_ns and not late:
                    heapq.heappush(heap, (message.log_ns, next(number), message))
        while heap:
            yield heapq.heappop(heap)[2]

    def count(self, topic: str, start_ns: int = 0, end_ns: int | None = None) -> int:
        """Count the messages of a topic by the index, to a chunk; 0 where there is no index."""
        return sum(file.count(block, topic) for block, file in self._between(start_ns, end_ns))

    def _between(self, start_ns: int, end_ns: int | None) -> Iterator[tuple[Block, McapFile]]:
        for block, file in self._blocks:
            if block.end_ns >= start_ns and (end_ns is None or block.start_ns < end_ns):
                yield block, file

    def _paths(self) -> list[Path]:
        if not self.path.exists():
            raise InputError(f'{self.path} does not exist')
        if self.path.is_file():
            return [self.path]
        found = {p.name for p in self.path.iterdir() if p.name.endswith(('.mcap', '.mcap.zstd'))}
        if not found:
            sqlite = any(self.path.glob('*.db3*'))
            why = 'a bag in SQLite; rosbags-convert makes it one' if sqlite else 'not an mcap bag'
            raise InputError(f'{self.path} holds no .mcap file: {why}')
        listed, self._stated = _metadata(self.path)
        self._missing += [f'{name} is missing from the bag' for name in sorted(listed - found)]
        # A crash leaves a file unlisted, or a packed copy half written beside its original.
        twice = {f'{name}.zstd' for name in found} | {n.removesuffix('.zstd') for n in listed}
        unlisted = found - listed - twice
        if listed:
            self._missing += [f'{n} is not listed in metadata.yaml' for n in sorted(unlisted)]
        return [self.path / name for name in sorted(found & listed | unlisted)]


def decoded(message: BagMessage) -> Any:
    """Make the object of a message's standard ROS type."""
    try:
        return _TYPES.deserialize_cdr(message.data, message.topic.type)
    except (SerdeError, KeyError, AssertionError, IndexError) as error:
        raise InputError(f'a message on {message.topic.name} cannot be read: {error}') from error


def _metadata(folder: Path) -> tuple[set[str], int | None]:
    """Give the files and the number of messages of metadata.yaml; nothing where it is damaged."""
    try:
        content = yaml.safe_load((folder / 'metadata.yaml').read_text())
        bag = content['rosbag2_bagfile_information']
        return {Path(name).name for name in bag['relative_file_paths']}, int(bag['message_count'])
    except (OSError, ValueError, KeyError, TypeError, yaml.YAMLError):
        return set(), None


class BagWriter:
    """
    Write a rosbag2 folder (mcap, zstd chunks) that appears under its name when it is whole.

    Until then it is in a hidden folder beside its target, which goes when the writing ends, or
    inside a folder that is given and stays.
    """

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        self._path = Path(path).absolute()
        self._folder: Path | None = None
        self._connections: dict[str, Connection] = {}
        if self._path.exists() and not overwrite:
            raise InputError(f'{path} exists already; it is replaced only when asked for')
        if self._path.exists() and not (self._path / 'metadata.yaml').is_file():
            raise InputError(f'{path} exists and is not a rosbag2 folder; it is never replaced')

    def inside(self, folder: Path) -> BagWriter:
        """Write into this folder, on the same disk, until the bag is whole."""
        self._folder = folder
        return self

    def __enter__(self) -> BagWriter:
        with _writing(self._path):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            self._hidden = self._folder or Path(
                tempfile.mkdtemp(prefix=f'.{self._path.name}.', dir=self._path.parent)
            )
            self._writer = Writer(
                self._hidden / self._path.name, version=9, storage_plugin=StoragePlugin.MCAP
            )
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
            self._writer.open()
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            if kind is None:
                with _writing(self._path):
                    self._publish()
        finally:
            with suppress(OSError):  # a full disk has been told of already
                self._writer.abort()
            if not self._folder:
                shutil.rmtree(self._hidden, ignore_errors=True)

    def write(self, topic: str, type_name: str, fields: Mapping[str, Any], log_ns: int) -> bytes:
        """Append one message, given by its fields; those not named are zero. Give its bytes."""
        data = bytes(_TYPES.serialize_cdr(_message(type_name, fields), type_name))
        self.write_bytes(topic, type_name, data, log_ns)
        return data

    def write_bytes(self, topic: str, type_name: str, data: bytes, log_ns: int) -> None:
        """Append one message of a standard type as it was written before."""
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, type_name, typestore=_TYPES
            )
        self._append(topic, log_ns, data)

    def flush(self) -> None:
        """Let the file hold all that has been written, whatever happens to this process."""
        storage: Any = self._writer.storage
        with _writing(self._path):
            if storage.chunk.bio.tell():
                storage.close_chunk()
            storage.bio.flush()

    def copy(self, message: BagMessage) -> None:
        """Append a message of another bag as it is, unless its type has been lost."""
        topic = message.topic
        if not topic.type:
            return
        if topic.name not in self._connections:
            self._connections[topic.name] = self._writer.add_connection(
                topic.name,
                topic.type,
                msgdef=topic.definition,
                rihs01=topic.metadata.get('topic_type_hash') or _type_hash(topic),
                serialization_format=topic.encoding,
                offered_qos_profiles=_qos(topic),
            )
        self._append(topic.name, message.log_ns, message.data)

    def _append(self, topic: str, log_ns: int, data: bytes | memoryview) -> None:
        with _writing(self._path):
            self._writer.write(self._connections[topic], log_ns, data)

    def _publish(self) -> None:
        self._writer.close()
        if self._path.exists():
            self._path.rename(self._hidden / 'replaced')
        (self._hidden / self._path.name).rename(self._path)


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(f'cannot write {path}: {error.strerror or error}') from error


def _type_hash(topic: Topic) -> str:
    types = get_typestore(Stores.EMPTY)
    try:
        types.register(get_types_from_msg(topic.definition, topic.type))
        return types.hash_rihs01(topic.type)
    except (TypesysError, KeyError):
        return f'RIHS01_{0:064x}'


def _qos(topic: Topic) -> list[Any]:
    try:
        return parse_qos(topic.metadata.get('offered_qos_profiles', ''))
    except (ReaderError, KeyError, TypeError):
        return []


def _message(type_name: str, fields: Mapping[str, Any]) -> Any:
    """Make the rosbags object of a message type from nested fields."""
    definitions = dict(_TYPES.fielddefs[type_name][1])
    if unknown := fields.keys() - definitions.keys():
        raise TypeError(f'{type_name} has no field {", ".join(sorted(unknown))}')
    values = {name: _value(form, fields.get(name)) for name, form in definitions.items()}
    return _TYPES.types[type_name](**values)


def _value(form: Any, value: Any) -> Any:
    kind, detail = form
    if kind is Nodetype.NAME:
        return _message(detail, value or {})
    if kind is Nodetype.BASE:
        return ('' if detail[0] == 'string' else 0) if value is None else value
    item, length = detail
    if item[0] is Nodetype.BASE and item[1][0] != 'string':
        return _array(np.dtype(_NUMPY_NAMES.get(item[1][0], item[1][0])), value, length)
    return [_value(item, entry) for entry in value or ()]


def _array(dtype: np.dtype[Any], value: Any, length: int) -> Any:
    if value is None:
        return np.zeros(length, dtype)
    if isinstance(value, bytes | bytearray | memoryview):
        return np.frombuffer(value, dtype)
    return np.ascontiguousarray(value, dtype).ravel()


_NUMPY_NAMES = {'byte': 'uint8', 'char': 'uint8', 'octet': 'uint8'}
