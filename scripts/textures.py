"""
Procedural textures: square tiles of linear light with their mip levels.

Each painter draws one kind of surface from a random generator, smooth at the scale of a texel, so
that a texture looked up at the right level holds nothing finer than the pixel grid.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.float32]  # (SIDE, SIDE, 3)
Rng = np.random.Generator

SIDE = 1024  # texels, a power of two
SOFTNESS = 0.7  # texels; sigma of the blur that takes away the drawing's stair-steps


def linear_from_srgb(values: npt.NDArray[Any]) -> Image:
    """Undo the sRGB curve."""
    low, high = values / 12.92, ((values + 0.055) / 1.055) ** 2.4
    return np.where(values <= 0.04045, low, high).astype(np.float32)


def srgb_from_linear(light: npt.NDArray[Any]) -> Image:
    """Apply the sRGB curve, clipped to 0..1."""
    light = np.clip(light, 0, 1)
    low, high = 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055
    return np.where(light <= 0.0031308, low, high).astype(np.float32)


def noise(rng: Rng, slope: float, stretch: float = 1.0) -> Image:
    """Draw periodic noise (SIDE, SIDE) with amplitude 1/f^slope, zero mean, unit deviation."""
    fy = np.fft.fftfreq(SIDE)[:, None] * stretch
    radius = np.hypot(fy, np.fft.rfftfreq(SIDE)[None, :])
    radius[0, 0] = np.inf
    spectrum = np.fft.rfft2(rng.standard_normal((SIDE, SIDE))) / radius**slope
    field = np.fft.irfft2(spectrum, (SIDE, SIDE))
    return np.asarray((field - field.mean()) / field.std(), np.float32)


def _colour(
    rng: Rng, low: float = 0.15, high: float = 0.9, spread: float = 0.2
) -> tuple[float, float, float]:
    grey = rng.uniform(low, high)
    r, g, b = np.clip(grey + rng.uniform(-spread, spread, 3), 0.03, 0.97)
    return float(r), float(g), float(b)


def _blank(colour: tuple[float, float, float]) -> Image:
    return np.full((SIDE, SIDE, 3), colour, np.float32)


def plaster(rng: Rng) -> Image:
    """Draw a wall: hardly any texture."""
    return _blank(_colour(rng, 0.62, 0.8, 0.05)) + 0.012 * noise(rng, 1.4)[..., None]


def stucco(rng: Rng) -> Image:
    """Draw 1/f noise in two hues, as of stone, carpet or foliage."""
    light, hue = noise(rng, 1.1), noise(rng, 1.3)
    tint = np.array(_colour(rng, 0.4, 0.6), np.float32) - 0.5
    image = _blank(_colour(rng, 0.35, 0.6)) + 0.11 * light[..., None]
    return np.asarray(image + hue[..., None] * tint * 0.35, np.float32)


def wood(rng: Rng) -> Image:
    """Draw boards with a warped grain."""
    grain = noise(rng, 1.0, stretch=0.04) * 0.5 + noise(rng, 1.6) * 0.35
    rings = np.sin(9 * noise(rng, 1.9, stretch=0.15) + 2 * grain)
    image = _blank((0.55, 0.38, 0.24))
    image *= (1 + 0.14 * grain + 0.08 * rings)[..., None]
    for x in np.arange(0, SIDE, SIDE // 8):
        image[:, x : x + SIDE // 8] *= rng.uniform(0.85, 1.12)
        cv2.line(image, (int(x), 0), (int(x), SIDE), (0.16, 0.1, 0.06), 4, cv2.LINE_AA)
    return image


def checker(rng: Rng) -> Image:
    """Draw tiles with mortar, each of its own shade."""
    count = int(rng.integers(9, 14))
    shades = rng.uniform(0.3, 0.75, (count, count, 1))
    shades = shades + rng.uniform(-0.05, 0.05, (count, count, 3))
    shades[::2, ::2] += 0.14
    image = cv2.resize(shades.astype(np.float32), (SIDE, SIDE), interpolation=cv2.INTER_NEAREST)
    for k in range(count + 1):
        at = round(k * SIDE / count)
        cv2.line(image, (at, 0), (at, SIDE), (0.25, 0.24, 0.22), 5, cv2.LINE_AA)
        cv2.line(image, (0, at), (SIDE, at), (0.25, 0.24, 0.22), 5, cv2.LINE_AA)
    return np.asarray(image + 0.045 * noise(rng, 0.9)[..., None], np.float32)


def leaves(rng: Rng) -> Image:
    """Draw overlapping shapes of all sizes: dead leaves, with the statistics of photographs."""
    image = _blank(_colour(rng))
    for size in np.sort(12 * rng.uniform(0.0025, 1, 500) ** -0.6)[::-1]:
        centre = rng.uniform(0, SIDE, 2)
        angles = np.sort(rng.uniform(0, 2 * np.pi, int(rng.integers(3, 8))))
        if rng.random() < 0.5:
            angles = np.linspace(0, 2 * np.pi, 40)
        axes = size * rng.uniform(0.5, 1.2, 2)
        points = centre + axes * np.stack([np.cos(angles), np.sin(angles)], -1)
        fixed = np.round(points * 16).astype(np.int32)
        cv2.fillPoly(image, [fixed], _colour(rng, 0.08, 0.92), cv2.LINE_AA, 4)
    return image + 0.02 * noise(rng, 0.8)[..., None]


def _write(image: Image, rng: Rng, at: tuple[int, int], size: int, length: int) -> None:
    """Draw a line of made-up letters: strokes between the points of a 3 x 4 grid."""
    grid = np.array([(i, j) for i in range(3) for j in range(4)], np.float64) * (0.3, 0.33)
    ink = _colour(rng, 0.05, 0.25) if image[at[1], at[0]].mean() > 0.5 else (0.95, 0.95, 0.9)
    for k in range(length):
        if rng.random() < 0.16:
            continue
        strokes = rng.choice(grid, int(rng.integers(3, 6)), replace=False) * size
        corner = np.array([at[0] + 0.85 * k * size, at[1]])
        fixed = np.round((strokes + corner) * 16).astype(np.int32)
        cv2.polylines(image, [fixed], False, ink, max(2, size // 8), cv2.LINE_AA, 4)


def page(rng: Rng) -> Image:
    """Draw a poster: a heading, columns of letters, a picture."""
    image = _blank(_colour(rng, 0.75, 0.9))
    cv2.rectangle(image, (0, 0), (SIDE, 190), _colour(rng, 0.25, 0.42), -1)
    _write(image, rng, (40, 40), 110, 10)
    picture = cv2.resize(leaves(rng), (420, 420), interpolation=cv2.INTER_AREA)
    image[250:670, 570:990] = picture
    for y in range(250, SIDE - 60, 52):
        _write(image, rng, (36, y), int(rng.integers(28, 36)), 34 if y > 690 else 17)
    return image


def books(rng: Rng) -> Image:
    """Draw three shelves of book spines."""
    image = _blank((0.2, 0.15, 0.11))
    for bottom in (325, 665, 1005):
        x = 8
        while x < SIDE - 20:
            width, height = int(rng.integers(22, 70)), int(rng.integers(210, 305))
            low, high = (x, bottom - height), (x + width, bottom)
            cv2.rectangle(image, low, high, _colour(rng, 0.12, 0.85), -1, cv2.LINE_AA)
            band = bottom - int(rng.integers(50, 200))
            cv2.rectangle(image, (x, band), (x + width, band + 26), _colour(rng), -1, cv2.LINE_AA)
            x += width + int(rng.integers(2, 10))
        cv2.rectangle(image, (0, bottom), (SIDE, bottom + 18), (0.45, 0.32, 0.2), -1)
    return image + 0.015 * noise(rng, 0.8)[..., None]


def cloth(rng: Rng) -> Image:
    """Draw a woven pattern: two crossing waves, bent by noise."""
    y, x = np.mgrid[0:SIDE, 0:SIDE] * (2 * np.pi / SIDE)
    bend = 0.6 * noise(rng, 1.7)
    wave = np.sin(26 * x + bend) * np.sin(26 * y - bend) + 0.6 * np.sin(7 * (x + y) + bend)
    tint = np.array(_colour(rng, 0.4, 0.6), np.float32)
    shade = 0.16 * wave + 0.05 * noise(rng, 0.8)
    return np.asarray(tint * (1 + shade[..., None]), np.float32)


def glass(rng: Rng) -> Image:
    """Draw something dark and nearly plain: a screen or a lacquered box."""
    return _blank((0.13, 0.135, 0.15)) + 0.01 * noise(rng, 1.5)[..., None]


PAINTERS: dict[str, Callable[[Rng], Image]] = {
    painter.__name__: painter
    for painter in (plaster, stucco, wood, checker, leaves, page, books, cloth, glass)
}


def paint(name: str, rng: Rng) -> Image:
    """Paint one texture, softened to its texel grid, as linear light."""
    soft = cv2.GaussianBlur(PAINTERS[name](rng), (0, 0), SOFTNESS, borderType=cv2.BORDER_REFLECT)
    return linear_from_srgb(np.clip(soft, 0.02, 0.98))


def mip_levels(texture: Image) -> Image:
    """Stack a texture and its halvings, down to one texel, as rows (n, 3)."""
    levels = [texture]
    while levels[-1].shape[0] > 1:
        a = levels[-1]
        quarter = np.float32(0.25)
        levels.append(quarter * (a[::2, ::2] + a[1::2, ::2] + a[::2, 1::2] + a[1::2, 1::2]))
    return np.concatenate([level.reshape(-1, 3) for level in levels])
