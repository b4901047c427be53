"""
What the spectra of patches say about a motion: the score that the blind start searches.

The dark bands that a blur leaves stand out of the log-spectrum whatever the scene is. All patches
together say which motion p explains their bands, by a matched filter that is normalised, so that
a template without bands cannot win, docs/method.md (8) to (11).

Notation: u (2,) flow of a patch over the exposure [px]; y_b log-spectrum of patch b and T_u
template (templates.py), both without what scenes have by themselves; C_b(u) = <y_b, T_u> / n;
D(u) = |T_u|^2 / n; p = G q motion, q (6,) in pixels (motion_axes), or (9,) where
rows may see different turns.

    S(p) = -sum_b w_b C_b(J_b p) / sqrt(sum_b w_b D(J_b p) + 0.1),    the lower the better
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, Vector
from depth_deblur_ros.core.geometry import interaction_matrix, rows_matrix
from depth_deblur_ros.core.lanes import (
    larger,
    load,
    pairs,
    splat,
    store,
    where_positive,
    whole,
    whole_blocks,
    WIDTH,
)
from depth_deblur_ros.core.spectra import patch_spectra
from depth_deblur_ros.core.templates import (
    ACROSS,
    Blocks,
    blocks_around,
    matches,
    PATCH,
    product,
    REACH,
    template_table,
)
from depth_deblur_ros.core.threads import on_threads, SHARED
from numba import njit, prange
import numpy as np

STEP = 48  # px between patches
CLIP = (-4.0, 3.0)  # log-spectrum; beyond lie dead patches and lines of the sensor
EVEN = 0.1  # of S: keeps faint templates from winning by their small norm
MAX_PATCHES = 400
CHUNK = 256  # motions that are scored together
FEW = 2 * CHUNK  # motions for which numba's own threads are not worth it
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
    grey: FloatImage, valid: FloatImage, depth: FloatImage, camera: CameraIntrinsics, axes: Vector
) -> Spectra:
    """
    Look at the patches of one scale.

    grey (H, W), valid (H, W) 0..1 (0 = saturated or not trusted), depth (H, W) [m]; axes G (9, 9).
    """
    table = template_table()
    corners = _corners(grey.shape)
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


def _corners(shape: tuple[int, ...]) -> list[tuple[int, int]]:
    """Spread patches evenly over the image, about STEP apart, from border to border."""
    spots = []
    for side in shape[:2]:
        count = max(1, round((side - PATCH) / STEP) + 1)
        spots.append(np.linspace(0, side - PATCH, count).round().astype(int))
    grid = [(int(y), int(x)) for y in spots[0] for x in spots[1]]
    return grid[:: -(-len(grid) // MAX_PATCHES)]


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
    w = 1 / depth.astype(np.float64)
    mean, spread = float(w.mean()), max(float(w.std()), 0.02 * float(w.mean()))
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


def scores(qs: Vector, evidence: Evidence) -> Vector:
    """Give S of the motions q (m, 6) or (m, 9) [px]."""
    match, energy, told, (c, d) = _laid_out(qs, evidence)
    tables = match, energy, evidence.sag.reshape(-1)
    if len(c) <= FEW:
        on_threads(_add_some, len(c) // WIDTH, *tables, *told, c, d)
    else:
        _add_all(*tables, *told, c, d)  # type: ignore[call-arg]
    return _score(c, d, len(qs))


def rough_scores(qs: Vector, evidence: Evidence) -> Vector:
    """Give about S, by the nearest templates: enough to tell which motions are worth the rest."""
    match, energy, told, (c, d) = _laid_out(qs, evidence)
    on_threads(_add_roughly, len(c) // WIDTH, match, energy, *told, c, d)
    return _score(c, d, len(qs))


def _laid_out(
    qs: Vector, e: Evidence
) -> tuple[FloatImage, FloatImage, tuple[FloatImage, ...], tuple[FloatImage, FloatImage]]:
    """Give C, D; q by components, w, J G; and the sums of C and D of whole blocks of motions."""
    count, size = qs.shape
    padded = np.zeros((size, whole_blocks(count)), np.float32)
    padded[:, :count] = qs.T
    c, d = np.zeros(padded.shape[1], np.float32), np.full(padded.shape[1], EVEN, np.float32)
    flows = np.ascontiguousarray(e.flow_of_q[..., :size]).reshape(-1, 2 * size)
    match, energy = e.match.reshape(len(e.match), -1), e.energy.reshape(-1)
    return match, energy, (padded.reshape(-1), e.weight, flows), (c, d)


def _score(c: FloatImage, d: FloatImage, count: int) -> Vector:
    return np.asarray(-c[:count].astype(np.float64) / np.sqrt(d[:count]))


@njit(cache=True, nogil=True, inline='always')
def _flow(row, q, i, step):  # type: ignore[no-untyped-def]
    """Give one row of J G times q, for sixteen motions from the i-th on."""
    flow = splat(row[0]) * load(q, i)
    flow += splat(row[1]) * load(q, i + step)
    flow += splat(row[2]) * load(q, i + 2 * step)
    flow += splat(row[3]) * load(q, i + 3 * step)
    flow += splat(row[4]) * load(q, i + 4 * step)
    flow += splat(row[5]) * load(q, i + 5 * step)
    if len(row) > 6:
        flow += splat(row[6]) * load(q, i + 6 * step)
        flow += splat(row[7]) * load(q, i + 7 * step)
        flow += splat(row[8]) * load(q, i + 8 * step)
    return flow


@njit(cache=True, nogil=True, inline='always')
def _between(table, p, w):  # type: ignore[no-untyped-def]
    """Look up sixteen cells, bilinear weights w."""
    here, right = pairs(table, p)
    below, beyond = pairs(table, p + splat(np.float32(ACROSS)))
    return w[0] * here + w[1] * right + w[2] * below + w[3] * beyond


@njit(cache=True, nogil=True, inline='always')
def _place(flow, q, i, step):  # type: ignore[no-untyped-def]
    """Give where sixteen motions' flows of a patch lie in a table, and > 0 where they do."""
    zero, reach = splat(np.float32(0)), splat(np.float32(REACH))
    half = len(flow) // 2
    u, v = _flow(flow[:half], q, i, step), _flow(flow[half:], q, i, step)
    u, v = where_positive(v, u, zero - u), larger(v, zero - v)
    inside = reach - larger(v, larger(u, zero - u))
    return where_positive(inside, u + reach, zero), where_positive(inside, v, zero), inside


