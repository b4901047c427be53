"""
The blind start: the first motion, out of one blurred image, and whether to believe it.

search.py finds what the spectra fit best; here it is decided whether that is a motion, a sharp
picture or nothing to trust. docs/method.md (13), (14).

Notation: q (9,) motion in pixels, by rows, p = G q (evidence.motion_axes); length = mean
blur [px].
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
import math

from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, Motion, Outcome, Vector
from depth_deblur_ros.core.evidence import MAX_PATCHES, motion_axes, Spectra
from depth_deblur_ros.core.geometry import blur_length
from depth_deblur_ros.core.scores import CLOSE, common_score, Scale, scores, SHARE
from depth_deblur_ros.core.search import (
    ask_twice,
    close_up,
    FEWER,
    find,
    find_near,
    find_short,
    look,
    look_again,
    seen_at,
    slope_and_bend,
)
from depth_deblur_ros.core.trust import covariance_from_curvature, Edges
import numpy as np

ASTRAY = 6.0  # px from the guess, beyond which all is searched
SHORTEST = 1.5  # px; below, a motion is not told from the lens's own blur
SHORT = 8.0  # px; up to here only the full scale sees bands at all
SHORT_TRUST = 0.11  # least -S at full scale of a short blur
CLOSE_BELOW = 9.0  # px; shorter blurs are looked at close up
CLOSE_TRUST = 0.25  # least common -S at full scale and close up
CLOSE_SHARE = 0.12  # least -S close up by itself
CLOSE_HINT = 0.04  # -S close up of what all scales found, below which no search there reaches that
PLAIN, PLAIN_TRUST = 5.0, 0.14  # px; longer blurs show as much at full scale as well
CLOSE_BIAS = 1.0  # px; close up, blurs seem longer: the root of both squares
LONG_TRUST = 0.2  # least common -S of a long blur
# Where the full scale is the only one; shorter blurs leave deeper bands than long ones.
ALONE_TRUST, ALONE_SHORT, ALONE_SHORT_TRUST = 0.15, 16.0, 0.175
WITNESSED, APART = 12.0, 0.12  # px; such motions are asked for again; share of the length
DOUBT = 1.3  # times that where the picture looks sharp
CLEARLY_SHARP, RATHER_SHARP = (
    1.15,
    1.065,
)  # trust.sharpness: nothing to search; no motion and no blur
EVENLY_SHARP = 1.048  # trust.Edges.evenly; a picture with less is sharp only somewhere
BANDED, DEEP = 0.15, 0.27  # -S close up from which on such a picture, and any, is blurred
OUT_OF_FOCUS = 1.07  # trust.sharpness across the motion, which leaves that as it is
EDGED = 1.035  # edges of a picture with so little blur that it is seen close up alone
HALVED = 24.0  # px; shorter motions are no halves of what the full scale cannot see
LONG, LONGEST = 20.0, 30.0  # px; few, and hardly any, pictures with such a blur have edges
EDGED_COARSE = 1.06  # like these at half the size, where noise makes none: DOUBT, and twice
SMEARED, SMEAR = 1.005, 8.0  # edges that no blur below so many px leaves
BELIEF = 0.4  # common -S at which a motion is taken for certain
# Where the full scale is the only one, what has less quality is wrong one time in four: variance.
LONELY, LONELY_DOUBT = 0.45, 25.0
KEPT = 0.85  # share of -S that a motion keeps which still explains the bands (0.88 and more do)
OBSERVATIONS = 400.0  # that S^2 is worth (covariance), calibrated on cases with known truth
PRIOR_PX = 40.0  # px, standard deviation of q where the image tells nothing


@dataclass(frozen=True, eq=False)
class Start:
    """
    The first motion (zero unless solved), what it is worth, axes G and the scales that say so.

    spread (9, 9): covariance of the motion by rows, if it is the right one; doubt: how many times
    larger, as shallow bands err more and it may be another.
    """

    motion: Motion
    outcome: Outcome
    quality: float
    axes: Vector = field(default_factory=lambda: np.eye(9))
    spread: Vector = field(default_factory=lambda: np.zeros((9, 9)))
    doubt: float = 1.0
    scales: Sequence[Scale] = ()

    def explains(self, motion: Motion) -> bool:
        """Tell whether the bands are about as deep at another motion as at this one."""
        both = np.stack([self.motion.by_rows, motion.by_rows], 1)
        qs = np.asarray(np.linalg.solve(self.axes, both).T, np.float64)
        here, there = common_score(qs, list(self.scales))
        return bool(there <= KEPT * here)


def blind_start(
    edges: Edges,
    depth: FloatImage,
    camera: CameraIntrinsics,
    guess: Motion | None = None,
) -> Start:
    """
    Find the motion from the edges of one grey image (H, W) and its filled depth (H, W) [m].

    guess: a further motion to start from. The sign of the answer is arbitrary: p and -p blur
    alike.
    """
    axes, first = motion_axes(depth, camera), None
    if edges.along > CLEARLY_SHARP and edges.evenly > EVENLY_SHARP:
        return _nothing(Outcome.SHARP, axes)
    picture = edges.grey, depth, camera, axes
    in_focus = edges.across > OUT_OF_FOCUS
    spectra = look(*picture, FEWER if guess else MAX_PATCHES) if in_focus else {}
    if not spectra:
        return _nothing(Outcome.FAILED, axes)

    def length(q: Vector) -> float:
        return blur_length(axes @ q, depth, camera)

    found = None
    if guess:
        first = np.asarray(np.linalg.solve(axes, guess.by_rows), np.float64)
        found = _near(spectra, first, length, edges)
        spectra = spectra if found else look(*picture)
    q, scales = found or _anywhere(spectra, first, length)
    seen, trusted = 0.0, _trusted(q, length(q), scales, edges)
    alone = trusted and len(spectra) == 1 and guess is None and length(q) > WITNESSED
    if alone and _refuted(q, spectra | look_again(*picture), length):
        return _nothing(Outcome.FAILED, axes)
    look_closer = length(q) < CLOSE_BELOW if trusted else edges.along > EDGED
    if look_closer and scales[0].factor == 1:
        close = close_up(*picture, FEWER if found else MAX_PATCHES)
        if not trusted or len(scales) == 1 or seen_at(close, q) > CLOSE_HINT:
            short, seen = _closer(q if trusted else None, scales[0], close, length)
            trusted = bool(short) or (trusted and len(scales) > 1)  # else nobody has confirmed it
            q, scales = short or (q, scales)
    if not trusted:
        return _nothing(_without_motion(edges, seen, alone=len(spectra) == 1), axes)
    return _solved(q, scales, length, axes)


def _solved(
    q: Vector, scales: list[Scale], length: Callable[[Vector], float], axes: Vector
) -> Start:
    """Say what a motion that is trusted is worth."""
    quality = min(1.0, float(-common_score(q[None], scales)[0]) / BELIEF)
    covariance = _covariance(q, scales, axes)
    doubt = LONELY_DOUBT if len(scales) == 1 and quality < LONELY else 1 / quality
    if scales[-1].factor == CLOSE:
        q = q * math.sqrt(1 - (CLOSE_BIAS / length(q)) ** 2)
    motion = Motion.from_vector(axes @ q, covariance[:6, :6])
    return Start(motion, Outcome.SOLVED, quality, axes, covariance, doubt, scales)


def _without_motion(edges: Edges, seen: float, *, alone: bool) -> Outcome:
    """
    Say that a picture is sharp if its edges are, and not only somewhere; else nothing.

    seen: -S of what is likeliest close up; alone: whether one scale has searched, which misses
    what two would see.
    """
    edged = edges.along > RATHER_SHARP and seen < DEEP
    unseen = seen < BANDED and (edges.along > CLEARLY_SHARP or not alone)
    sharp = edged and (edges.evenly > EVENLY_SHARP or unseen)
    return Outcome.SHARP if sharp else Outcome.FAILED


def _near(
    spectra: Mapping[float, Spectra],
    first: Vector,
    length: Callable[[Vector], float],
    edges: Edges,
) -> tuple[Vector, list[Scale]] | None:
    """Search around the guess; None where that gives nothing to believe."""
    q, scales = find_near(spectra, first)
    holds = length(q - first) <= ASTRAY and _trusted(q, length(q), scales, edges)
    return (q, scales) if holds else None


def _anywhere(
    spectra: Mapping[float, Spectra],
    first: Vector | None,
    length: Callable[[Vector], float],
) -> tuple[Vector, list[Scale]]:
    """Search everywhere, around a guess too if there is one."""
    q, scales = find(spectra, first)
    return ask_twice(q, scales) if length(q) > HALVED else (q, scales)


def _closer(
    near: Vector | None, scale: Scale, close: Spectra, length: Callable[[Vector], float]
) -> tuple[tuple[Vector, list[Scale]] | None, float]:
    """Search close up; None where that gives nothing to believe, and -S of what is likeliest."""
    q, both = find_short(scale, close, near)
    seen = float(-common_score(q[None], both)[0])
    return ((q, both) if _short_trusted(q, length(q), both) else None), seen


def _refuted(
    q: Vector, spectra: Mapping[float, Spectra], length: Callable[[Vector], float]
) -> bool:
    """Tell whether one more scale, searched together with the others, finds another motion."""
    other, _ = _anywhere(spectra, None, length)
    return min(length(q - other), length(q + other)) > APART * length(q)


def _trusted(q: Vector, length: float, scales: list[Scale], edges: Edges) -> bool:
    """Tell whether the bands are deep enough for a blur of this length [px]."""
    if length < SHORTEST or (length < SMEAR and edges.along < SMEARED):
        return False
    if length < SHORT:
        return bool(scores(q[None], scales[0].evidence)[0] < -SHORT_TRUST)
    sharp = edges.coarse > EDGED_COARSE if length > LONG else edges.along > RATHER_SHARP
    doubt = DOUBT ** (sharp + (sharp and length > LONGEST))
    alone = ALONE_TRUST if length > ALONE_SHORT else ALONE_SHORT_TRUST
    needed = doubt * (LONG_TRUST if len(scales) > 1 else alone)
    said = common_score(q[None], scales)[0] / SHARE[scales[0].factor]
    return bool(said < -needed)


def _short_trusted(q: Vector, length: float, both: list[Scale]) -> bool:
    """Tell whether a blur of this length [px] is seen at full scale and close up together."""
    whole, close = (float(scores(q[None], scale.evidence)[0]) for scale in both)
    seen = close < -CLOSE_SHARE and (length < PLAIN or whole < -PLAIN_TRUST)
    enough = bool(common_score(q[None], both)[0] < -CLOSE_TRUST)
    return SHORTEST <= length < CLOSE_BELOW and seen and enough


def _nothing(outcome: Outcome, axes: Vector) -> Start:
    """Give no motion: still to within SHORTEST when sharp, anything when failed."""
    spread = SHORTEST / 2 if outcome is Outcome.SHARP else PRIOR_PX
    covariance = spread**2 * axes[:6, :6] @ axes[:6, :6].T
    quality = 1.0 if outcome is Outcome.SHARP else 0.0
    return Start(Motion.from_vector(np.zeros(6), covariance), outcome, quality)


def _covariance(q: Vector, scales: list[Scale], axes: Vector) -> Vector:
    """Give the covariance (9, 9) of p by rows from how S^2 / 2 bends around q."""
    score, (_, bend) = float(common_score(q[None], scales)[0]), slope_and_bend(q, scales)
    bend = max(-score, 0.0) * bend
    return np.asarray(axes @ covariance_from_curvature(bend, OBSERVATIONS, PRIOR_PX) @ axes.T)
