"""
What the spectra of patches say about a motion: the score that the blind start searches.

A straight blur by u pixels multiplies the spectrum of a patch by sinc(f.u): its dark bands stand
out of the log-spectrum whatever the scene is. All patches together say which motion p explains
their bands, by a matched filter that is normalised, so that a template without bands cannot win,
docs/method.md (8) to (11).

Notation: f spatial frequency [cycles/px]; u (2,) flow of a patch over the exposure [px];
y_b log-spectrum of patch b and T_u template, both without what scenes have by themselves (a power
law and a strength for each direction); C_b(u) = <y_b, T_u> / n; D(u) = |T_u|^2 / n;
p = G q motion, q (6,) in pixels (motion_axes).

    S(p) = -sum_b w_b C_b(J_b p) / sqrt(sum_b w_b D(J_b p) + 0.1),    the lower the better
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, Vector
from depth_deblur_ros.core.geometry import interaction_matrix
from numba import njit, prange
import numpy as np
import numpy.typing as npt

PATCH = 96  # px
STEP = 48  # px between patches
REACH = (
    56  # px; longest flow of the table along each axis; longer blurs are seen at coarser scales
)
SECTORS = 24  # directions in which a scene may be strong or weak by itself
BAND = (2.5 / PATCH, 0.25)  # cycles/px: above the window's own width, below the lens's blur
FLOOR = 0.035  # how deep the dark bands are filled by noise and by neighbours in the window
CLIP = (-4.0, 3.0)  # log-spectrum; beyond lie dead patches and lines of the sensor
EVEN = 0.1  # of S: keeps faint templates from winning by their small norm
MAX_PATCHES = 400


@dataclass(frozen=True, eq=False)
class Table:
    """Templates of all flows, 1 px apart: rows v = 0..REACH, columns u = -REACH..REACH."""

    bins: npt.NDArray[np.intp]  # (n,) flat indices into the half spectrum
    nuisance: FloatImage  # (n, k) orthonormal
    templates: FloatImage  # (n, rows * columns)
    energy: FloatImage  # (rows, columns) D


@dataclass(frozen=True, eq=False)
class Evidence:
    """What the patches of one scale say: C (B, rows, columns), D, w (B,), J G (B, 2, 6)."""

    match: FloatImage
    energy: FloatImage
    weight: Vector
    flow_of_q: Vector


@lru_cache(maxsize=1)
def template_table() -> Table:
    """Compute the templates once per process."""
    fy, fx = np.meshgrid(np.fft.fftfreq(PATCH), np.fft.rfftfreq(PATCH), indexing='ij')
    r = np.hypot(fx, fy)
    bins = np.flatnonzero((r > BAND[0]) & (r < BAND[1]))
    sector = (np.arctan2(fy, fx) / np.pi * SECTORS).astype(int) % SECTORS
    columns = [(sector.flat[bins] == k).astype(float) for k in range(SECTORS)]
    columns += [np.log(r.flat[bins]), r.flat[bins] ** 2]
    nuisance = np.linalg.qr(np.stack(columns, 1))[0].astype(np.float32)
    us = np.arange(-REACH, REACH + 1, dtype=float)
    rows = []
    for v in range(REACH + 1):
        rows.append(_templates(fx, fy, bins, us, float(v)))
    t = np.concatenate(rows, 1)
    t = (t - nuisance @ (nuisance.T @ t)).astype(np.float32)
    energy = np.square(t).mean(0).reshape(REACH + 1, len(us))
    return Table(bins, nuisance, t, energy.astype(np.float32))


def _templates(
    fx: Vector, fy: Vector, bins: npt.NDArray[np.intp], us: Vector, v: float
) -> FloatImage:
    """Give log-spectra (n, len(us)) of straight blurs (u, v), smeared by the window."""
    spectra = np.sinc(fx[None] * us[:, None, None] + fy[None] * v) ** 2
    # The half spectrum is continued by its mirror image: S(-f) = S(f).
    left = np.roll(spectra[:, ::-1, 1:2], 1, axis=1)
    wide = np.concatenate([left, spectra, spectra[:, :, -2:-1]], 2)
    wide = (wide[:, :, :-2] + 4 * wide[:, :, 1:-1] + wide[:, :, 2:]) / 6
    wide = (np.roll(wide, 1, 1) + 4 * wide + np.roll(wide, -1, 1)) / 6
    logs = np.log(wide + FLOOR).reshape(len(us), -1)[:, bins]
    return np.asarray(logs.T, np.float32)


def gather_evidence(
    grey: FloatImage, valid: FloatImage, depth: FloatImage, camera: CameraIntrinsics, axes: Vector
) -> Evidence:
    """
    Match all patches of one scale with all templates.

    grey (H, W), valid (H, W) 0..1 (0 = saturated or not trusted), depth (H, W) [m]; axes G (6, 6).
    """
    table = template_table()
    corners = _corners(grey.shape)
    gx, gy = _differences(grey)
    window = np.outer(*[np.hanning(PATCH + 2)[1:-1].astype(np.float32)] * 2)
    logs = np.empty((len(corners), len(table.bins)), np.float32)
    weight = np.empty(len(corners))
    for k, (y, x) in enumerate(corners):
        cut = np.s_[y : y + PATCH, x : x + PATCH]
        w = window * valid[cut]
        power = np.abs(np.fft.rfft2(w * gx[cut])) ** 2 + np.abs(np.fft.rfft2(w * gy[cut])) ** 2
        logs[k] = np.log(power.flat[table.bins] + 1e-12)
        weight[k] = np.square(w * gx[cut]).mean() + np.square(w * gy[cut]).mean()
    logs -= (logs @ table.nuisance) @ table.nuisance.T
    np.clip(logs, *CLIP, out=logs)
    match = (logs @ table.templates) / np.float32(len(table.bins))
    return Evidence(
        match.reshape(len(corners), *table.energy.shape),
        table.energy,
        weight**0.25 / max(float((weight**0.25).sum()), 1e-12),  # all 0 where all is plain
        _flow_of_q(corners, depth, camera, axes),
    )


def _corners(shape: tuple[int, ...]) -> list[tuple[int, int]]:
    """Spread patches evenly over the image, about STEP apart, from border to border."""
    spots = []
    for side in shape[:2]:
        count = max(1, round((side - PATCH) / STEP) + 1)
        spots.append(np.linspace(0, side - PATCH, count).round().astype(int))
    grid = [(int(y), int(x)) for y in spots[0] for x in spots[1]]
    return grid[:: -(-len(grid) // MAX_PATCHES)]


def _differences(grey: FloatImage) -> tuple[FloatImage, FloatImage]:
    kernel = np.array([[-0.5, 0, 0.5]], np.float32)
    gx, gy = cv2.filter2D(grey, -1, kernel), cv2.filter2D(grey, -1, kernel.T.copy())
    return np.asarray(gx, np.float32), np.asarray(gy, np.float32)


def _flow_of_q(
    corners: list[tuple[int, int]], depth: FloatImage, camera: CameraIntrinsics, axes: Vector
) -> Vector:
    """Give J_b G (B, 2, 6): the flow of each patch's middle, at the median depth there."""
    quarter = PATCH // 4
    middle = np.array([(x + PATCH / 2 - 0.5, y + PATCH / 2 - 0.5) for y, x in corners])
    inner = [
        np.median(depth[y + quarter : y + 3 * quarter, x + quarter : x + 3 * quarter])
        for y, x in corners
    ]
    j = interaction_matrix(middle[:, 0], middle[:, 1], np.array(inner, np.float64), camera)
    return np.ascontiguousarray(j @ axes)


