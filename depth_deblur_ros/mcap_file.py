"""
One mcap file, read without trust in its index, so that a damaged one gives what is left.

The chunks of the data section are listed first, without reading what is in them. Chunks, messages
or the file may be compressed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path
import struct
import tempfile
from typing import Any, BinaryIO, NamedTuple

from depth_deblur_ros.core.data import InputError
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import breakup_chunk
import zstandard

_MAGIC = b'\x89MCAP0\r\n'
_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'  # no CDR begins so: a payload that does is compressed
_DAMAGE = (  # what the readers of mcap, lz4 and zstd raise over bytes that are not theirs
    McapError,
    ValueError,
    struct.error,
    RuntimeError,
    MemoryError,
    OSError,
    zstandard.ZstdError,
)


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: what another bag needs to hold it too."""

    name: str
    type: str
    definition: str
    encoding: str
    metadata: Mapping[str, str]


class BagMessage(NamedTuple):
    """One message as it stands in the bag: log time [ns], topic, CDR."""

    log_ns: int
    topic: Topic
    data: bytes


class Block(NamedTuple):
    """A chunk, or a message outside of any: log times [ns], place, messages by channel."""

    start_ns: int
    end_ns: int
    offset: int
    length: int
    opcode: int
    counts: Counter[int]


class McapFile:
    """The blocks and topics of one file; what cannot be read is left out and noted in `damage`."""

    def __init__(self, path: Path) -> None:
        self.name = path.name
        self.blocks: list[Block] = []
        self.topics: dict[int, Topic] = {}
        self.damage: list[str] = []
        self._schemas: dict[int, Schema] = {}
        self._stream = _opened(path)
        try:
            self._scan()
        except InputError:
            self.close()
            raise

    def close(self) -> None:
        """Close the file; nothing can be read any more."""
        self._stream.close()

    def read(self, block: Block) -> Iterator[BagMessage]:
        """Give the messages of a block, in the order of the file, up to the first damage in it."""
        try:
            self._stream.seek(block.offset)
            for record in _records(block.opcode, self._stream.read(block.length)):
                if isinstance(record, Message):
                    yield from self._message(record)
                else:
                    self._learn(record)
        except _DAMAGE as error:
            self._note(f'block at byte {block.offset} cannot be read: {error!r}')

    def count(self, block: Block, topic: str) -> int:
        """Count the messages of a topic in a block by its index; 0 where there is none."""
        return sum(n for id_, n in block.counts.items() if self._name(id_) == topic)

    def _scan(self) -> None:
        size = self._stream.seek(0, 2)
        self._stream.seek(0)
        if self._stream.read(len(_MAGIC)) != _MAGIC:
            raise InputError(f'{self.name} ({size} bytes) is not an mcap file')
        offset, opcode = len(_MAGIC), 0
        while opcode != Opcode.FOOTER:
            head = self._stream.read(9)
            opcode, length = struct.unpack('<BQ', head) if len(head) == 9 else (0, size)
            offset += 9
            if offset + length > size:
                self._note(f'ends within the record at byte {offset} of {size}')
                break
            self._list(opcode, offset, length)
            offset += length
            self._stream.seek(offset)
        if not self.topics:  # no summary: what would stand there is in the chunks too
            for block in self.blocks:
                for _ in self.read(block):
                    pass

    def _list(self, opcode: int, offset: int, length: int) -> None:
        block = Block(0, 0, offset, length, opcode, Counter())
        head = self._stream.read(min(16, length)).ljust(16, b'\0')
        if opcode == Opcode.CHUNK:
            start, end = struct.unpack('<QQ', head)
            self.blocks.append(block._replace(start_ns=start, end_ns=end))
        elif opcode == Opcode.MESSAGE:
            channel, _, time = struct.unpack('<HIQ', head[:14])
            counts = Counter({channel: 1})
            self.blocks.append(block._replace(start_ns=time, end_ns=time, counts=counts))
        elif opcode == Opcode.MESSAGE_INDEX and self.blocks:
            self.blocks[-1].counts[struct.unpack('<H', head[:2])[0]] += length // 16
        elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
            for _ in self.read(block):
                pass

    def _learn(self, record: Any) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel) and record.schema_id in self._schemas:
            schema = self._schemas[record.schema_id]
            text = schema.data.decode(errors='replace')
            self.topics[record.id] = Topic(
                record.topic, schema.name, text, record.message_encoding, record.metadata
            )

    def _message(self, record: Message) -> Iterator[BagMessage]:
        if record.channel_id in self.topics:
            yield BagMessage(record.log_time, self.topics[record.channel_id], _plain(record.data))
        else:
            self._note(f'nothing describes channel {record.channel_id}')

    def _name(self, channel: int) -> str | None:
        return self.topics[channel].name if channel in self.topics else None

    def _note(self, text: str) -> None:
        if (note := f'{self.name}: {text}') not in self.damage:
            self.damage.append(note)


def _opened(path: Path) -> BinaryIO:
    try:
        return _unpacked(path) if path.suffix == '.zstd' else path.open('rb')
    except (OSError, zstandard.ZstdError) as error:
        raise InputError(f'cannot read {path}: {error}') from error


def _unpacked(path: Path) -> BinaryIO:
    """Give the content of a packed file as a file that can be searched."""
    plain: BinaryIO = tempfile.TemporaryFile()  # noqa: SIM115 (McapFile.close closes it)
    try:
        with path.open('rb') as packed:
            zstandard.ZstdDecompressor().copy_stream(packed, plain)
    except BaseException:
        plain.close()
        raise
    return plain


def _records(opcode: int, data: bytes) -> Iterator[Any]:
    stream = ReadDataStream(BytesIO(data))
    if opcode == Opcode.CHUNK:
        yield from breakup_chunk(Chunk.read(stream), validate_crc=True)
    elif opcode == Opcode.MESSAGE:
        yield Message.read(stream, len(data))
    else:
        yield (Schema if opcode == Opcode.SCHEMA else Channel).read(stream)


def _plain(data: bytes) -> bytes:
    if not data.startswith(_ZSTD_MAGIC):
        return data
    return zstandard.ZstdDecompressor().decompressobj().decompress(data)
