"""
The records of an mcap file, found again behind damage.

A record is an opcode (1 byte), a length (8 bytes) and its content, one after the other. Where the
next one makes no sense, the bytes after it are searched for one that does: its fields fill it
exactly, and behind it comes another one. (mcap.dev/spec)
"""

from __future__ import annotations

from collections.abc import Iterator
import re
import struct
from typing import BinaryIO, NamedTuple

MAGIC = b'\x89MCAP0\r\n'
HEADER, FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = range(1, 8)
STATISTICS, DATA_END = 0x0B, 0x0F
HEAD = struct.Struct('<BQ')
MESSAGE_HEAD = struct.Struct('<HIQQ')  # channel, sequence, log time, publish time
CHUNK_HEAD = struct.Struct('<QQQI')  # start, end, size when unpacked, checksum of that

_FIELDS = {  # opcode: (bytes before, fields that begin with their length, bytes after)
    HEADER: (0, 2, 0),
    FOOTER: (20, 0, 0),
    SCHEMA: (2, 3, 0),
    CHANNEL: (4, 3, 0),
    MESSAGE_INDEX: (2, 1, 0),
    0x0A: (40, 2, 0),  # attachment index
    STATISTICS: (42, 1, 0),
    0x0C: (0, 2, 0),  # metadata
    0x0D: (16, 1, 0),  # metadata index
    0x0E: (17, 0, 0),  # summary offset
    DATA_END: (4, 0, 0),
}
_LEAST = {MESSAGE: MESSAGE_HEAD.size, 0x08: 60, 0x09: 32}  # bytes of those that tell less
_SURE = (SCHEMA, CHANNEL, CHUNK, MESSAGE_INDEX, DATA_END)  # chance hardly makes one of these
_SOUGHT = (*_SURE, MESSAGE)  # worth finding behind damage
_CDR = re.compile(rb'\0[\0-\x0d]|\x28\xb5\x2f\xfd')  # how the content of a ROS message begins
_HEADS = re.compile(rb'(?=[\x03-\x0f].{5}\0\0\0)', re.DOTALL)  # of records below 2^40 bytes
_WINDOW = 1 << 22


class Record(NamedTuple):
    """Where its content stands; cut: the file ends within it; mended: it told a wrong length."""

    opcode: int
    offset: int
    length: int
    cut: bool = False
    mended: bool = False

    @property
    def end(self) -> int:
        """Where the next record begins."""
        return self.offset + self.length


class Gap(NamedTuple):
    """Bytes that hold no record."""

    begin: int
    end: int


def walk(stream: BinaryIO, begin: int, size: int) -> Iterator[Record | Gap]:
    """Give the records from begin to size, and the gaps between them; cut is the last one only."""
    at = begin
    while at < size:
        if _read(stream, at, len(MAGIC)) == MAGIC:
            at += len(MAGIC)
            continue
        record = _record_at(stream, at, size)
        if record is None:
            found = _search(stream, at + 1, size, size)
            yield Gap(at, found)
            at = found
            continue
        if record.opcode == MESSAGE and (record.cut or not _goes_on(stream, record.end, size)):
            # Its length may be the damage: another record may begin before it says.
            found = _search(stream, record.offset + MESSAGE_HEAD.size, record.end, size)
            mended = record.cut or found < record.end
            record = Record(MESSAGE, record.offset, found - record.offset, found == size, mended)
        yield record
        at = record.end


def _read(stream: BinaryIO, at: int, count: int) -> bytes:
    stream.seek(at)
    return stream.read(count)


def _record_at(stream: BinaryIO, at: int, size: int) -> Record | None:
    head = _read(stream, at, HEAD.size)
    if len(head) < HEAD.size:
        return None
    opcode, length = HEAD.unpack(head)
    offset = at + HEAD.size
    if opcode == CHUNK:
        return _chunk_at(stream, offset, length, size)
    believed = MESSAGE_HEAD.size <= length <= size - offset
    if opcode == MESSAGE and not believed and is_cdr(stream, offset):
        return Record(MESSAGE, offset, size - offset, cut=True)
    if opcode in _FIELDS:
        return _fields_at(stream, Record(opcode, offset, length), size)
    if opcode == 0 or length > size - offset:
        return None
    if opcode in _LEAST:
        sound = length >= _LEAST[opcode]
    else:
        sound = _goes_on(stream, offset + length, size)
    return Record(opcode, offset, length) if sound else None


