"""
What the spectra of patches say about a motion, for scores.py.

The dark bands that a blur leaves stand out of the log-spectrum whatever the scene is,
docs/method.md (8) to (10).

Notation: u (2,) flow of a patch over the exposure [px]; y_b log-spectrum of patch b and T_u
template (templates.py), both without what scenes have by themselves; C_b(u) = <y_b, T_u> / n;
D(u) = |T_u|^2 / n; w_b weight; p = G q motion, q (6,) in pixels (motion_axes), or (9,) where
rows may see different turns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, Vector
from depth_deblur_ros.core.geometry import interaction_matrix, rows_matrix
from depth_deblur_ros.core.spectra import patch_spectra
from depth_deblur_ros.core.templates import (
    Blocks,
    blocks_around,
    matches,
    PATCH,
    product,
    template_table,
)
import numpy as np

STEP = 48  # px between patches, about; more where that makes too many
CLIP = (-4.0, 3.0)  # log-spectrum; beyond lie dead patches and lines of the sensor
MAX_PATCHES = 280
SPARSE = 4  # every so many-th pixel of a patch tells its depth


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the patches of one scale say: C (B, rows, ACROSS), D, sag, w (B,), J G (B, 2, 9)."""

    match: FloatImage
    energy: FloatImage
    sag: FloatImage
    weight: FloatImage
    flow_of_q: FloatImage


@dataclass(frozen=True, eq=False)
class Spectra:
    """What is seen at one scale: y (B, n), w (B,), J G (B, 2, 9)."""

    logs: FloatImage
    weight: FloatImage
    flow_of_q: FloatImage

    def evidence(self) -> Evidence:
        """Match all patches with all templates."""
        return self._matched(None)

    def evidence_around(self, q: Vector, room: int) -> Evidence:
        """Match them with the templates within about `room` px of motion q; the others say 0."""
        return self._matched(blocks_around(self.flow_of_q @ q, room))

    def _matched(self, some: Blocks | None) -> Evidence:
        table = template_table()
        match = matches(self.logs, table.templates, some)
        return Evidence(match, table.energy, table.sag, self.weight, self.flow_of_q)


def gather_spectra(
    images: tuple[FloatImage, FloatImage, FloatImage],
    camera: CameraIntrinsics,
    axes: Vector,
    most: int = MAX_PATCHES,
) -> Spectra:
    """
    Look at the patches of one scale, no more than `most`.

    images (H, W) each: grey, what counts of it 0..1 (0 = saturated or not trusted), and depth [m];
    axes G (9, 9).
    """
    table = template_table()
    grey, valid, depth = images
    corners = _corners(grey.shape, most)
    power, weight = patch_spectra(grey, valid, corners, table.bins)
    logs = np.log(power + np.float32(1e-12))
    there, back = table.nuisance_blocks
    logs -= product(product(logs, there)[:, : len(table.nuisance.T)], back)[:, : len(table.bins)]
    np.clip(logs, *CLIP, out=logs)
    weight = weight**0.25
    return Spectra(
        logs,
        weight / max(float(weight.sum()), 1e-12),  # all 0 where all is plain
        _flow_of_q(corners, depth, camera, axes).astype(np.float32),
    )


def patches_in(size: tuple[int, int]) -> int:
    """Give how many patches an image of (width, height) px holds."""
    return len(_corners(size, MAX_PATCHES))


def _corners(shape: tuple[int, ...], most: int) -> list[tuple[int, int]]:
    """Spread patches evenly from border to border: STEP apart, farther if that is too many."""
    counts = [max(1, round((side - PATCH) / STEP) + 1) for side in shape[:2]]
    share = min(1.0, math.sqrt(most / math.prod(counts)))
    ys, xs = (
        np.linspace(0, side - PATCH, max(1, int(share * count))).round().astype(int)
        for side, count in zip(shape, counts, strict=False)
    )
    return [(int(y), int(x)) for y in ys for x in xs]


def _flow_of_q(
    corners: list[tuple[int, int]], depth: FloatImage, camera: CameraIntrinsics, axes: Vector
) -> Vector:
    """Give J_b G (B, 2, 9): the flow of each patch's middle, at the median depth there."""
    middle = np.array([(x + PATCH / 2 - 0.5, y + PATCH / 2 - 0.5) for y, x in corners])
    inner = np.arange(PATCH // 4, 3 * PATCH // 4, SPARSE)
    ys, xs = np.array(corners).T[..., None, None] + inner
    near = depth[ys.swapaxes(1, 2), xs].reshape(len(corners), -1)
    own = np.median(near, axis=1).astype(np.float64)
    j = interaction_matrix(middle[:, 0], middle[:, 1], own, camera)
    return np.asarray(rows_matrix(j, middle[:, 1], camera) @ axes)


def motion_axes(depth: FloatImage, camera: CameraIntrinsics) -> Vector:
    """
    Give G (9, 9): p = G q with q in pixels: two shifts, roll, zoom, two parallaxes, three by rows.

    A shift is a rotation that moves the middle by 1 px, roll and zoom move the corner by 1 px, a
    parallax is a translation with the rotation that keeps the mean depth in place, scaled so that
    depth's spread moves 1 px. By rows: shifts and roll that are 1 px more in the last row than in
    the first.
    """
    mean, spread = (float(value[0, 0]) for value in cv2.meanStdDev(1 / depth))
    spread = max(spread, 0.02 * mean)
    corner = 0.5 * np.hypot(camera.width / camera.fx, camera.height / camera.fy)
    g = np.zeros((9, 9))
    g[1, 0], g[0, 1] = 1 / camera.fx, -1 / camera.fy
    g[2, 2] = 1 / (corner * camera.fx)
    g[5, 3] = -1 / (corner * mean * camera.fx)
    g[3, 4], g[1, 4] = 1 / (spread * camera.fx), -mean / (spread * camera.fx)
    g[4, 5], g[0, 5] = 1 / (spread * camera.fy), mean / (spread * camera.fy)
    g[6:, 6:] = camera.fy / camera.height * g[:3, :3]
    return g


def thinned(evidence: Evidence) -> Evidence:
    """Give what every second patch says."""
    e = evidence
    match, weight, flow = (array[::2].copy() for array in (e.match, e.weight, e.flow_of_q))
    return replace(e, match=match, weight=weight / max(weight.sum(), 1e-12), flow_of_q=flow)
