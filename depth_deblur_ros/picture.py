"""
How large the picture in a PNG or JPEG file is, by its own headers, before anything is unpacked.

A few bytes may claim gigabytes: what decodes them asks for the memory first and finds out later.
"""

from __future__ import annotations

from depth_deblur_ros.core.data import InputError, MAX_PIXELS

_PNG = b'\x89PNG\r\n\x1a\n'
_JPEG = b'\xff\xd8'
_LONE = {0x01, *range(0xD0, 0xD9)}  # JPEG markers without content
_FRAMES = set(range(0xC0, 0xD0)) - {0xC4, 0xC8, 0xCC}  # those that tell the size


def check_picture(data: bytes) -> None:
    """Refuse what is no PNG or JPEG, or claims more than it holds or than MAX_PIXELS."""
    if data.startswith(_PNG):
        width, height = _png_size(data)
    elif data.startswith(_JPEG):
        width, height = _jpeg_size(data)
    else:
        raise InputError(f'{len(data)} bytes of a picture cannot be decoded: neither PNG nor JPEG')
    if not 0 < width * height <= MAX_PIXELS:
        raise InputError(
            f'a compressed image of {width}x{height} is not within 1 and {MAX_PIXELS} pixels'
        )


def _png_size(data: bytes) -> tuple[int, int]:
    """Walk the chunks: length, name, content, checksum; the first one tells the size."""
    at = len(_PNG)
    if data[at + 4 : at + 8] != b'IHDR':
        raise InputError(f'{len(data)} bytes of PNG cannot be decoded: no size is there')
    size = int.from_bytes(data[at + 8 : at + 12]), int.from_bytes(data[at + 12 : at + 16])
    while at < len(data):
        length, name = int.from_bytes(data[at : at + 4]), data[at + 4 : at + 8]
        at += 12 + length
        if at > len(data):
            raise InputError(f'{len(data)} bytes of PNG cannot be decoded: {at} are needed')
        if name == b'IEND':
            return size
    raise InputError(f'{len(data)} bytes of PNG cannot be decoded: no end is there')


def _jpeg_size(data: bytes) -> tuple[int, int]:
    """Walk the segments, marker and length, up to the one that tells the size."""
    at = len(_JPEG)
    while at + 4 <= len(data) and data[at] == 0xFF:
        marker = data[at + 1]
        if marker == 0xFF or marker in _LONE:
            at += 1 if marker == 0xFF else 2
            continue
        if marker in _FRAMES:
            return int.from_bytes(data[at + 7 : at + 9]), int.from_bytes(data[at + 5 : at + 7])
        at += 2 + int.from_bytes(data[at + 2 : at + 4])
    raise InputError(f'{len(data)} bytes of JPEG cannot be decoded: no size is there')
