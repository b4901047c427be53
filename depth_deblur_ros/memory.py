"""What a process of many frames keeps of the memory it has freed; glibc alone can be told."""

from __future__ import annotations

import ctypes

# glibc's M_TRIM_THRESHOLD, M_MMAP_THRESHOLD, M_TOP_PAD, bytes: an image's memory stays with the
# process, so that the next one does not pay for its pages again. M_ARENA_MAX, a count: so much is
# kept in each arena, and a thread of every new worker may open one.
_MALLOPT = ((-1, 1 << 28), (-3, 1 << 25), (-2, 1 << 24), (-8, 2))


def keep_freed_memory() -> None:
    """Keep the memory of images for the next ones; arenas that are there already stay."""
    library = ctypes.CDLL(None)
    if hasattr(library, 'mallopt'):
        for option, size in _MALLOPT:
            library.mallopt(option, size)
