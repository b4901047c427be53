"""What a process of many frames keeps of the memory it has freed; glibc alone can be told."""

from __future__ import annotations

import ctypes
import mmap

# glibc's M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_TOP_PAD, bytes: an image's memory stays with the
# process, so that the next one does not pay for its pages again. M_ARENA_MAX, a count: so much is
# kept in each arena, and a thread of every new worker may open one.
_MALLOPT = ((-1, 1 << 28), (-3, 1 << 25), (-2, 1 << 24), (-8, 2))
_PIECES, _PIECE = 10, 1 << 24  # how many, bytes of each: what a VGA frame's images come and go in


def keep_freed_memory() -> None:
    """
    Keep the memory of images for the next ones; arenas that are there already stay.

    Large pages are asked for, where the system leaves that to the process: kernels read many rows
    of many planes at once, and each small page has to be looked up.
    """
    library = ctypes.CDLL(None)
    if not hasattr(library, 'mallopt'):
        return
    for option, size in _MALLOPT:
        library.mallopt(option, size)
    library.malloc.restype = ctypes.c_void_p
    pieces = [piece for _ in range(_PIECES) if (piece := library.malloc(ctypes.c_size_t(_PIECE)))]
    for piece in pieces:
        first, end = (-(-at // mmap.PAGESIZE) * mmap.PAGESIZE for at in (piece, piece + _PIECE))
        room = ctypes.c_void_p(first), ctypes.c_size_t(end - first)
        library.madvise(*room, mmap.MADV_HUGEPAGE)  # nothing is lost where it is refused
    for piece in pieces:
        library.free(ctypes.c_void_p(piece))
