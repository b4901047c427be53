"""
The executable of the live node: its imports take a second, in which a signal ends it in peace.

Without this, an interrupt would end in a traceback, and SIGTERM in the signal's own exit code.
"""

from __future__ import annotations

import signal
from typing import Any, NoReturn

from depth_deblur_ros.memory import keep_freed_memory


def main() -> int:
    """Import the node and run it; nothing has begun that a signal before would have to undo."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, _leave)
    keep_freed_memory()  # before any thread opens an arena
    from depth_deblur_ros.node import main as run

    return run()


def _leave(*_: Any) -> NoReturn:
    raise SystemExit(0)
