"""
From stored values to light and back.

Light adds up during the exposure, stored values do not: `transfer` (data.py) says how they were
coded. Notation: v stored value 0..1, l(v) light 0..1, l'(v) its slope. [sRGB] IEC 61966-2-1.
"""

from __future__ import annotations

from depth_deblur_ros.core.data import FloatImage
import numpy as np

SLOPE_FLOOR = 0.15  # l' falls to 0.08 in black, where quantisation, not light, decides
_KNEES = np.linspace(0, 1, 4097, dtype=np.float32)
_LIGHT = np.where(_KNEES <= 0.04045, _KNEES / 12.92, ((_KNEES + 0.055) / 1.055) ** 2.4).astype(
    np.float32
)


def light_from_stored(stored: FloatImage, transfer: str) -> FloatImage:
    """Give the light l(v) of stored values v in 0..1."""
    if transfer == 'linear':
        return stored
    return np.interp(stored, _KNEES, _LIGHT).astype(np.float32)


def stored_from_light(light: FloatImage, transfer: str) -> FloatImage:
    """Give the stored values of light, clipped to 0..1."""
    clipped = np.clip(light, 0, 1)
    if transfer == 'linear':
        return clipped
    return np.interp(clipped, _LIGHT, _KNEES).astype(np.float32)


def light_slope(stored: FloatImage, transfer: str) -> FloatImage:
    """Give l'(v), no less than SLOPE_FLOOR: noise of light is noise of v times this."""
    if transfer == 'linear':
        return np.ones_like(stored)
    base = (stored + np.float32(0.055)) / np.float32(1.055)
    slope = np.float32(2.4 / 1.055) * base ** np.float32(1.4)
    return np.asarray(np.maximum(slope, np.float32(SLOPE_FLOOR)), np.float32)
