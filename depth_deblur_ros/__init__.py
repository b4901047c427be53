"""Deblurs RGB-D images: the public names."""

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
