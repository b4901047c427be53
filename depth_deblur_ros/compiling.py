"""
Say that kernels are being compiled, when they are: the first run of an installation takes long.

numba keeps them beside the package, where that folder cannot be written in the user's cache
folder, or where NUMBA_CACHE_DIR says. One process compiles one kernel at a time; so, where there
is a second core, a helper begins with those that are needed last, and leaves them there as well.
"""

from __future__ import annotations

import atexit
from collections.abc import Callable
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
                _call_helper()

    def on_end(self, event: Any) -> None:
        """Nothing to say."""


def tell_of_compiling(say: Callable[[str], None]) -> None:
    """Call `say` with one line if kernels are compiled from now on, not if they are cached."""
    event.register('numba:compile', _Teller(say))  # type: ignore[no-untyped-call]


def _call_helper() -> None:
    """Let another process compile, no longer than this one lives; without it, all is done here."""
    command = [sys.executable, '-P', '-m', 'depth_deblur_ros.compiling']
    none = subprocess.DEVNULL
    try:
        helper = subprocess.Popen(command, stdin=none, stdout=none, stderr=none)
    except OSError:
        return
    atexit.register(helper.kill)  # a kernel is kept whole or not at all
    Thread(target=helper.wait, daemon=True).start()


def main() -> None:
    """Compile conjugate gradients, then the slope of the likelihood, on planes of nothing."""
    camera = CameraIntrinsics(64.0, 64.0, 31.5, 31.5, 64, 64)
    ray, motion = pack(Motion(np.zeros(3), np.zeros(3)), camera)
    blur = BlurOperator(ray, motion, np.ones((64, 64, 3), np.float32), 4)
    latent, seen = (
        np.zeros(s, np.float32) for s in (blur.sweep.latent_shape, blur.sweep.blurred_shape)
    )
    links = np.zeros((4, *latent.shape[1:]), np.float32)
    problem = Quadratic(blur.sweep, seen, links, np.ones_like(latent))
    conjugate_gradients(problem, latent, latent.copy(), 1)
    lean(blur, blur.sweep, latent, seen, seen)


if __name__ == '__main__':
    main()
