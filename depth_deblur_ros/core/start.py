"""
The blind start: where the first motion comes from, out of one blurred image.

The score S (evidence.py) is computed at full, half and quarter scale. Each scale proposes motions,
from a grid over shifts, roll and zoom and from random ones with parallax, refined by a shrinking
search; all scales together choose, since a false optimum at one scale seldom is one at the next.
docs/method.md (11) to (13).

Notation: q (6,) motion in pixels, p = G q (evidence.motion_axes); length = mean blur [px].
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, Motion, Outcome, Vector
from depth_deblur_ros.core.evidence import (
    Evidence,
    gather_spectra,
    motion_axes,
    scores,
    Spectra,
    thinned,
)
from depth_deblur_ros.core.geometry import blur_length
from depth_deblur_ros.core.templates import PATCH, REACH
from depth_deblur_ros.core.trust import covariance_from_curvature, sharpness
import numpy as np

SCALES = (1, 2, 4)
SHARE = {
    1: 1.0,
    2: 0.5,
    4: 0.25,
}  # of a scale in the common score: coarse bands are deep but inexact
PARALLAX_COST = 2e-5  # of S per squared pixel: shifts are likelier than parallax
FEW = 4  # patches; a coarse scale with less has no vote
MANY = 40  # patches of a scale, of which half are heard on all proposals
HEARD_TWICE, CANDIDATES = 8000, 3000  # proposals that all patches judge; that seeds are of
SEEDS = 8  # distinct motions that each scale refines
NEAR = 3.0  # px; how wide it is searched around a guess
ASTRAY = 6.0  # px from the guess, beyond which all is searched
ROOM = 10  # px of templates around the guess, more than the search around it goes
SPREAD = (1.0, 1.0, 1.5, 1.5, 1.0, 1.0)  # of the search along each axis of q
ROUNDS, TRIES, SHRINK = 14, 200, 0.78
SATURATED = 0.98
SHORTEST = 1.5  # px; below, a motion is not told from the lens's own blur
SHORT = 8.0  # px; up to here only the full scale sees bands at all
SHORT_TRUST = 0.11  # least -S at full scale of a short blur
LONG_TRUST = 0.2  # least common -S of a long blur
DOUBT = 1.3  # times that where the picture looks sharp
CLEARLY_SHARP, RATHER_SHARP = (
    1.15,
    1.065,
)  # trust.sharpness: nothing to search; no motion and no blur
BELIEF = 0.4  # common -S at which a motion is taken for certain
OBSERVATIONS = 400.0  # that S^2 is worth (covariance), calibrated on cases with known truth
PRIOR_PX = 40.0  # px, standard deviation of q where the image tells nothing
BEND = 1.0  # px, step of the second differences


@dataclass(frozen=True, eq=False)
class Start:
    """The first motion p (6,) (zero unless solved), what it is worth, and its covariance."""

    motion: Motion
    outcome: Outcome
    quality: float


@dataclass(frozen=True, eq=False)
class Scale:
    """One scale of the search: its evidence and its factor."""

    factor: int
    evidence: Evidence


def blind_start(
    grey: FloatImage,
    depth: FloatImage,
    camera: CameraIntrinsics,
    guess: Motion | None = None,
) -> Start:
    """
    Find the motion from one grey image (H, W), stored values, and its filled depth (H, W) [m].

    guess: a further motion to start from. The sign of the answer is arbitrary: p and -p blur
    alike.
    """
    axes = motion_axes(depth, camera)
    edges = sharpness(grey)
    if edges > CLEARLY_SHARP:
        return _nothing(Outcome.SHARP, axes)
    spectra = _spectra(grey, depth, camera, axes)
    if not spectra:
        return _nothing(Outcome.FAILED, axes)

    def length(q: Vector) -> float:
        return blur_length(axes @ q, depth, camera)

    first = np.asarray(np.linalg.solve(axes, guess.vector)) if guess else None
    if first is not None:
        scales = _scales(spectra, first)
        q = _refine(_refine(first[None], scales, NEAR), scales, 1.0)[0]
    if first is None or length(q - first) > ASTRAY or not _trusted(q, length(q), scales, edges):
        scales = _scales(spectra)
        q = _search(scales, first)
        if not _trusted(q, length(q), scales, edges):
            return _nothing(Outcome.SHARP if edges > RATHER_SHARP else Outcome.FAILED, axes)
    quality = min(1.0, float(-common_score(q[None], scales)[0]) / BELIEF)
    return Start(
        Motion.from_vector(axes @ q, _covariance(q, scales, axes)), Outcome.SOLVED, quality
    )


def _trusted(q: Vector, length: float, scales: list[Scale], edges: float) -> bool:
    """Tell whether the bands are deep enough for a blur of this length [px]."""
    if length < SHORTEST:
        return False
    if length < SHORT:
        return bool(scores(q[None], scales[0].evidence)[0] < -SHORT_TRUST)
    needed = LONG_TRUST * (DOUBT if edges > RATHER_SHARP else 1)
    return bool(common_score(q[None], scales)[0] < -needed)


def _nothing(outcome: Outcome, axes: Vector) -> Start:
    """Give no motion: still to within SHORTEST when sharp, anything when failed."""
    spread = SHORTEST / 2 if outcome is Outcome.SHARP else PRIOR_PX
    covariance = spread**2 * axes @ axes.T
    quality = 1.0 if outcome is Outcome.SHARP else 0.0
    return Start(Motion.from_vector(np.zeros(6), covariance), outcome, quality)


def _covariance(q: Vector, scales: list[Scale], axes: Vector) -> Vector:
    """Give the covariance (6, 6) of p from how S^2 / 2 bends around q."""
    steps = BEND * np.eye(6)
    tries = [
        q + a * steps[i] + b * steps[j] for i in range(6) for j in range(6) for a, b in _SIGNS
    ]
    value = np.square(np.minimum(common_score(np.array(tries), scales), 0)) / 2
    bend = -(value.reshape(6, 6, 4) @ np.array([1, -1, -1, 1])) / (4 * BEND**2)
    return np.asarray(axes @ covariance_from_curvature(bend, OBSERVATIONS, PRIOR_PX) @ axes.T)


_SIGNS = ((1, 1), (1, -1), (-1, 1), (-1, -1))


def _spectra(
    grey: FloatImage, depth: FloatImage, camera: CameraIntrinsics, axes: Vector
) -> dict[int, Spectra]:
    """Look at each scale that holds enough patches, at the full one always, by its factor."""
    whole = _whole(grey)
    found: dict[int, Spectra] = {}
    for factor in SCALES:
        width, height = camera.width // factor, camera.height // factor
        if min(width, height) < PATCH:
            break
        images = [
            np.asarray(cv2.resize(array, (width, height), interpolation=how), np.float32)
            for array, how in (
                (grey, cv2.INTER_AREA),
                (whole, cv2.INTER_AREA),
                (depth, cv2.INTER_NEAREST),
            )
        ]
        small, whole_small, near = images
        scaled = camera.scaled(width, height)
        spectra = gather_spectra(small, whole_small, near, scaled, axes)
        if found and len(spectra.weight) < FEW:
            break
        found[factor] = spectra
    return found


def _scales(spectra: dict[int, Spectra], near: Vector | None = None) -> list[Scale]:
    """Gather the evidence of each scale, of all motions or of those near one."""
    if near is None:
        return [Scale(factor, own.evidence()) for factor, own in spectra.items()]
    return [
        Scale(factor, own.evidence_around(near, ROOM // factor + 2))
        for factor, own in spectra.items()
    ]


def _whole(grey: FloatImage) -> FloatImage:
    """Give 1 where the pixel and its neighbourhood are not saturated, softly falling to 0."""
    burnt = cv2.GaussianBlur((grey > SATURATED).astype(np.float32), (0, 0), 3)
    return np.clip(1 - 2 * burnt, 0, 1)


def common_score(qs: Vector, scales: list[Scale]) -> Vector:
    """Give the score (m,) of motions q (m, 6) over all scales, with the price of parallax."""
    total = PARALLAX_COST * (qs[:, 4] ** 2 + qs[:, 5] ** 2)
    for scale in scales:
        total = total + SHARE[scale.factor] * scores(qs, scale.evidence)
    return np.asarray(total)


def _search(scales: list[Scale], guess: Vector | None) -> Vector:
    """Let each scale propose and all choose; q (6,)."""
    found = [] if guess is None else [guess]
    for scale in scales:
        found.extend(_refine(_seeds(scale), [scale], 2.0 * scale.factor))
    return np.asarray(_refine(_choose(np.array(found), scales)[None], scales, 1.0)[0])


def _choose(qs: Vector, scales: list[Scale]) -> Vector:
    """Pick the motion that all scales like best; a scale of few patches has less to say."""
    total = np.zeros(len(qs))
    for scale in scales:
        patches = len(scale.evidence.weight)
        total += patches / (patches + 1) * scores(qs, scale.evidence)
    return np.asarray(qs[int(np.argmin(total))])


@lru_cache(maxsize=1)
def _proposals() -> Vector:
    """Give motions (m, 6) [px] over what one scale can see: a grid, and random with parallax."""
    steps = np.arange(-REACH + 2, REACH - 1, 2.0)
    grid = np.stack(
        np.meshgrid(steps, steps[steps >= 0], np.linspace(-18, 18, 7), np.linspace(-12, 12, 5)), -1
    ).reshape(-1, 4)
    grid = np.concatenate([grid, np.zeros((len(grid), 2))], 1)
    random = np.random.default_rng(0).standard_normal((30000, 6)) * (14, 14, 7, 6, 3, 3)
    return np.concatenate([grid, random])


def _seeds(scale: Scale) -> Vector:
    """Pick the best proposals (n, 6) of a scale that differ by more than 4 of its pixels."""
    qs = scale.factor * _proposals()
    if len(scale.evidence.weight) >= MANY:
        qs = _best(qs, Scale(scale.factor, thinned(scale.evidence)), HEARD_TWICE)
    qs = _best(qs, scale, CANDIDATES)
    chosen: list[Vector] = []
    while len(qs) and len(chosen) < SEEDS:
        chosen.append(qs[0])
        qs = qs[np.abs(qs - qs[0]).max(1) > 4 * scale.factor]
    return np.array(chosen)


def _best(qs: Vector, scale: Scale, count: int) -> Vector:
    """Give the motions that a scale likes best, the best first."""
    values = common_score(qs, [scale])
    some = np.argpartition(values, count)[:count] if count < len(qs) else np.arange(len(qs))
    return np.asarray(qs[some[np.argsort(values[some], kind='stable')]])


@lru_cache(maxsize=1)
def _steps() -> Vector:
    """Give the steps (ROUNDS, TRIES, 6) of the shrinking search, in units of its radius."""
    steps = np.random.default_rng(0).standard_normal((ROUNDS, TRIES, 6)) * SPREAD
    return np.asarray(steps * SHRINK ** np.arange(ROUNDS)[:, None, None])


def _refine(qs: Vector, scales: list[Scale], radius: float) -> Vector:
    """Shrinking random search around each of qs (n, 6), the same each time; radius [px]."""
    best, each = common_score(qs, scales), np.arange(len(qs))
    for steps in _steps():
        tries = qs[:, None] + radius * steps
        values = common_score(tries.reshape(-1, 6), scales).reshape(len(qs), -1)
        k = np.argmin(values, 1)
        better = values[each, k] < best
        best = np.where(better, values[each, k], best)
        qs = np.where(better[:, None], tries[each, k], qs)
    return qs
