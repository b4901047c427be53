"""
Say that kernels are being compiled, when they are: the first run of an installation takes long.

numba keeps them beside the package, where that folder cannot be written in the user's cache
folder, or where NUMBA_CACHE_DIR says.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba.core import event


class _Teller(event.Listener):
    """Speaks up when the first kernel of this package is compiled, then holds its peace."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say: Callable[[str], None] | None = say

    def on_start(self, event: Any) -> None:
        kernel = event.data['dispatcher']
        if self._say and kernel.py_func.__module__.startswith(__package__):
            say, self._say = self._say, None
            say(
                'compiling kernels, up to half a minute; the next run finds them in '
                f'{kernel.stats.cache_path or "no cache, and compiles them again"}'
            )

    def on_end(self, event: Any) -> None:
        """Nothing to say."""


def tell_of_compiling(say: Callable[[str], None]) -> None:
    """Call `say` with one line if kernels are compiled from now on, not if they are cached."""
    event.register('numba:compile', _Teller(say))  # type: ignore[no-untyped-call]
