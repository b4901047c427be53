"""
The search: which motion the spectra of one picture's patches fit best.

The score S (evidence.py) is computed at full, half and quarter scale. Each scale proposes motions,
from a grid over shifts, roll and zoom and from random ones with parallax, refined by a shrinking
search; all scales together choose, since a false optimum at one scale seldom is one at the next.
Short blurs are looked at again with the picture's middle at twice its size, where bands up to
the finest frequency count. docs/method.md (11), (12).

Notation: q (6,) or (9,), with turns that rows see differently, motion in pixels, p = G q
(evidence.motion_axes).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, Vector
from depth_deblur_ros.core.evidence import (
    gather_spectra,
    MAX_PATCHES,
    patches_in,
    Spectra,
    thinned,
)
from depth_deblur_ros.core.scores import (
    CLOSE,
    common_score,
    PARALLAX_COST,
    rough_scores,
    Scale,
    scores,
    SHARE,
    WITNESS,
)
from depth_deblur_ros.core.shrinking import shrink_around
from depth_deblur_ros.core.templates import PATCH, REACH
import numpy as np

SCALES = (1, 2, 4)
FEW = 4  # patches; a coarse scale with less has no vote
FEWER = 56  # patches of a scale that are looked at where the motion is about known
MANY = 40  # patches of a scale, of which half are heard on all proposals, roughly
HEARD_TWICE, CANDIDATES = 1500, 1000  # proposals that are judged exactly; that seeds are of
SEEDS = 8  # distinct motions that each scale refines
NEAR = 3.0  # px; how wide it is searched around a guess
DEEPER = 1.08  # times as deep bands make twice a motion likelier
ROOM = 10  # px of templates around the guess, more than the search around it goes
BESIDE = 2  # px of them around a motion that is not searched around
TRIES_OF_SEEDS = 100  # in each round, around each of them
DESCENTS, FLATTEST = 2, 1e-3  # Newton's steps; least share of the largest curvature
ALONG = (0.2, 0.4, 0.7, 1.0, 1.4)  # of such a step are tried
LAST_RADIUS = 0.3  # px
FARTHEST = 8.0  # times that along what the scales hardly tell
BEND = 1.0  # px, step of the differences
_CORNERS = ((1, 1), (1, -1), (-1, 1), (-1, -1))
SATURATED = 0.98
CLOSE_SIDES = (240, 320)  # px, rows and columns of the middle that is seen close up, at least
CLOSE_REACH = 12  # px of templates around no motion, at full scale
CLOSE_SPREAD = (2.5, 2.5, 1.5, 1.5, 0.5, 0.5)  # px of what is proposed there
CLOSE_SEEDS = 4


def find(spectra: Mapping[float, Spectra], guess: Vector | None) -> tuple[Vector, list[Scale]]:
    """Let each scale propose and all choose; q (9,), and what the scales say of all motions."""
    scales = _scales(spectra)
    return _search(scales, guess), scales


def ask_twice(q: Vector, scales: list[Scale]) -> tuple[Vector, list[Scale]]:
    """
    Give twice the motion where that is what coarse scales see, and they alone then.

    A blur that leaves the full scale's table is there taken for half of it.
    """
    coarse = scales[1:]
    if not coarse:
        return q, scales
    twice = _settled(2 * q, coarse, 2 * NEAR)
    one, other = common_score(np.array([q, twice]), coarse)
    return (twice, coarse) if other < DEEPER * one else (q, scales)


def find_near(spectra: Mapping[float, Spectra], guess: Vector) -> tuple[Vector, list[Scale]]:
    """Find q (9,) around a guess (9,), and what the scales say of the motions there."""
    scales = _scales(spectra, guess)
    return _settled(guess, scales, NEAR), scales


def seen_at(spectra: Spectra, q: Vector) -> float:
    """Give -S of one motion (9,) by what one scale saw."""
    return -float(scores(q[None], spectra.evidence_around(q, BESIDE))[0])


def find_short(scale: Scale, spectra: Spectra, near: Vector | None) -> tuple[Vector, list[Scale]]:
    """
    Find a short q (9,), at full scale and close up, around one if it is known.

    scale: of the full picture; spectra: what `close_up` saw. No row sees another turn: of so short
    a blur that is too little to show.
    """
    around, room = (np.zeros(9), CLOSE_REACH) if near is None else (near, ROOM)
    both = [scale, Scale(CLOSE, spectra.evidence_around(around, round(room / CLOSE)))]
    found = _best(_short(), both, CLOSE_SEEDS) if near is None else near[None, :6]
    found = _by_rows(shrink_around(found, both, 1.0))
    return found[int(np.argmin(common_score(found, both)))], both


def look(
    grey: FloatImage,
    depth: FloatImage,
    camera: CameraIntrinsics,
    axes: Vector,
    most: int = MAX_PATCHES,
) -> dict[float, Spectra]:
    """
    Look at each scale that holds enough patches, at the full one always, by its factor.

    most: patches of a scale that are looked at; where the motion is about known FEWER will do.
    """
    whole = _whole(grey)
    found: dict[float, Spectra] = {}
    for factor in SCALES:
        size = camera.width // factor, camera.height // factor
        if min(size) < PATCH or (found and patches_in(size) < FEW):
            break
        images = grey, whole, depth
        found[factor] = _seen(images, camera.scaled(*size), axes, cv2.INTER_AREA, most)
    return found


def look_again(
    grey: FloatImage, depth: FloatImage, camera: CameraIntrinsics, axes: Vector
) -> dict[float, Spectra]:
    """Look at the scale of the witness, if it holds enough patches."""
    size = int(camera.width / WITNESS), int(camera.height / WITNESS)
    if min(size) < PATCH or patches_in(size) < FEW:
        return {}
    images = (grey, _whole(grey), depth)
    return {WITNESS: _seen(images, camera.scaled(*size), axes, cv2.INTER_AREA, MAX_PATCHES)}


def close_up(
    grey: FloatImage,
    depth: FloatImage,
    camera: CameraIntrinsics,
    axes: Vector,
    most: int = MAX_PATCHES,
) -> Spectra:
    """Look at the picture's middle at twice its size; most as in `look`."""
    rows, columns = (
        min(side, max(side // 2, least))
        for side, least in zip(grey.shape, CLOSE_SIDES, strict=True)
    )
    top, left = (grey.shape[0] - rows) // 2, (grey.shape[1] - columns) // 2
    middle = np.s_[top : top + rows, left : left + columns]
    cut = camera.cropped(left, top, columns, rows)
    images = (grey[middle], _whole(grey[middle]), depth[middle])
    return _seen(images, cut.scaled(2 * columns, 2 * rows), axes, cv2.INTER_CUBIC, most)


def _seen(
    images: tuple[FloatImage, FloatImage, FloatImage],
    camera: CameraIntrinsics,
    axes: Vector,
    how: int,
    most: int,
) -> Spectra:
    """Look at grey values, what counts of them, and depth at the size of a camera."""
    size, ways = (camera.width, camera.height), (how, cv2.INTER_AREA, cv2.INTER_NEAREST)
    grey, whole, depth = (
        np.asarray(cv2.resize(array, size, interpolation=way), np.float32)
        for array, way in zip(images, ways, strict=True)
    )
    return gather_spectra((grey, whole, depth), camera, axes, most)


def _scales(spectra: Mapping[float, Spectra], near: Vector | None = None) -> list[Scale]:
    """Gather the evidence of each scale, of all motions or of those near one."""
    if near is None:
        return [Scale(factor, own.evidence()) for factor, own in spectra.items()]
    return [
        Scale(factor, own.evidence_around(near, int(ROOM // factor) + 2))
        for factor, own in spectra.items()
    ]


def _whole(grey: FloatImage) -> FloatImage:
    """Give 1 where the pixel and its neighbourhood are not saturated, softly falling to 0."""
    burnt = (grey > SATURATED).astype(np.float32)
    if burnt.any():
        burnt = np.asarray(cv2.GaussianBlur(burnt, (0, 0), 3))
    return np.clip(1 - 2 * burnt, 0, 1)


def _search(scales: list[Scale], guess: Vector | None) -> Vector:
    """Let each scale propose and all choose; q (9,)."""
    found = [] if guess is None else [guess[:6]]
    for scale in scales:
        found.extend(
            shrink_around(_seeds(scale), [scale], 2.0 * scale.factor, count=TRIES_OF_SEEDS)
        )
    return _settled(_by_rows(_choose(np.array(found), scales)[None])[0], scales, NEAR)


def _settled(q: Vector, scales: list[Scale], radius: float) -> Vector:
    """Search around one of q (9,), then go down to the bottom; radius [px]."""
    q = shrink_around(q[None], scales, radius)[0]
    best = common_score(q[None], scales)[0]
    for _ in range(DESCENTS):
        slope, bend = slope_and_bend(q, scales)
        values, vectors = np.linalg.eigh(bend)
        steep = np.maximum(np.abs(values), FLATTEST * np.abs(values).max())
        step = -vectors @ (vectors.T @ slope / steep)
        step *= min(1.0, radius / max(np.abs(step).max(), 1e-9))
        tries = q + np.outer(ALONG, step)
        told = common_score(tries, scales)
        k = int(np.argmin(told))
        if told[k] >= best:
            break
        q, best = tries[k], told[k]
    reach = np.minimum(FARTHEST, np.sqrt(steep.max() / steep))
    spread = vectors * reach @ vectors.T
    return np.asarray(shrink_around(q[None], scales, LAST_RADIUS, spread=spread)[0])


def slope_and_bend(q: Vector, scales: list[Scale]) -> tuple[Vector, Vector]:
    """Give slope (9,) and curvature (9, 9) of the common score at q, by differences."""
    steps, size = BEND * np.eye(q.size), q.size
    first, second = np.triu_indices(size)
    corners = [q + a * steps[first] + b * steps[second] for a, b in _CORNERS]
    value = common_score(np.concatenate(corners), scales).reshape(len(_CORNERS), -1)
    bend = np.empty((size, size))
    bend[first, second] = np.array([1, -1, -1, 1]) @ value / (4 * BEND**2)
    bend[second, first] = bend[first, second]
    sides = common_score(np.concatenate([q + steps, q - steps]), scales)
    return (sides[:size] - sides[size:]) / (2 * BEND), bend


def _by_rows(qs: Vector) -> Vector:
    """Give q (m, 9) of (m, 6): no row sees another turn yet."""
    return np.pad(qs, [(0, 0), (0, 3)])


def _choose(qs: Vector, scales: list[Scale]) -> Vector:
    """Pick the motion that all scales like best; a scale of few patches has less to say."""
    total = np.zeros(len(qs))
    for scale in scales:
        patches = len(scale.evidence.weight)
        total += patches / (patches + 1) * scores(qs, scale.evidence)
    return np.asarray(qs[int(np.argmin(total))])


@lru_cache(maxsize=1)
def _proposals() -> Vector:
    """
    Give motions (m, 6) [px] over what one scale can see: a grid, and random with parallax.

    Short ones are known by shallow bands, so they need to be met more closely.
    """
    steps = np.arange(-REACH + 2, REACH - 1, 4.0)
    grid = np.stack(
        np.meshgrid(steps, steps[steps >= 0], np.linspace(-18, 18, 7), np.linspace(-12, 12, 5)), -1
    ).reshape(-1, 4)
    grid = np.concatenate([grid, np.zeros((len(grid), 2))], 1)
    random = np.random.default_rng(0).standard_normal((15000, 6)) * (14, 14, 7, 6, 3, 3)
    return np.concatenate([grid, random, _short()])


@lru_cache(maxsize=1)
def _short() -> Vector:
    """Give short motions (m, 6) [px]."""
    return np.random.default_rng(0).standard_normal((6000, 6)) * CLOSE_SPREAD


def _seeds(scale: Scale) -> Vector:
    """Pick the best proposals (n, 6) of a scale that differ by more than 4 of its pixels."""
    qs, heard = scale.factor * _proposals(), scale.evidence
    if len(heard.weight) >= MANY:
        heard = thinned(heard)
    price = PARALLAX_COST * np.square(qs[:, 4:]).sum(1)
    told = price + SHARE[scale.factor] * rough_scores(qs, heard)
    qs = _lowest(qs, told, HEARD_TWICE)
    left = np.ascontiguousarray(_best(qs, [scale], CANDIDATES).T)
    chosen: list[Vector] = []
    while left.size and len(chosen) < SEEDS:
        chosen.append(left[:, 0])
        left = left[:, np.abs(left - left[:, :1]).max(0) > 4 * scale.factor]
    return np.array(chosen)


def _best(qs: Vector, scales: list[Scale], count: int) -> Vector:
    """Give the motions that the scales like best, the best first."""
    return _lowest(qs, common_score(qs, scales), count)


def _lowest(qs: Vector, values: Vector, count: int) -> Vector:
    """Give the motions of the lowest values, in their order."""
    some = np.argpartition(values, count)[:count] if count < len(qs) else np.arange(len(qs))
    return np.asarray(qs[some[np.argsort(values[some], kind='stable')]])
