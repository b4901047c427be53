"""
Messages out of mcap bags, results into one; the only file that imports rosbags and mcap.

A bag is written whole or not at all: into a hidden folder beside its target, renamed at the end.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
import shutil
import tempfile
from typing import Any

from depth_deblur_ros.core.data import InputError
import numpy as np
from rosbags.interfaces import Connection, Nodetype
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores

_TYPES = get_typestore(Stores.ROS2_JAZZY)


class BagWriter:
    """Write a rosbag2 folder (mcap, zstd chunks) that appears under its name when it is whole."""

    def __init__(self, path: Path, *, overwrite: bool = False) -> None:
        self._path = Path(path).absolute()
        self._connections: dict[str, Connection] = {}
        if self._path.exists() and not overwrite:
            raise InputError(f'{path} exists already; it is replaced only when asked for')
        if self._path.exists() and not (self._path / 'metadata.yaml').is_file():
            raise InputError(f'{path} exists and is not a rosbag2 folder; it is never replaced')

    def __enter__(self) -> BagWriter:
        with _writing(self._path):
            self._path.parent.mkdir(parents=True, exist_ok=True)
            folder = tempfile.mkdtemp(prefix=f'.{self._path.name}.', dir=self._path.parent)
            self._hidden = Path(folder)
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
            else:
                self._writer.abort()
        finally:
            shutil.rmtree(self._hidden, ignore_errors=True)

    def write(self, topic: str, type_name: str, fields: Mapping[str, Any], log_ns: int) -> None:
        """Append one message, given by its fields; those not named are zero."""
        data = _TYPES.serialize_cdr(_message(type_name, fields), type_name)
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(
                topic, type_name, typestore=_TYPES
            )
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
