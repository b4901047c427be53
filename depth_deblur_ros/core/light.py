"""
From stored values to light and back.

Light adds up during the exposure, stored values do not: `transfer` (data.py) says how they were
coded. Notation: v stored value 0..1, l(v) light 0..1, l'(v) its slope. [sRGB] IEC 61966-2-1.
Powers are looked up in tables, with linear interpolation: that of l(v) has even steps of v, that
of v(l) even steps within each octave of l, counted by the bits of the float.
"""

from __future__ import annotations

from depth_deblur_ros.core.data import FloatImage
from depth_deblur_ros.core.lanes import bits_of
from depth_deblur_ros.core.threads import on_threads, SHARED
from numba import njit
import numpy as np
import numpy.typing as npt

SLOPE_FLOOR = 0.15  # l' falls to 0.08 in black, where quantisation, not light, decides
STEPS = 4096  # of v
OCTAVE_BITS = 9  # 2^9 steps in each octave of l
LEAST_BITS = (127 - 9) << 23  # of 2^-9, where the tables by octaves begin; sRGB is linear there
KNEE, GRADIENT = 0.0031308, 12.92  # [sRGB] of light
LINEAR_TO = 0.04045  # [sRGB] of stored values


def _light(v: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Give [sRGB] l(v)."""
    curved = ((v + 0.055) / 1.055) ** 2.4
    return np.asarray(np.where(v <= LINEAR_TO, v / GRADIENT, curved))


_KNEES = np.arange(STEPS + 2) / STEPS
_LIGHT = _light(_KNEES).astype(np.float32)
_SLOPE = (2.4 / 1.055 * ((_KNEES + 0.055) / 1.055) ** 1.4).astype(np.float32)
_EASE = (1 / np.maximum(_SLOPE, np.float32(SLOPE_FLOOR)) ** 2).astype(np.float32)
_OCTAVES = (
    (np.arange((9 << OCTAVE_BITS) + 2) << (23 - OCTAVE_BITS)).astype(np.int32) + LEAST_BITS
).view(np.float32)
_STORED = (1.055 * _OCTAVES.astype(np.float64) ** (1 / 2.4) - 0.055).astype(np.float32)


def light_from_stored(stored: FloatImage, transfer: str) -> FloatImage:
    """Give the light l(v) of stored values v in 0..1."""
    return stored if transfer == 'linear' else _mapped(stored, _look_up, _LIGHT)


def stored_from_light(light: FloatImage, transfer: str) -> FloatImage:
    """Give the stored values of light, clipped to 0..1."""
    if transfer == 'linear':
        return np.clip(light, 0, 1)
    return _mapped(light, _look_up_octaves, _STORED)


def as_colour(image: FloatImage) -> FloatImage:
    """Give an image (H, W, 3); a grey one (H, W) thrice."""
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, 2)


def light_slope(stored: FloatImage, transfer: str) -> FloatImage:
    """Give l'(v), no less than SLOPE_FLOOR: noise of light is noise of v times this."""
    if transfer == 'linear':
        return np.ones_like(stored)
    slope = _mapped(stored, _look_up, _SLOPE)
    return np.maximum(slope, np.float32(SLOPE_FLOOR), out=slope)


def light_ease(stored: FloatImage, transfer: str) -> FloatImage:
    """Give 1 / l'(v)^2, l' as `light_slope`."""
    if transfer == 'linear':
        return np.ones_like(stored)
    return _mapped(stored, _look_up, _EASE)


def _mapped(values: FloatImage, look_up, table: FloatImage) -> FloatImage:  # type: ignore[no-untyped-def]
    """Send each value through a table."""
    flat = np.ascontiguousarray(values, np.float32).reshape(-1)
    found = np.empty_like(flat)
    on_threads(look_up, flat.size, flat, table, found)
    return found.reshape(values.shape)


@njit(**SHARED)
def _look_up(first, end, values, table, found):  # type: ignore[no-untyped-def]
    for k in range(np.uintp(first), np.uintp(end)):
        place = STEPS * np.float64(min(max(values[k], np.float32(0)), np.float32(1)))
        i = np.uint32(place)
        found[k] = table[i] + (place - i) * (table[i + np.uint32(1)] - table[i])


@njit(**SHARED)
def _look_up_octaves(first, end, values, table, found):  # type: ignore[no-untyped-def]
    part = np.float32(2.0 ** (OCTAVE_BITS - 23))
    for k in range(np.uintp(first), np.uintp(end)):
        if values[k] > np.float32(KNEE):
            place = np.uint32(min(bits_of(values[k]), 127 << 23) - LEAST_BITS)
            i = place >> np.uint32(23 - OCTAVE_BITS)
            rest = part * np.float32(place & np.uint32((1 << (23 - OCTAVE_BITS)) - 1))
            found[k] = table[i] + rest * (table[i + np.uint32(1)] - table[i])
        else:
            found[k] = max(np.float32(GRADIENT) * values[k], np.float32(0))