@njit(cache=True, nogil=True)
def _add_patch(first, end, match, energy, sag, q, weight, flow, c, d):  # type: ignore[no-untyped-def]
    """Add what one patch says about motions `first` to `end` to c and d."""
    zero, one, w = splat(np.float32(0)), splat(np.float32(1)), splat(weight)
    for i in range(first, end, WIDTH):
        u, v, inside = _place(flow, q, i, c.size)
        x, y = whole(u), whole(v)
        a, b = u - x, v - y
        both = a * b
        corners = (one - a - b + both, a - both, b - both, both)
        place = x + y * splat(np.float32(ACROSS))
        along, down = pairs(sag, place + place)
        own = _between(energy, place, corners) - a * (one - a) * along - b * (one - b) * down
        found = where_positive(inside, w * _between(match, place, corners), zero)
        store(c, i, load(c, i) + found)
        # A flow beyond the table costs.
        store(d, i, load(d, i) + w * where_positive(inside, own, one))


@njit(cache=True, nogil=True)
def _add_patches(first, end, match, energy, sag, q, weight, flows, c, d):  # type: ignore[no-untyped-def]
    """Add the patches' C and D at motions `first` to `end` of q (n * m,); flat but B first."""
    for b in range(len(weight)):
        _add_patch(first, end, match[b], energy, sag, q, weight[b], flows[b], c, d)


@njit(**SHARED)
def _add_some(first, end, match, energy, sag, q, weight, flows, c, d):  # type: ignore[no-untyped-def]
    _add_patches(first * WIDTH, end * WIDTH, match, energy, sag, q, weight, flows, c, d)


@njit(cache=True, nogil=True, parallel=True)
def _add_all(match, energy, sag, q, weight, flows, c, d):  # type: ignore[no-untyped-def]
    """Add the patches' C and D at motions q (n * m,) to c and d (m,)."""
    for k in prange(-(-c.size // CHUNK)):
        end = min((k + 1) * CHUNK, c.size)
        _add_patches(k * CHUNK, end, match, energy, sag, q, weight, flows, c, d)


@njit(**SHARED)
def _add_roughly(first, end, match, energy, q, weight, flows, c, d):  # type: ignore[no-untyped-def]
    """Add C and D of the nearest templates at sixteen motions each, from `first` to `end`."""
    zero, half = splat(np.float32(0)), splat(np.float32(0.5))
    both = np.empty(2 * energy.size, np.float32)
    for b in range(len(weight)):
        w, flow = weight[b], flows[b]
        for k in range(energy.size):
            both[2 * k], both[2 * k + 1] = w * match[b, k], w * energy[k]
        for i in range(first * WIDTH, end * WIDTH, WIDTH):
            u, v, inside = _place(flow, q, i, c.size)
            place = whole(u + half) + whole(v + half) * splat(np.float32(ACROSS))
            found, own = pairs(both, place + place)
            store(c, i, load(c, i) + where_positive(inside, found, zero))
            store(d, i, load(d, i) + where_positive(inside, own, splat(w)))
