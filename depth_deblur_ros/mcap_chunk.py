"""
What is in a chunk of an mcap file, as far as it can be unpacked.

A stream that is cut or damaged gives what stands before the damage. A single flipped bit of a
chunk that is not compressed is turned back: its place follows from what it does to the checksum.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from io import BytesIO
from typing import NamedTuple
import zlib

from depth_deblur_ros.mcap_records import CHUNK_HEAD
from lz4.frame import LZ4FrameDecompressor
import zstandard

MAX_UNPACKED = 1 << 30  # bytes of a chunk: what claims to be more is not unpacked further
_STEP = 1 << 16
_MAX_REPAIR = 1 << 24  # bytes that are searched for a flipped bit
UNPACKING = (zstandard.ZstdError, RuntimeError, EOFError, ValueError, MemoryError)

_Read = Callable[[int], bytes]


class Unpacked(NamedTuple):
    """The records in a chunk; trouble says what is wrong; whole: they have their full length."""

    content: bytes
    trouble: str
    whole: bool


def unpack(chunk: bytes, cut: bool) -> Unpacked:
    """Give the records in a chunk record; cut says that its end is missing."""
    _, _, size, checksum = CHUNK_HEAD.unpack_from(chunk)
    at = CHUNK_HEAD.size
    named = int.from_bytes(chunk[at : at + 4], 'little')
    form = chunk[at + 4 : at + 4 + named].decode('ascii', errors='replace')
    packed = chunk[at + 4 + named + 8 :]
    if form not in _UNPACKERS:
        return Unpacked(b'', f'its compression {form!r} is not known', False)
    unpacker = _UNPACKERS[form]
    content = _drained(unpacker, packed) if unpacker else packed
    if checksum == 0 and len(content) == size:
        return Unpacked(content, '', True)
    if zlib.crc32(content) == checksum:
        return Unpacked(content, '', True)
    if cut or len(content) < size:
        return Unpacked(content, f'only {len(content)} of its {size} bytes can be unpacked', False)
    short = len(content) <= _MAX_REPAIR
    if not form and short and (repaired := _with_bit_turned_back(content, checksum)):
        return Unpacked(repaired, 'one flipped bit has been turned back', True)
    return Unpacked(content, 'its checksum is wrong, so that messages may be altered', True)


def unpack_message(data: bytes) -> bytes:
    """Undo the compression of one message, zstd; raises one of UNPACKING."""
    unpacker = zstandard.ZstdDecompressor().decompressobj()
    content = unpacker.decompress(data)
    if not unpacker.eof:
        raise ValueError('the compressed message is cut')
    return content


def _zstd(packed: bytes) -> _Read:
    return zstandard.ZstdDecompressor().stream_reader(BytesIO(packed)).read


def _lz4(packed: bytes) -> _Read:
    unpacker = LZ4FrameDecompressor()
    left = [packed]

    def read(count: int) -> bytes:
        return b'' if unpacker.eof else unpacker.decompress(left.pop() if left else b'', count)

    return read


_UNPACKERS: dict[str, Callable[[bytes], _Read] | None] = {'': None, 'lz4': _lz4, 'zstd': _zstd}


def _drained(unpacker: Callable[[bytes], _Read], packed: bytes) -> bytes:
    """Unpack up to the end or the damage."""
    content = bytearray()
    read = unpacker(packed)
    try:
        while len(content) < MAX_UNPACKED and (piece := read(_STEP)):
            content += piece
        return bytes(content)
    except UNPACKING:
        return _drained_to_the_byte(unpacker(packed), len(content))


def _drained_to_the_byte(read: _Read, known: int) -> bytes:
    """Unpack what is known to be sound, then byte for byte up to the damage."""
    content = bytearray()
    with suppress(*UNPACKING):
        while piece := read(_STEP if len(content) + _STEP <= known else 1):
            content += piece
    return bytes(content)


def _with_bit_turned_back(content: bytes, checksum: int) -> bytes | None:
    """
    Undo one flipped bit; None where no single one explains the checksum.

    Checksums are linear: theirs differ by what the flipped bit alone leaves in the register, after
    as many further bytes as follow it. So the register is run backwards, byte by byte.
    """
    register = zlib.crc32(content) ^ checksum
    for place in range(len(content) - 1, -1, -1):
        index = _BY_TOP[register >> 24]
        if index in _BITS and register == _TABLE[index]:
            repaired = bytearray(content)
            repaired[place] ^= index
            return bytes(repaired)
        register = ((register ^ _TABLE[index]) << 8 | index) & 0xFFFFFFFF
    return None


def _shifted_out(byte: int) -> int:
    for _ in range(8):
        byte = byte >> 1 ^ (0xEDB88320 if byte & 1 else 0)
    return byte


_TABLE = [_shifted_out(byte) for byte in range(256)]  # CRC-32, as zlib computes it
_BY_TOP = {value >> 24: index for index, value in enumerate(_TABLE)}
_BITS = {1 << bit for bit in range(8)}
