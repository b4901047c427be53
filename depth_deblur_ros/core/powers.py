"""
Powers in plain arithmetic, so that a loop over an image becomes vector code.

x^p starts from p times the bits of x, which are about its logarithm, and goes to where the
product of whole powers of x and y = x^p is 1. float32, x > 0.
"""

from __future__ import annotations

from depth_deblur_ros.core.lanes import bits_of, of_bits
from numba import njit
import numpy as np

# (1 - p) times the bits of 1, less what makes the greatest error of the first guess least: 5 %.
_THREE_FIFTHS = np.float32((1 + 3 / 5) * (127 - 0.05) * 2**23)
_SEVEN_TWELFTHS = np.float32((1 + 7 / 12) * (127 - 0.045) * 2**23)


@njit(cache=True, nogil=True, inline='always')
def _fifth(x, y):  # type: ignore[no-untyped-def]
    """Give a closer y, x^3 y^5 = 1."""
    square = y * y
    e = np.float32(1) - x * x * x * square * square * y
    return y + y * e * (np.float32(1 / 5) + np.float32(3 / 25) * e)


@njit(cache=True, nogil=True, inline='always')
def over_three_fifths(x):  # type: ignore[no-untyped-def]
    """Give x^(-3/5) to 1e-6."""
    y = of_bits(np.int32(_THREE_FIFTHS - np.float32(3 / 5) * np.float32(bits_of(x))))
    return _fifth(x, _fifth(x, y))


@njit(cache=True, nogil=True, inline='always')
def _twelfth(x, y):  # type: ignore[no-untyped-def]
    """Give a closer y, x^7 y^12 = 1."""
    cube, third = x * x * x, y * y * y
    sixth = third * third
    e = np.float32(1) - cube * cube * x * sixth * sixth
    return y + y * e * (np.float32(1 / 12) + np.float32(13 / 288) * e)


@njit(cache=True, nogil=True, inline='always')
def over_seven_twelfths(x):  # type: ignore[no-untyped-def]
    """Give x^(-7/12) to 1e-6."""
    y = of_bits(np.int32(_SEVEN_TWELFTHS - np.float32(7 / 12) * np.float32(bits_of(x))))
    return _twelfth(x, _twelfth(x, _twelfth(x, y)))