def motion_axes(depth: FloatImage, camera: CameraIntrinsics) -> Vector:
    """
    Give G (6, 6): p = G q with q in pixels: two shifts, roll, zoom, and two parallaxes.

    A shift is a rotation that moves the middle by 1 px, roll and zoom move the corner by 1 px, a
    parallax is a translation with the rotation that keeps the mean depth in place, scaled so that
    depth's spread moves 1 px.
    """
    w = 1 / depth.astype(np.float64)
    mean, spread = float(w.mean()), max(float(w.std()), 0.02 * float(w.mean()))
    corner = 0.5 * np.hypot(camera.width / camera.fx, camera.height / camera.fy)
    g = np.zeros((6, 6))
    g[1, 0], g[0, 1] = 1 / camera.fx, -1 / camera.fy
    g[2, 2] = 1 / (corner * camera.fx)
    g[5, 3] = -1 / (corner * mean * camera.fx)
    g[3, 4], g[1, 4] = 1 / (spread * camera.fx), -mean / (spread * camera.fx)
    g[4, 5], g[0, 5] = 1 / (spread * camera.fy), mean / (spread * camera.fy)
    return g


@njit(cache=True, nogil=True, fastmath=True)
def _score(q, match, energy, weight, flow_of_q):  # type: ignore[no-untyped-def]
    """S of one motion: bilinear look-up of C and D at each patch's flow."""
    reach = energy.shape[0] - 1
    c, d = 0.0, EVEN
    for b in range(len(weight)):
        u, v = 0.0, 0.0
        for k in range(6):
            u += flow_of_q[b, 0, k] * q[k]
            v += flow_of_q[b, 1, k] * q[k]
        if v < 0:
            u, v = -u, -v
        if abs(u) >= reach or v >= reach:
            d += weight[b] * 1.0
            continue
        u += reach
        x, y = int(u), int(v)
        a, e = u - x, v - y
        w00, w01, w10, w11 = (1 - a) * (1 - e), a * (1 - e), (1 - a) * e, a * e
        m = match[b]
        c += weight[b] * (
            w00 * m[y, x] + w01 * m[y, x + 1] + w10 * m[y + 1, x] + w11 * m[y + 1, x + 1]
        )
        d += weight[b] * (
            w00 * energy[y, x]
            + w01 * energy[y, x + 1]
            + w10 * energy[y + 1, x]
            + w11 * energy[y + 1, x + 1]
        )
    return -c / np.sqrt(d)


@njit(cache=True, nogil=True, parallel=True)
def _scores(qs, match, energy, weight, flow_of_q):  # type: ignore[no-untyped-def]
    out = np.empty(len(qs))
    for i in prange(len(qs)):
        out[i] = _score(qs[i], match, energy, weight, flow_of_q)
    return out


def scores(qs: Vector, evidence: Evidence) -> Vector:
    """Give S of the motions q (m, 6) [px]."""
    e = evidence
    return np.asarray(_scores(np.ascontiguousarray(qs), e.match, e.energy, e.weight, e.flow_of_q))
