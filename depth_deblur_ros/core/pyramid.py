"""
Image, depth and camera scaled together, coarse to fine.

Each level has the camera of its own rounded size (CameraIntrinsics.scaled), so that a motion p,
which is in rad and m, means the same at every level.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage
import numpy as np

SHORTEST_SIDE = 48  # px; a coarser level shows no blur


@dataclass(frozen=True, eq=False)
class Level:
    """One size of the frame: image (H, W, C) or (H, W), depth (H, W) [m], and their camera."""

    image: FloatImage
    depth: FloatImage
    camera: CameraIntrinsics


def build_pyramid(finest: Level, levels: int, factor: float) -> tuple[Level, ...]:
    """
    Give up to `levels` sizes of a frame, the coarsest first, each `factor` of the next.

    A level whose shorter side would fall below SHORTEST_SIDE is left out.
    """
    found = [finest]
    for k in range(1, levels):
        width, height = (round(n * factor**k) for n in (finest.camera.width, finest.camera.height))
        if min(width, height) < SHORTEST_SIDE:
            break
        found.append(scaled_level(finest, width, height))
    return tuple(found[::-1])


def scaled_level(level: Level, width: int, height: int) -> Level:
    """Resize a level; light is averaged, depth is not, lest surfaces appear between surfaces."""
    size = (width, height)
    image = cv2.resize(level.image, size, interpolation=cv2.INTER_AREA)
    depth = cv2.resize(level.depth, size, interpolation=cv2.INTER_NEAREST_EXACT)
    return Level(
        np.asarray(image, np.float32),
        np.asarray(depth, np.float32),
        level.camera.scaled(width, height),
    )