def _chunk_at(stream: BinaryIO, offset: int, length: int, size: int) -> Record | None:
    """Give a chunk, which tells its length twice; either may be the damaged one."""
    head = _read(stream, offset, CHUNK_HEAD.size + 4 + 4 + 8)
    if len(head) < CHUNK_HEAD.size + 4 + 4 + 8:
        return None
    named = int.from_bytes(head[CHUNK_HEAD.size :][:4], 'little')
    before = CHUNK_HEAD.size + 4 + named
    told = before + 8 + int.from_bytes(head[before:][:8], 'little') if named in (0, 3, 4) else -1
    if told == length:
        return Record(CHUNK, offset, min(length, size - offset), cut=length > size - offset)
    for likely in (length, told):
        if len(head) <= likely < size - offset and _begins(stream, offset + likely, size):
            return Record(CHUNK, offset, likely, mended=True)
    return None


def _fields_at(stream: BinaryIO, record: Record, size: int) -> Record | None:
    """Give a record of fields; they tell its length too, which counts where another follows."""
    told = _extent(stream, record.opcode, record.offset, size)
    if told is None or told == record.length:
        return record if told else None
    mended = record._replace(length=told, mended=True)
    return mended if _begins(stream, mended.end, size) else None


def _fills(stream: BinaryIO, opcode: int, offset: int, length: int) -> bool:
    """Whether the fields of a record fill it exactly."""
    return _extent(stream, opcode, offset, offset + length) == length


def _extent(stream: BinaryIO, opcode: int, offset: int, size: int) -> int | None:
    """Give how long the fields of a record are; None where they do not end before size."""
    before, count, after = _FIELDS[opcode]
    at = offset + before
    for _ in range(count):
        at += 4 + int.from_bytes(_read(stream, at, 4), 'little')
        if at > size:
            return None
    return at + after - offset if at + after <= size else None


def _begins(stream: BinaryIO, at: int, size: int) -> bool:
    """Whether a record that can be told from chance begins here."""
    head = _read(stream, at, HEAD.size)
    if len(head) < HEAD.size:
        return False
    opcode, length = HEAD.unpack(head)
    offset = at + HEAD.size
    if opcode in _FIELDS:
        return length <= size - offset and _fills(stream, opcode, offset, length)
    if opcode == CHUNK:
        named = int.from_bytes(_read(stream, offset + CHUNK_HEAD.size, 4), 'little')
        at_told = offset + CHUNK_HEAD.size + 4 + named
        told = int.from_bytes(_read(stream, at_told, 8), 'little')
        return named in (0, 3, 4) and CHUNK_HEAD.size + 12 + named + told == length
    if opcode == MESSAGE:
        return length >= MESSAGE_HEAD.size and is_cdr(stream, offset)
    return opcode in _LEAST and _LEAST[opcode] <= length <= size - offset


def is_cdr(stream: BinaryIO, offset: int) -> bool:
    """Whether a message record with this content holds a ROS message."""
    return _CDR.match(_read(stream, offset + MESSAGE_HEAD.size, 4)) is not None


def _goes_on(stream: BinaryIO, at: int, size: int) -> bool:
    """Whether the file ends here, or another record begins."""
    return at == size or _read(stream, at, 8) == MAGIC or _begins(stream, at, size)


def _search(
    stream: BinaryIO, begin: int, stop: int, size: int, sought: tuple[int, ...] = _SOUGHT
) -> int:
    """Give where the next record begins; stop where there is none before."""
    for start in range(begin, stop, _WINDOW):
        window = _read(stream, start, min(_WINDOW, stop - start) + HEAD.size - 1)
        for match in _HEADS.finditer(window):
            at = start + match.start()
            if window[match.start()] in sought and _is_found(stream, at, size):
                return at
        magic = window.find(MAGIC)
        if 0 <= magic < stop - start:
            return start + magic
    return stop


def _is_found(stream: BinaryIO, at: int, size: int) -> bool:
    if not _begins(stream, at, size):
        return False
    record = _record_at(stream, at, size)
    if record is None or (record.cut and record.opcode != CHUNK):
        return False
    if record.opcode == MESSAGE:  # chance may make one that covers records of kinds that tell more
        inside = record.offset + MESSAGE_HEAD.size
        if _search(stream, inside, record.end, size, _SURE) < record.end:
            return False
    return record.cut or _goes_on(stream, record.end, size)
