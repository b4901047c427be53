"""What a run leaves to tell: a note on every frame, pictures of some, the truth, what was lost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import cv2
from depth_deblur_ros.core.data import DeblurResult, EnergyStep, Outcome, RgbdFrame, Vector
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.misfit import energies_of
from depth_deblur_ros.report import depth_limits, draw_depth, draw_flow, draw_image, Picture
import numpy as np

SHOTS = 8  # frames of which a run keeps pictures
WEBP_QUALITY = 82
PRIOR = SolverParams().prior


@dataclass(frozen=True, eq=False)
class Note:
    """
    What a run says about one frame, but for its pictures.

    p (6,) is the motion over the exposure [rad, m] and deviation (6,) its standard deviation, NaN
    where unknown; exposure in seconds or None; reason says why the solver did not take the frame.
    """

    stamp_ns: int
    outcome: Outcome
    p: Vector
    deviation: Vector
    exposure: float | None
    sign_resolved: bool
    quality: float
    blur_px: float
    seconds: float
    reason: str = ''
    energies: tuple[EnergyStep, ...] = ()

    @property
    def twist(self) -> Vector:
        """The camera's own velocity (6,) [rad/s, m/s], NaN where it cannot be told."""
        if self.exposure is None or self.outcome is Outcome.FAILED:
            return np.full(6, np.nan)
        return -self.p / self.exposure


@dataclass(frozen=True, eq=False)
class Shot:
    """
    The pictures of one frame by name, as WebP, and the depths [m] that its colours span.

    gains are the energies before and after the image step, as energies_of gives them.
    """

    stamp_ns: int
    pictures: Mapping[str, bytes]
    size: tuple[int, int]
    limits: tuple[float, float]
    gains: tuple[EnergyStep, ...] = ()


@dataclass(frozen=True, eq=False)
class Run:
    """
    All that a page tells: the notes in the order of their stamps, pictures of some frames.

    truth gives the true velocity of the camera (6,) [rad/s, m/s] by stamp; lost counts by reason.
    """

    title: str
    notes: Sequence[Note]
    shots: Sequence[Shot]
    truth: Mapping[int, Vector] = field(default_factory=dict)
    lost: Mapping[str, int] = field(default_factory=dict)


def note_of(stamp_ns: int, exposure: float | None, result: DeblurResult) -> Note:
    """Note what the solver says of a frame; a method without covariances leaves zeros."""
    variance = np.diag(result.motion.covariance)
    told = bool(variance.any()) or result.outcome is Outcome.SHARP
    return Note(
        stamp_ns=stamp_ns,
        outcome=result.outcome,
        p=result.motion.vector,
        deviation=np.sqrt(np.where(told, variance, np.nan)),
        exposure=exposure,
        sign_resolved=result.sign_resolved,
        quality=result.quality,
        blur_px=result.blur_px,
        seconds=result.seconds,
        energies=result.energies,
    )


def shot_of(frame: RgbdFrame, result: DeblurResult, prior: float = PRIOR) -> Shot:
    """Draw the pictures of a frame, and weigh it; prior as the solver had it."""
    limits = depth_limits(result)
    pictures = {
        'blurred': draw_image(frame.image),
        'sharp': draw_image(result.image),
        'flow': draw_flow(frame, result),
        'depth': draw_depth(frame, result, limits),
    }
    height, width = pictures['blurred'].shape[:2]
    encoded = {name: _webp(picture) for name, picture in pictures.items()}
    gains = energies_of(frame, result, prior)
    return Shot(frame.stamp_ns, encoded, (width, height), limits, gains)


def spread_evenly(count: int, most: int = SHOTS) -> list[int]:
    """Give which of `count` frames are shown, the first and the last among them."""
    return sorted({round(k) for k in np.linspace(0, count - 1, min(count, most))})


def signed_twists(run: Run) -> Vector:
    """
    Give the velocities (n, 6), those of open sign with the sign that is drawn.

    It is the truth's where that is known, else that of the frame before.
    """
    found = np.array([note.twist for note in run.notes]).reshape(-1, 6)
    last = np.zeros(6)
    for k, note in enumerate(run.notes):
        guide = run.truth.get(note.stamp_ns, last)
        if not note.sign_resolved and found[k] @ guide < 0:
            found[k] = -found[k]
        last = found[k] if np.isfinite(found[k]).all() and found[k].any() else last
    return found


def _webp(picture: Picture) -> bytes:
    options = [cv2.IMWRITE_WEBP_QUALITY, WEBP_QUALITY]
    data = cv2.imencode('.webp', np.ascontiguousarray(picture[..., ::-1]), options)[1]
    return data.tobytes()
