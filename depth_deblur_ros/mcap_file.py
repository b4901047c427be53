"""
One mcap file, read without trust in its index, so that a damaged one gives what is left.

Its blocks are listed first, unread. Chunks, messages or the whole file may be compressed.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
import struct
import tempfile
from typing import BinaryIO, NamedTuple
import zlib

from depth_deblur_ros.core.data import InputError
from depth_deblur_ros.mcap_chunk import unpack, unpack_message, UNPACKING
from depth_deblur_ros.mcap_records import (
    CHANNEL,
    CHUNK,
    CHUNK_HEAD,
    DATA_END,
    FOOTER,
    Gap,
    HEAD,
    is_cdr,
    MAGIC,
    MESSAGE,
    MESSAGE_HEAD,
    MESSAGE_INDEX,
    Record,
    SCHEMA,
    STATISTICS,
    walk,
)
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Channel, Schema, Statistics
import zstandard

_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'  # no CDR begins so: a payload that does is compressed
_PIECE = 1 << 20
_DAMAGE = (McapError, ValueError, struct.error, MemoryError, OSError)


@dataclass(frozen=True)
class Topic:
    """A topic of a bag: what another bag needs to hold it too; an empty type has been lost."""

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
    record: Record
    counts: Counter[int]


@dataclass
class _Reading:
    """What reading a block brought: messages by channel, and what was wrong."""

    given: Counter[int] = field(default_factory=Counter)
    troubles: Counter[str] = field(default_factory=Counter)

    def __str__(self) -> str:
        return '; '.join(f'{n} x {text}' if n > 1 else text for text, n in self.troubles.items())


class McapFile:
    """
    The blocks and topics of one file; what cannot be read is left out and noted in `damage`.

    `stated` is how many messages the file says it holds, None where it does not say so; `given`
    how many each block gave that has been read.
    """

    def __init__(self, path: Path) -> None:
        self.name = path.name
        self.blocks: list[Block] = []
        self.topics: dict[int, Topic] = {}
        self.damage: list[str] = []
        self._proved = self._doubted = dict[int, Topic]()  # told by the data; by a wrong summary
        self.stated: int | None = None
        self.given: dict[Record, int] = {}
        self._schemas: dict[int, Schema] = {}
        self._indexed: Counter[int] = Counter()  # what an index that comes now tells of
        self._summary = 0  # where it begins, when the end of the data has been seen
        self._whole = False  # the footer has been seen
        self._stream = self._opened(path)
        try:
            self._scan()
        except InputError:
            self.close()
            raise

    def close(self) -> None:
        """Close the file; nothing can be read any more."""
        self._stream.close()

    def read(self, block: Block) -> Iterator[BagMessage]:
        """Give the messages of a block, in the order of the file; note what is missing."""
        reading = _Reading()
        for opcode, data in self._contents(block.record, reading):
            if opcode == MESSAGE and (message := self._message(data, reading)):
                yield message
        self.given[block.record] = given = reading.given.total()
        lost = (block.counts - reading.given).total()
        if reading.troubles or lost:
            known = f'{lost} of {block.counts.total()} messages lost'
            told = known if block.counts else f'{given} messages found'
            kind = 'chunk' if block.record.opcode == CHUNK else 'message'
            text = '; '.join(filter(None, [str(reading), told]))
            self._note(f'{kind} at byte {block.record.offset}: {text}')

    def count(self, block: Block, topic: str) -> int:
        """Count the messages of a topic in a block by its index; 0 where there is none."""
        return sum(n for id_, n in block.counts.items() if self._name(id_) == topic)

    def _scan(self) -> None:
        size = self._stream.seek(0, 2)
        self._stream.seek(0)
        known = self._stream.read(len(MAGIC)) == MAGIC
        gaps = self._list_all(size) if known or self.name.endswith(('.mcap', '.zstd')) else []
        if not (known or self.blocks):
            raise InputError(f'{self.name} ({size} bytes) is not an mcap file')
        for gap, counts in gaps:
            lost = f', which held {counts.total()} messages' if counts else ''
            self._note(f'no record can be read from byte {gap.begin} to {gap.end}{lost}')
        if not self._whole:
            self._note(f'ends at byte {size} without a footer: it was cut or never finished')
        elif not self._summary:
            self._note('the end of its data is missing')
        if self.damage or not self.topics:  # what the summary tells stands in the chunks too
            for block in self.blocks:
                for _ in self._contents(block.record, _Reading()):
                    pass
        self.topics = self.topics or self._doubted

    def _list_all(self, size: int) -> list[tuple[Gap, Counter[int]]]:
        """List the blocks; give the gaps between them with what an index says was there."""
        gaps: list[tuple[Gap, Counter[int]]] = []
        end = 0
        try:
            for found in walk(self._stream, 0, size):
                end = found.end
                if isinstance(found, Record):
                    self._list(found)
                elif not self._whole:
                    self._indexed = Counter()
                    gaps.append((found, self._indexed))
        except OSError as error:
            self._note(f'cannot be read from byte {end} on: {error.strerror}')
        return gaps

    def _list(self, record: Record) -> None:
        if record.mended and not record.cut:
            self._note(f'the length of the record at byte {record.offset} was wrong')
        if record.opcode == CHUNK:
            start, end, _, _ = CHUNK_HEAD.unpack(self._bytes(record, CHUNK_HEAD.size))
            self._indexed = Counter()
            self.blocks.append(Block(start, end, record, self._indexed))
        elif record.opcode == MESSAGE and not record.cut:
            channel, _, time, _ = MESSAGE_HEAD.unpack(self._bytes(record, MESSAGE_HEAD.size))
            chunked = bool(self.blocks) and self.blocks[-1].record.opcode == CHUNK
            if chunked and not is_cdr(self._stream, record.offset):
                self._note(f'the record at byte {record.offset} is no message')
                return
            self.blocks.append(Block(time, time, record, Counter({channel: 1})))
            self._indexed = Counter()
        elif record.opcode == MESSAGE_INDEX:
            self._index(self._bytes(record))
        elif record.opcode in (SCHEMA, CHANNEL):
            self._learn(record.opcode, self._bytes(record))
        elif record.opcode == STATISTICS:
            self._count(self._bytes(record))
        elif record.opcode == DATA_END:
            self._summary, self._proved = record.end, dict(self.topics)
            self._check(record)
        elif record.opcode == FOOTER:
            self._whole = True
            self._check_summary(record)

    def _check(self, end: Record) -> None:
        """Check messages outside of chunks: the file's checksum is their only one."""
        told = int.from_bytes(self._bytes(end), 'little')
        bare = any(block.record.opcode == MESSAGE for block in self.blocks)
        if told and bare and self._checksum(0, end.offset - HEAD.size) != told:
            self._note('the checksum of its data is wrong, so that messages may be altered')

    def _check_summary(self, footer: Record) -> None:
        """Check what has been learned last: it counts less than what stands in the data."""
        told = int.from_bytes(self._bytes(footer)[-4:], 'little')
        if told and self._summary and self._checksum(self._summary, footer.end - 4) != told:
            self._note('the checksum of its summary is wrong')
            self._doubted, self.topics, self.stated = self.topics, self._proved, None

    def _checksum(self, begin: int, end: int) -> int:
        self._stream.seek(begin)
        value, left = 0, end - begin
        while left > 0 and (piece := self._stream.read(min(left, _PIECE))):
            value, left = zlib.crc32(piece, value), left - len(piece)
        return value

    def _index(self, data: bytes) -> None:
        """Take in how many messages of a channel the last chunk or gap holds, and their times."""
        whole = 6 + (len(data) - 6) // 16 * 16
        times = [time for time, _ in struct.iter_unpack('<QQ', data[6 : max(whole, 6)])]
        self._indexed[int.from_bytes(data[:2], 'little')] += len(times)
        if self.blocks and self.blocks[-1].counts is self._indexed:
            block = self.blocks[-1]
            start, end = min([block.start_ns, *times]), max([block.end_ns, *times])
            self.blocks[-1] = block._replace(start_ns=start, end_ns=end)

    def _count(self, data: bytes) -> None:
        with suppress(*_DAMAGE):
            found = Statistics.read(ReadDataStream(BytesIO(data)))
            if found.message_count == sum(found.channel_message_counts.values()):
                self.stated = found.message_count

    def _contents(self, record: Record, reading: _Reading) -> Iterator[tuple[int, bytes]]:
        """Give opcode and content of the records in a block."""
        try:
            data = self._bytes(record)
        except OSError as error:
            reading.troubles[f'cannot be read: {error.strerror}'] += 1
            return
        if record.opcode != CHUNK:
            yield record.opcode, data
            return
        content, trouble, whole = unpack(data, record.cut)
        if trouble:
            reading.troubles[trouble] += 1
        stream = BytesIO(content)
        for found in walk(stream, 0, len(content)):
            if isinstance(found, Gap):
                reading.troubles[f'{found.end - found.begin} of its bytes hold no record'] += 1
            elif whole or not found.cut:
                if found.mended and whole:
                    reading.troubles['the length of a record was wrong'] += 1
                inside = content[found.offset : found.end]
                if found.opcode in (SCHEMA, CHANNEL):
                    self._learn(found.opcode, inside)
                yield found.opcode, inside

    def _bytes(self, record: Record, count: int | None = None) -> bytes:
        self._stream.seek(record.offset)
        return self._stream.read(record.length if count is None else count)

    def _learn(self, opcode: int, data: bytes) -> None:
        stream = ReadDataStream(BytesIO(data))
        try:
            if opcode == SCHEMA:
                schema = Schema.read(stream)
                self._schemas[schema.id] = schema
                return
            channel = Channel.read(stream)
        except _DAMAGE as error:
            self._note(f'a description of a topic cannot be read: {error!r}')
            return
        described = self._schemas.get(channel.schema_id)
        if channel.id in self.topics and not described:
            return
        self.topics[channel.id] = Topic(
            channel.topic,
            described.name if described else '',  # lost: what it is can be told from elsewhere
            described.data.decode(errors='replace') if described else '',
            channel.message_encoding,
            channel.metadata,
        )

    def _message(self, data: bytes, reading: _Reading) -> BagMessage | None:
        channel, _, log_ns, _ = MESSAGE_HEAD.unpack_from(data)
        payload = data[MESSAGE_HEAD.size :]
        if channel not in self.topics:
            reading.troubles[f'a message on channel {channel}, which nothing describes'] += 1
            return None
        try:
            plain = unpack_message(payload) if payload.startswith(_ZSTD_MAGIC) else payload
        except UNPACKING as error:
            text = f'a message on {self._name(channel)} cannot be unpacked: {error}'
            reading.troubles[text] += 1
            return None
        reading.given[channel] += 1
        return BagMessage(log_ns, self.topics[channel], plain)

    def _name(self, channel: int) -> str | None:
        return self.topics[channel].name if channel in self.topics else None

    def _note(self, text: str) -> None:
        if (note := f'{self.name}: {text}') not in self.damage:
            self.damage.append(note)

    def _opened(self, path: Path) -> BinaryIO:
        try:
            return self._unpacked(path) if path.suffix == '.zstd' else path.open('rb')
        except (OSError, zstandard.ZstdError) as error:
            raise InputError(f'cannot read {path}: {error}') from error

    def _unpacked(self, path: Path) -> BinaryIO:
        """Give the content of a packed file as a file that can be searched."""
        plain: BinaryIO = tempfile.TemporaryFile()  # noqa: SIM115 (close() closes it)
        try:
            with path.open('rb') as packed:
                zstandard.ZstdDecompressor().copy_stream(packed, plain)
        except (OSError, zstandard.ZstdError) as error:
            if isinstance(error, OSError) or not plain.tell():
                plain.close()
                raise
            self._note(f'cannot be unpacked behind byte {plain.tell()}: {error}')
        return plain
