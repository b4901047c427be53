"""
Templates: which bands a straight blur leaves in the log-spectrum of a patch.

A blur by u pixels multiplies the spectrum by sinc(f.u); the window smears it a little, noise and
neighbours fill its zeros. What scenes have by themselves, a power law and a strength for each
direction, is taken out. docs/method.md (8), (9).

Notation: f spatial frequency [cycles/px]; u, v flow over the exposure [px], whole numbers here;
T template, n values; D = |T|^2 / n. Between whole pixels T is taken to be bilinear; |T|^2 then
sags below what lies between the D of four corners by a (1 - a) |T(u + 1) - T(u)|^2, and so on.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

from depth_deblur_ros.core.data import FloatImage, Vector
from depth_deblur_ros.core.lanes import load, splat, store, WIDTH
from depth_deblur_ros.core.threads import on_threads, SHARED
from numba import njit
import numpy as np
import numpy.typing as npt

PATCH = 96  # px
REACH = (
    56  # px; longest flow of the table along each axis; longer blurs are seen at coarser scales
)
SECTORS = 24  # directions in which a scene may be strong or weak by itself
BAND = (2.5 / PATCH, 0.25)  # cycles/px: above the window's own width, below the lens's blur
HALF = PATCH // 2 + 1  # columns of the half spectrum
BAND_COLUMNS = int(BAND[1] * PATCH)  # of them from zero on, in the band
FLOOR = 0.035  # how deep the dark bands are filled by noise and by neighbours in the window
BLOCK = 2 * WIDTH  # flows that are matched together
ACROSS = -(-(2 * REACH + 1) // BLOCK) * BLOCK  # columns of the table: u = -REACH.., then unused

Blocks = npt.NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Table:
    """Templates of all flows, 1 px apart: rows v = 0..REACH, columns u = -REACH..REACH, unused."""

    bins: npt.NDArray[np.intp]  # (n,) flat indices into the half spectrum
    nuisance: FloatImage  # Q (n, k) orthonormal
    nuisance_blocks: tuple[FloatImage, FloatImage]  # Q and Q', laid out by in_blocks
    templates: FloatImage  # (rows, blocks, n, BLOCK)
    energy: FloatImage  # (rows, ACROSS) D
    sag: FloatImage  # (rows, ACROSS, 2) |T(u + 1) - T(u)|^2 / n, and along v, of each cell


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
    t = np.stack([_row(v, bins) for v in range(REACH + 1)], 1)
    flat = t.reshape(len(bins), -1)
    flat -= nuisance @ (nuisance.T @ flat)
    energy, sag = _energies(t)
    blocks = t.reshape(len(bins), REACH + 1, -1, BLOCK).transpose(1, 2, 0, 3)
    both = (in_blocks(nuisance), in_blocks(nuisance.T))
    return Table(bins, nuisance, both, np.ascontiguousarray(blocks), energy, sag)


def _row(v: int, bins: npt.NDArray[np.intp]) -> FloatImage:
    """Give the log-spectra (n, ACROSS) of straight blurs (u, v), smeared by the window."""
    side = BAND_COLUMNS + 1  # one more, to smear
    # f.u comes in steps of 1 / PATCH: S(f.u) is looked up.
    spectrum = np.sinc(np.arange(2 * side * ACROSS) / PATCH).astype(np.float32) ** 2
    kx, ky = np.arange(-1, side), np.arange(-side, side + 1)
    u = np.arange(ACROSS) - REACH
    wide = np.asarray(spectrum[np.abs(ky[:, None, None] * v + kx[:, None] * u)])
    for _ in range(2):
        smeared = (wide[:, :-2] + 4 * wide[:, 1:-1] + wide[:, 2:]) / np.float32(6)
        wide = np.asarray(smeared, np.float32).swapaxes(0, 1)
    row, column = np.divmod(bins, HALF)
    row = np.where(row > PATCH // 2, row - PATCH, row) + BAND_COLUMNS
    return np.asarray(np.log(wide[row, column] + np.float32(FLOOR)))


def _energies(t: FloatImage) -> tuple[FloatImage, FloatImage]:
    """Give D of templates (n, rows, ACROSS), and by how much |T|^2 may sag in each cell."""
    sag = np.zeros((*t.shape[1:], 2), np.float32)
    along, down = (_mean_square(np.diff(t, axis=axis)) for axis in (2, 1))
    sag[:-1, :-1, 0] = (along[:-1] + along[1:]) / 2
    sag[:-1, :-1, 1] = (down[:, :-1] + down[:, 1:]) / 2
    return _mean_square(t), sag


def _mean_square(t: FloatImage) -> FloatImage:
    return np.asarray(np.einsum('nvu,nvu->vu', t, t) / np.float32(len(t)))


def matches(logs: FloatImage, templates: FloatImage, some: Blocks | None = None) -> FloatImage:
    """
    Give C = <y, T> / n, (B, rows, ACROSS), of log-spectra y (B, n) and templates.

    some (rows, blocks): the blocks that are wanted; the others are zero.
    """
    rows, blocks, count, _ = templates.shape
    wanted = np.arange(rows * blocks) if some is None else np.flatnonzero(some)
    found = product(logs / np.float32(count), templates.reshape(-1, count, BLOCK), wanted)
    return found.reshape(len(logs), rows, -1)


def in_blocks(matrix: FloatImage) -> FloatImage:
    """Lay out a matrix (n, m) as (blocks, n, BLOCK), the last block filled up with zeros."""
    n, m = matrix.shape
    padded = np.pad(matrix, [(0, 0), (0, -m % BLOCK)])
    return np.ascontiguousarray(padded.reshape(n, -1, BLOCK).swapaxes(0, 1))


def product(
    left: FloatImage, blocks: FloatImage, wanted: npt.NDArray[np.intp] | None = None
) -> FloatImage:
    """
    Multiply left (B, n) by a matrix in blocks; (B, columns of all blocks), unwanted ones zero.

    On threads of ours: a BLAS would keep its own, which wait by spinning.
    """
    if wanted is None:
        wanted = np.arange(len(blocks))
    padded = np.zeros((-(-len(left) // 4) * 4, left.shape[1]), np.float32)
    padded[: len(left)] = left
    found = np.zeros((len(padded), len(blocks) * BLOCK), np.float32)
    on_threads(_multiply, wanted.size, padded, blocks.reshape(len(blocks), -1), wanted, found)
    return found[: len(left)]


def blocks_around(flow: Vector, room: int) -> Blocks:
    """Say which blocks (rows, blocks) hold flows within `room` px of those of flow (B, 2)."""
    wanted = np.zeros((REACH + 1, ACROSS // BLOCK), np.bool_)
    u = flow[:, :1] + np.append(np.arange(-room, room, BLOCK), room)
    v = np.rint(flow[:, 1:] + np.arange(-room, room + 1))
    u, v = np.broadcast_arrays(u[:, None], v[..., None])
    for sign in (1, -1):  # u, v and -u, -v are one; the row v = 0 serves both
        inside = (np.abs(u) <= REACH) & (sign * v >= 0) & (np.abs(v) <= REACH)
        wanted[np.abs(v[inside]).astype(int), (sign * u[inside] + REACH).astype(int) // BLOCK] = (
            True
        )
    return wanted


@njit(cache=True, nogil=True, inline='always')
def _multiply_four(first, left, block, out):  # type: ignore[no-untyped-def]
    """Multiply four rows by a block (n * BLOCK,)."""
    a = a2 = b = b2 = c = c2 = d = d2 = splat(np.float32(0))
    for k in range(left.shape[1]):
        t, t2 = load(block, k * BLOCK), load(block, k * BLOCK + WIDTH)
        y = splat(left[first, k])
        a += y * t
        a2 += y * t2
        y = splat(left[first + 1, k])
        b += y * t
        b2 += y * t2
        y = splat(left[first + 2, k])
        c += y * t
        c2 += y * t2
        y = splat(left[first + 3, k])
        d += y * t
        d2 += y * t2
    store(out, 0, a)
    store(out, WIDTH, a2)
    store(out, BLOCK, b)
    store(out, BLOCK + WIDTH, b2)
    store(out, 2 * BLOCK, c)
    store(out, 2 * BLOCK + WIDTH, c2)
    store(out, 3 * BLOCK, d)
    store(out, 3 * BLOCK + WIDTH, d2)


@njit(**SHARED)
def _multiply(first, end, left, blocks, wanted, found):  # type: ignore[no-untyped-def]
    """Write left (4 m, n) times some wanted blocks (k, n * BLOCK) into found (4 m, k * BLOCK)."""
    for i in range(first, end):
        k = wanted[i]
        out = np.empty(4 * BLOCK, np.float32)
        for row in range(0, left.shape[0], 4):
            _multiply_four(row, left, blocks[k], out)
            for j in range(4 * BLOCK):
                found[row + j // BLOCK, k * BLOCK + j % BLOCK] = out[j]
