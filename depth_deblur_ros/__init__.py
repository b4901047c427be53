"""Deblurs RGB-D images: the public names."""

import os
from typing import Any, TYPE_CHECKING

from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    DeblurResult,
    InputError,
    Motion,
    Outcome,
    RgbdFrame,
)
from depth_deblur_ros.core.params import SolverParams

# Waiting threads of the kernels should sleep, but not at once: where other programs share the
# cores, spinning for long costs more than ten times the work; where none do, waking up for each
# kernel doubles the time. Read when numba loads, so it is set before.
os.environ.setdefault('OMP_WAIT_POLICY', 'passive')
os.environ.setdefault('GOMP_SPINCOUNT', '30000')

if TYPE_CHECKING:
    from depth_deblur_ros.core.solver import deblur

__all__ = [
    'CameraIntrinsics',
    'DeblurResult',
    'InputError',
    'Motion',
    'Outcome',
    'RgbdFrame',
    'SolverParams',
    'deblur',
]


def __getattr__(name: str) -> Any:
    # The solver brings compiled kernels: almost a second that --help need not pay.
    if name == 'deblur':
        from depth_deblur_ros.core.solver import deblur

        return deblur
    raise AttributeError(f'module {__name__!r} has no attribute {name!r}')
