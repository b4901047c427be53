"""
What goes in and out of the solver: frozen records, checked when made, then trusted.

Frames and units: the camera's optical frame (REP 103: x right, y down, z forward), metres,
radians, seconds. Pixel centres lie at integers.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
import math
from typing import Any

import numpy as np
import numpy.typing as npt

FloatImage = npt.NDArray[np.float32]
Vector = npt.NDArray[np.float64]

TRANSFERS = ('srgb', 'linear')
MAX_PIXELS = 64_000_000  # more than any camera on a robot; refuses a lying header early
MIN_SIDE = 32  # px; below this no patch of the blind start fits
FAR = 20  # widths or heights that the principal point of a cut-out may lie off
FOCAL_RATIO = (0.1, 20.0)  # focal length over image width: a 157 degree and a 3 degree lens


class InputError(ValueError):
    """Something given from outside cannot work; the text names the value and the limit."""


class Outcome(StrEnum):
    """What became of a frame."""

    SHARP = 'sharp'  # no blur found: image unchanged, motion zero
    SOLVED = 'solved'  # motion found, image restored
    FAILED = 'failed'  # no motion to trust: image unchanged, motion zero


@dataclass(frozen=True)
class CameraIntrinsics:
    """
    A pinhole camera of a rectified image.

    fx, fy, cx, cy in pixels; width, height in pixels; distortion plumb_bob [k1 k2 p1 p2 k3],
    rational_polynomial (k4 k5 k6 too) or None (rectified); transfer names the space in which the
    stored values add up light: 'srgb' (undo the sRGB curve first) or 'linear' (as they are).
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] | None = None
    transfer: str = 'srgb'

    def __post_init__(self) -> None:
        for name in ('width', 'height'):
            _check_side(name, getattr(self, name))
        if self.width * self.height > MAX_PIXELS:
            raise InputError(
                f'{self.width}x{self.height} is more than the limit of {MAX_PIXELS} pixels'
            )
        for name in ('fx', 'fy'):
            _check_focal(name, getattr(self, name), self.width)
        for name, side in (('cx', self.width), ('cy', self.height)):
            value = getattr(self, name)
            if not _is_number(value) or not -FAR * side <= value <= FAR * side:
                raise InputError(
                    f'{name} must lie in [{-FAR * side}, {FAR * side}] px, got {value}'
                )
        if self.distortion is not None:
            _check_distortion(self.distortion)
        if self.transfer not in TRANSFERS:
            raise InputError(f'transfer must be one of {TRANSFERS}, got {self.transfer!r}')

    def scaled(self, width: int, height: int) -> CameraIntrinsics:
        """Give the same camera for the image resized to width x height."""
        sx, sy = width / self.width, height / self.height
        return replace(
            self,
            fx=sx * self.fx,
            fy=sy * self.fy,
            cx=sx * (self.cx + 0.5) - 0.5,
            cy=sy * (self.cy + 0.5) - 0.5,
            width=width,
            height=height,
        )

    def cropped(self, left: int, top: int, width: int, height: int) -> CameraIntrinsics:
        """Give the same camera for a part of the image, width x height from its corner."""
        cx, cy = self.cx - left, self.cy - top
        return replace(self, cx=cx, cy=cy, width=width, height=height)


@dataclass(frozen=True, eq=False)
class RgbdFrame:
    """
    One blurred image with its depth.

    image (H, W, 3) RGB or (H, W), float32, 0..1; depth (H, W) float32, metres along z, NaN = hole;
    exposure in seconds or None when unknown; stamp_ns passes through.
    """

    image: FloatImage
    depth: FloatImage
    camera: CameraIntrinsics
    exposure: float | None = None
    stamp_ns: int = 0

    def __post_init__(self) -> None:
        _check_image(self.image)
        _check_depth(self.depth)
        shape = (self.camera.height, self.camera.width)
        if self.image.shape[:2] != shape:
            raise InputError(f'image is {_size(self.image)} but its camera is {_size_of(shape)}')
        if self.depth.shape != shape:
            raise InputError(
                f'depth is {_size(self.depth)} but the image is {_size_of(shape)}: '
                'register the depth to the colour camera first'
            )
        check_exposure(self.exposure)


