"""
The joint refinement: from what the spectra tell to the motion that makes the image likeliest.

The spectra (start.py) tell the motion to half a pixel and cannot go far wrong; the likelihood
(likelihood.py) knows it to a tenth, near by. Four parts of the frame are asked; where they
disagree by more than chance, their word counts for less and the start's for more,
docs/method.md (19).

Notation: p (9,) motion by rows; g_k, H_k slope and curvature of part k; C_0 the start's
covariance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
import math

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, InputError, Motion, Vector
from depth_deblur_ros.core.geometry import blur_length
from depth_deblur_ros.core.light import stored_from_light
from depth_deblur_ros.core.likelihood import curvature_of, Pace, Part, posterior, settled, slope_of
from depth_deblur_ros.core.pyramid import Level, scaled_level
from depth_deblur_ros.core.start import Start
from depth_deblur_ros.core.threads import each
import numpy as np

MOST = 200_000  # px that are looked at; at half the size half of them, which show twice as much
SATURATED = 0.97  # stored values
LEAST_SIDE = 48  # px of a part
LONGEST_MOVE = 1.0  # px
NEGLIGIBLE = 0.0075  # share of the blur; the first shorter move is the last
# What the likelihood is divided by: at least; per chi^2 of the parts. A camera that stores values
# by a curve follows sRGB's only about, and the parts share what that gets wrong.
SOFTEST = 10.0
DISSENT = {'linear': 6.0, 'srgb': 25.0}
FLATTER = 0.65  # than its first curvature the likelihood is on the way to its optimum
BENDS = (0.3, 1.2)  # least and most that moves may correct the curvature by


@dataclass(frozen=True)
class Effort:
    """What a refinement may cost: px that are looked at, moves, the pace of each look."""

    pixels: int = MOST  # and no more
    moves: int = 4
    enough: float = 0.15  # px; the first shorter move is the last
    affordable: float = 40.0  # px; of longer blurs, fewer pixels are looked at
    readable: float = 50.0  # px; longer blurs are refined at half the size, or less
    doubt: float = 1.0  # times as large is the covariance as that of a refinement to the end
    instants: float = math.inf  # over the mean blur, at most: noise hides finer ones
    pace: Pace = field(default_factory=Pace)

    def __post_init__(self) -> None:
        shares = self.enough, self.affordable, self.readable, self.doubt, self.instants
        more = all(value > 0 for value in shares)
        if self.pixels < 1 or self.moves < 1 or not more:
            raise InputError(f'pixels, moves must be >= 1, the rest > 0, not {self}')


@dataclass(frozen=True, eq=False)
class Pull:
    """What holds against the likelihood: the start (9,), its certainty (9, 9), and dissent."""

    start: Vector
    certainty: Vector
    dissent: float


def refine(
    light: FloatImage,
    depth: FloatImage,
    camera: CameraIntrinsics,
    start: Start,
    effort: Effort,
) -> Motion:
    """
    Give the motion, with its covariance, that makes blurred grey light (H, W) likeliest.

    depth (H, W) filled [m]; start: what the spectra tell, whose covariance takes part.
    """

    def length(p: Vector) -> float:
        return blur_length(p, depth, camera)

    p, certainty = start.motion.by_rows, np.asarray(np.linalg.inv(start.spread), np.float64)
    level, pixels = _readable(Level(light, depth, camera), length(p), effort)
    spacing = blur_length(p, level.depth, level.camera) / effort.instants
    pace = replace(effort.pace, spacing=max(effort.pace.spacing, spacing))
    # Side by side: they are too small for two threads to share one.
    begun = each(lambda k: _begun(_part(level, k, pixels, pace), p), range(4))
    pull = Pull(p, certainty, DISSENT[camera.transfer])
    return _moved(begun, pull, length, effort)


def _moved(
    begun: list[tuple[Part, Vector, Vector]],
    pull: Pull,
    length: Callable[[Vector], float],
    effort: Effort,
) -> Motion:
    """Go where the slope of the likelihood and the pull of the start balance."""
    parts, slopes, curvatures = zip(*begun, strict=True)
    bends, gs, p = np.array(curvatures), np.array(slopes), pull.start
    bend = FLATTER * bends.sum(0)
    enough = max(effort.enough, NEGLIGIBLE * length(p))
    for k in range(effort.moves):
        soft = _softening(gs, bends, pull.dissent)
        force = gs.sum(0) / soft + pull.certainty @ (p - pull.start)
        move = -np.linalg.solve(bend / soft + pull.certainty, force)
        move *= min(1.0, LONGEST_MOVE / max(length(move), 1e-9))
        p = p + move
        if length(move) < enough or k == effort.moves - 1:
            break
        last, gs = gs.sum(0), np.array(each(partial(_slope, p=p), parts))
        bend = _bent(bend, bends.sum(0), move, gs.sum(0) - last)
    return Motion.from_vector(p, np.linalg.inv(bend / soft + pull.certainty)[:6, :6])


def _slope(part: Part, p: Vector) -> Vector:
    return slope_of(posterior(part, p))[0]


def _begun(part: Part, p: Vector) -> tuple[Part, Vector, Vector]:
    """Settle a part at the start; give it with its slope and curvature there."""
    found = settled(part, p)
    slope, image = slope_of(found)
    return found.part, slope, curvature_of(found, image)


def _softening(gs: Vector, bends: Vector, dissent: float) -> float:
    """
    Give the divisor, by how far the slopes gs (n, 9) of the parts are apart at their optimum.

    Far is what would move that optimum: a part that tells little may be as wrong as it likes.
    """
    inverse = np.linalg.inv(bends.sum(0))
    shares = inverse @ bends
    apart = gs - gs.sum(0) @ shares
    found = float(np.einsum('ni,ij,nj', apart, inverse, apart))
    by_chance = len(inverse) - float(np.einsum('nij,nji', shares, shares))
    return max(SOFTEST, dissent * found / by_chance)


def _bent(bend: Vector, first: Vector, move: Vector, change: Vector) -> Vector:
    """Correct the curvature (9, 9) by how a move changed the slope, within BENDS of the first."""
    rest = change - bend @ move
    weight = float(rest @ move)
    if abs(weight) > 1e-8 * float(np.linalg.norm(rest) * np.linalg.norm(move)):
        bend = bend + np.outer(rest, rest) / weight
    root = np.linalg.cholesky(first)
    inner = np.linalg.solve(root, np.linalg.solve(root, bend).T)
    values, vectors = np.linalg.eigh((inner + inner.T) / 2)
    half = root @ vectors
    return np.asarray(half * np.clip(values, *BENDS) @ half.T)


def _readable(level: Level, length: float, effort: Effort) -> tuple[Level, float]:
    """Give the level at a size where the blur is readable, and how many px of it to look at."""
    factor, least = 1, min(level.image.shape)
    pixels = min(effort.pixels, level.image.size)
    while length > effort.readable * factor and least >= 4 * LEAST_SIDE * factor:
        factor *= 2
    if factor > 1:
        level = scaled_level(level, level.camera.width // factor, level.camera.height // factor)
    return level, min(pixels * min(1.0, effort.affordable * factor / length), MOST / factor)


def _part(level: Level, k: int, pixels: float, pace: Pace) -> Part:
    """Choose the most textured part of quarter k, for a quarter of so many pixels."""
    light, depth, camera = level.image, level.depth, level.camera
    height, width = (side // 2 for side in light.shape)
    share = min(1.0, math.sqrt(pixels / light.size))
    rows, columns = int(height * share), int(width * share)
    top, left = k // 2 * height, k % 2 * width
    quarter = light[top : top + height, left : left + width]
    y, x = _busiest(stored_from_light(quarter, camera.transfer), rows, columns)
    box = np.s_[top + y : top + y + rows, left + x : left + x + columns]
    cut = camera.cropped(left + x, top + y, columns, rows)
    own = np.ascontiguousarray(light[box])
    counts = (stored_from_light(own, camera.transfer) < SATURATED).astype(np.float32)
    return Part(own, counts, np.ascontiguousarray(depth[box]), cut, k, pace=pace)


def _busiest(stored: FloatImage, rows: int, columns: int) -> tuple[int, int]:
    """Find the window of this size with the strongest gradients; its first row and column."""
    sums = cv2.integral(np.hypot(*np.gradient(stored)))
    inside = sums[rows:, columns:] - sums[:-rows, columns:]
    inside = inside - sums[rows:, :-columns] + sums[:-rows, :-columns]
    y, x = np.unravel_index(int(np.argmax(inside)), inside.shape)
    return int(y), int(x)
