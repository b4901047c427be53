"""
Say that kernels are being compiled, when they are: the first run of an installation takes long.

numba keeps them beside the package, where that folder cannot be written in the user's cache
folder, or where NUMBA_CACHE_DIR says. One process compiles one kernel at a time; so, where there
is a second core, a helper begins with those that are needed last, and leaves them there as well.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
import os
import subprocess
import sys
from threading import Thread
from typing import Any

from depth_deblur_ros.core.blur import BlurOperator
from depth_deblur_ros.core.data import CameraIntrinsics, Motion
from depth_deblur_ros.core.descent import conjugate_gradients
from depth_deblur_ros.core.leaning import lean
from depth_deblur_ros.core.quadratic import Quadratic
from depth_deblur_ros.core.seen import pack
from depth_deblur_ros.core.threads import cores
from numba.core import event
import numpy as np

MODULE = 'depth_deblur_ros.compiling'


class _Teller(event.Listener):
    """Speaks up and calls the helper at the first kernel of this package, then stays quiet."""

    def __init__(self, say: Callable[[str], None]) -> None:
        self._say: Callable[[str], None] | None = say

    def on_start(self, event: Any) -> None:
        kernel = event.data['dispatcher']
        if self._say and kernel.py_func.__module__.startswith(__package__):
            say, self._say = self._say, None
            kept = kernel.stats.cache_path
            say(
                'compiling kernels, up to half a minute; the next run finds them in '
                f'{kept or "no cache, and compiles them again"}'
            )
            if kept and cores() > 1:
                call_helper()

    def on_end(self, event: Any) -> None:
        """Nothing to say."""


def tell_of_compiling(say: Callable[[str], None]) -> None:
    """Call `say` with one line if kernels are compiled from now on, not if they are cached."""
    event.register('numba:compile', _Teller(say))  # type: ignore[no-untyped-call]


@cache
def call_helper() -> subprocess.Popen[bytes] | None:
    """
    Let another process compile, once, no longer than this one lives; give it.

    None if it cannot be started: then all is compiled here.
    """
    path = os.pathsep.join(filter(None, sys.path))  # it must find the package that this one found
    command, none = [sys.executable, '-P', '-m', MODULE], subprocess.DEVNULL
    env = os.environ | {'PYTHONPATH': path}
    try:
        helper = subprocess.Popen(
            command, env=env, stdin=subprocess.PIPE, stdout=none, stderr=none
        )
        Thread(target=helper.wait, daemon=True).start()  # else it stays in the process table
    except (OSError, RuntimeError, TypeError):
        return None
    return helper


class _Leaver(event.Listener):
    """Ends the helper before its next kernel when whoever called it is gone: none is half kept."""

    def __init__(self) -> None:
        self._alone = False
        Thread(target=self._wait, daemon=True).start()

    def _wait(self) -> None:
        os.read(sys.stdin.fileno(), 1)  # nothing comes, but its end
        self._alone = True

    def on_start(self, event: Any) -> None:
        if self._alone:
            raise SystemExit

    def on_end(self, event: Any) -> None:
        """Go on."""


def main() -> None:
    """Compile conjugate gradients, then the slope of the likelihood, on planes of nothing."""
    camera = CameraIntrinsics(64.0, 64.0, 31.5, 31.5, 64, 64)
    ray, motion = pack(Motion(np.zeros(3), np.zeros(3)), camera)
    blur = BlurOperator(ray, motion, np.ones((64, 64, 3), np.float32), 4)
    sweep = blur.sweep
    latent, seen = (np.zeros(s, np.float32) for s in (sweep.latent_shape, sweep.blurred_shape))
    links = np.zeros((4, *latent.shape[1:]), np.float32)
    problem = Quadratic(sweep, seen, links, np.ones_like(latent))
    conjugate_gradients(problem, latent, latent.copy(), 1)
    lean(blur, sweep, latent, seen, seen)


if __name__ == '__main__':
    event.register('numba:compile', _Leaver())  # type: ignore[no-untyped-call]
    main()