@dataclass(frozen=True, eq=False)
class Motion:
    """
    The camera's motion over the whole exposure, as it moves the scene.

    A scene point X given in the camera frame at mid-exposure is at R(t theta) X + t v at time t in
    [-1/2, 1/2] (the paper's p_t = (t / 2T) p). theta (3,) rad, v (3,) m, covariance (6, 6) in the
    order theta, v. The camera's own velocity is -theta / exposure, -v / exposure.

    rolling (3,) rad: rows that are read one after the other see different turns; row y sees
    theta + yn rolling, yn = (y - cy) / fy.
    """

    theta: Vector
    v: Vector
    covariance: npt.NDArray[np.float64] = field(default_factory=lambda: np.zeros((6, 6)))
    rolling: Vector = field(default_factory=lambda: np.zeros(3))

    def __post_init__(self) -> None:
        shapes = {'theta': (3,), 'v': (3,), 'covariance': (6, 6), 'rolling': (3,)}
        for name, shape in shapes.items():
            try:
                value = np.array(getattr(self, name), np.float64)
            except (TypeError, ValueError):
                raise InputError(f'{name} must be numbers of shape {shape}') from None
            if value.shape != shape:
                raise InputError(f'{name} must have shape {shape}, got {value.shape}')
            if not np.isfinite(value).all():
                raise InputError(f'{name} must be finite, got {value.tolist()}')
            value.flags.writeable = False
            object.__setattr__(self, name, value)

    @classmethod
    def from_vector(
        cls, p: npt.ArrayLike, covariance: npt.NDArray[np.float64] | None = None
    ) -> Motion:
        """Make a motion from p (6,) = (theta, v), or (9,) = (theta, v, rolling)."""
        vector = np.asarray(p, np.float64)
        if vector.shape not in ((6,), (9,)):
            raise InputError(f'p must have shape (6,) or (9,), got {vector.shape}')
        spread = np.zeros((6, 6)) if covariance is None else covariance
        rolling = vector[6:] if len(vector) > 6 else np.zeros(3)
        return cls(vector[:3], vector[3:6], spread, rolling)

    @property
    def vector(self) -> Vector:
        """The motion as p (6,) = (theta, v)."""
        return np.concatenate([self.theta, self.v])

    @property
    def by_rows(self) -> Vector:
        """The motion as p (9,) = (theta, v, rolling)."""
        return np.concatenate([self.theta, self.v, self.rolling])


@dataclass(frozen=True)
class EnergyStep:
    """
    The energy before or after one step at a pyramid level, term by term.

    level 0 is the coarsest; step is 'before turn 1', 'after turn 1', ...; both ends of a turn are
    told at one weight mu1. Terms in grey levels^2, mean over the samples: (23) of docs/method.md.
    """

    level: int
    step: str
    terms: Mapping[str, float]


@dataclass(frozen=True, eq=False)
class DeblurResult:
    """
    What the solver says about one frame.

    image as in RgbdFrame (unchanged unless solved); depth (H, W) float32, filled, no NaN; quality
    0..1, the trust in the motion; blur_px the mean length of the blur [px]; seconds spent;
    energies on the way, of the method that has them.
    """

    image: FloatImage
    depth: FloatImage
    motion: Motion
    outcome: Outcome
    sign_resolved: bool
    quality: float
    blur_px: float
    seconds: float
    energies: tuple[EnergyStep, ...] = ()


def check_exposure(exposure: float | None) -> None:
    """Refuse an exposure that is not a time; None means unknown."""
    if exposure is not None and (not _is_number(exposure) or not 0 < exposure <= 60):
        raise InputError(f'exposure must lie in (0, 60] s, got {exposure}')


def _is_number(value: Any) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | float | np.number):
        return False
    return math.isfinite(value)


def _check_side(name: str, value: Any) -> None:
    if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < MIN_SIDE:
        raise InputError(f'{name} must be a whole number >= {MIN_SIDE} px, got {value}')


def _check_focal(name: str, value: Any, width: int) -> None:
    low, high = FOCAL_RATIO[0] * width, FOCAL_RATIO[1] * width
    if not _is_number(value) or not low <= value <= high:
        raise InputError(
            f'{name} must lie in [{low:g}, {high:g}] px for a {width} px wide image, got {value}'
        )


def _check_distortion(values: Any) -> None:
    if len(values) not in (4, 5, 8) or not all(_is_number(k) for k in values):
        raise InputError(
            'distortion must be 4, 5 or 8 finite numbers k1 k2 p1 p2 [k3 [k4 k5 k6]], '
            f'got {values}'
        )


def _check_image(image: Any) -> None:
    if not isinstance(image, np.ndarray) or image.dtype != np.float32:
        raise InputError(f'image must be a float32 array, got {_kind(image)}')
    if image.ndim != 2 and (image.ndim != 3 or image.shape[2] != 3):
        raise InputError(f'image must have shape (H, W, 3) or (H, W), got {image.shape}')
    low, high = (float(image.min()), float(image.max())) if image.size else (0.0, 0.0)
    if not (math.isfinite(low) and math.isfinite(high)):
        raise InputError('image must be finite, it holds NaN or infinity')
    if low < 0 or high > 1:
        raise InputError(f'image must lie in [0, 1], it spans [{low:g}, {high:g}]')


def _check_depth(depth: Any) -> None:
    if not isinstance(depth, np.ndarray) or depth.dtype != np.float32:
        raise InputError(f'depth must be a float32 array in metres, got {_kind(depth)}')
    if depth.ndim != 2:
        raise InputError(f'depth must have shape (H, W), got {depth.shape}')


def _kind(value: Any) -> str:
    return str(value.dtype) if isinstance(value, np.ndarray) else type(value).__name__


def _size(array: npt.NDArray[Any]) -> str:
    return _size_of(array.shape[:2])


def _size_of(shape: tuple[int, ...]) -> str:
    return f'{shape[1]}x{shape[0]}'
