"""
A kernel's work on several threads.

Kernels run without the interpreter's lock, each on a share of the work. numba could do so by
itself, but compiles what runs side by side four times over, which takes most of a first run.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from typing import Any

from numba import config, get_num_threads
from numba.core.compiler import Compiler


class _Apart(Compiler):
    """Compiles kernels on the promise that their arrays do not overlap, as numba's own threads."""

    def define_pipelines(self) -> Any:
        self.state.flags.noalias = True
        return super().define_pipelines()  # type: ignore[no-untyped-call]


# What `on_threads` calls is compiled with these.
SHARED: dict[str, Any] = {
    'cache': True,
    'nogil': True,
    'error_model': 'numpy',
    'pipeline_class': _Apart,
}


@lru_cache(maxsize=1)
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(config.NUMBA_NUM_THREADS)  # type: ignore[attr-defined]


def on_threads(kernel: Callable[..., None], count: int, *data: Any) -> None:
    """Call kernel(first, end, *data) on even shares of 0..count, one for each numba thread."""
    threads = min(get_num_threads(), count)
    if threads < 2:
        kernel(0, count, *data)
        return
    ends = [k * count // threads for k in range(threads + 1)]
    others = [_pool().submit(kernel, ends[k], ends[k + 1], *data) for k in range(1, threads)]
    kernel(0, ends[1], *data)
    for other in others:
        other.result()
