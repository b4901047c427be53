"""
From stored values to light and back.

Light adds up during the exposure, stored values do not: `transfer` (data.py) says how they were
coded. Notation: v stored value 0..1, l(v) light 0..1, l'(v) its slope. [sRGB] IEC 61966-2-1:
l = u^2.4 = u^3 u^(-3/5), u = (v + 0.055) / 1.055, v = 1.055 l l^(-7/12) - 0.055, and so
1 / l' = 1.055 / 2.4 l^(-7/12), but for the darkest, where l and v are lines.
"""

from __future__ import annotations

from depth_deblur_ros.core.data import FloatImage
from depth_deblur_ros.core.powers import over_seven_twelfths, over_three_fifths
from depth_deblur_ros.core.threads import on_threads, SHARED
from numba import njit
import numpy as np

SLOPE_FLOOR = 0.15  # l' falls to 0.08 in black, where quantisation, not light, decides
KNEE, GRADIENT = 0.0031308, 12.92  # [sRGB] of light
LINEAR_TO = 0.04045  # [sRGB] of stored values
FINITE = {'nnan', 'ninf', 'nsz', 'contract'}  # what the compiler may take for granted


def light_from_stored(stored: FloatImage, transfer: str) -> FloatImage:
    """Give the light l(v) of stored values v in 0..1."""
    return stored if transfer == 'linear' else _mapped(stored, _to_light)


def stored_from_light(light: FloatImage, transfer: str) -> FloatImage:
    """Give the stored values of light, clipped to 0..1."""
    if transfer == 'linear':
        return np.clip(light, 0, 1)
    return _mapped(light, _to_stored)


def as_colour(image: FloatImage) -> FloatImage:
    """Give an image (H, W, 3); a grey one (H, W) thrice."""
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, 2)


def light_slope(stored: FloatImage, transfer: str) -> FloatImage:
    """Give l'(v), no less than SLOPE_FLOOR: noise of light is noise of v times this."""
    if transfer == 'linear':
        return np.ones_like(stored)
    return _mapped(stored, _to_slope)


def light_ease(stored: FloatImage, transfer: str) -> FloatImage:
    """Give 1 / l'(v)^2, l' as `light_slope`."""
    if transfer == 'linear':
        return np.ones_like(stored)
    return _mapped(stored, _to_ease)


def stored_and_ease(light: FloatImage, transfer: str) -> tuple[FloatImage, FloatImage]:
    """Give stored values of light, as `stored_from_light`, and `light_ease` of them."""
    if transfer == 'linear':
        stored = stored_from_light(light, transfer)
        return stored, light_ease(stored, transfer)
    flat = np.ascontiguousarray(light, np.float32).reshape(-1)
    stored, ease = np.empty_like(flat), np.empty_like(flat)
    on_threads(_to_both, flat.size, flat, stored, ease)
    return stored.reshape(light.shape), ease.reshape(light.shape)


def _mapped(values: FloatImage, curve) -> FloatImage:  # type: ignore[no-untyped-def]
    """Send each value through a curve."""
    flat = np.ascontiguousarray(values, np.float32).reshape(-1)
    found = np.empty_like(flat)
    on_threads(curve, flat.size, flat, found)
    return found.reshape(values.shape)


@njit(cache=True, nogil=True, inline='always')
def _within(v):  # type: ignore[no-untyped-def]
    return min(max(v, np.float32(0)), np.float32(1))


@njit(cache=True, nogil=True, inline='always')
def _base(v):  # type: ignore[no-untyped-def]
    """Give u of a stored value, 1 of 1."""
    return np.float32(1) - (np.float32(1) - v) * np.float32(1 / 1.055)


@njit(cache=True, nogil=True, inline='always')
def _slope(v):  # type: ignore[no-untyped-def]
    """Give l'(v), no less than SLOPE_FLOOR, which is more than where it is a line."""
    u = _base(v)
    slope = np.float32(2.4 / 1.055) * u * u * over_three_fifths(u)
    return max(slope, np.float32(SLOPE_FLOOR))


@njit(cache=True, nogil=True, inline='always')
def _coded(x, bright, over):  # type: ignore[no-untyped-def]
    """Give the stored value of light x; bright: no less than KNEE, over: its power -7/12."""
    curved = np.float32(1) - np.float32(1.055) * (np.float32(1) - bright * over)
    return curved if x > np.float32(KNEE) else np.float32(GRADIENT) * x


# Unsigned indices: numba checks signed ones, and a loop that does is not turned into vector code.
@njit(fastmath=FINITE, **SHARED)
def _to_light(first, end, values, found):  # type: ignore[no-untyped-def]
    for k in range(np.uintp(first), np.uintp(end)):
        v = _within(values[k])
        u = _base(v)
        curved = u * u * u * over_three_fifths(u)
        found[k] = curved if v > np.float32(LINEAR_TO) else v * np.float32(1 / GRADIENT)


@njit(fastmath=FINITE, **SHARED)
def _to_slope(first, end, values, found):  # type: ignore[no-untyped-def]
    for k in range(np.uintp(first), np.uintp(end)):
        found[k] = _slope(_within(values[k]))


@njit(fastmath=FINITE, **SHARED)
def _to_ease(first, end, values, found):  # type: ignore[no-untyped-def]
    for k in range(np.uintp(first), np.uintp(end)):
        slope = _slope(_within(values[k]))
        found[k] = np.float32(1) / (slope * slope)


@njit(fastmath=FINITE, **SHARED)
def _to_stored(first, end, values, found):  # type: ignore[no-untyped-def]
    for k in range(np.uintp(first), np.uintp(end)):
        x = _within(values[k])
        bright = max(x, np.float32(KNEE))
        found[k] = _coded(x, bright, over_seven_twelfths(bright))


@njit(fastmath=FINITE, **SHARED)
def _to_both(first, end, values, stored, ease):  # type: ignore[no-untyped-def]
    for k in range(np.uintp(first), np.uintp(end)):
        x = _within(values[k])
        bright = max(x, np.float32(KNEE))
        over = over_seven_twelfths(bright)
        stored[k] = _coded(x, bright, over)
        ease[k] = min(np.float32((1.055 / 2.4) ** 2) * over * over, np.float32(SLOPE_FLOOR**-2))
