"""
The sharp frames hidden in one exposure.

The restored image stands at mid-exposure; each instant t is rendered from it through the depth,
as the blur operator sees it: the nearest surface wins, what it uncovers is far. docs/method.md (4)
and (5).
"""

from __future__ import annotations

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, InputError, Motion
from depth_deblur_ros.core.geometry import flow
from depth_deblur_ros.core.seen import seen_inverse_depth
import numpy as np

MAX_FRAMES = 1000


def sharp_sequence(
    image: FloatImage, depth: FloatImage, motion: Motion, camera: CameraIntrinsics, frames: int
) -> list[FloatImage]:
    """
    Render `frames` views (H, W[, 3]) at the middles of equal shares of the exposure.

    image (H, W[, 3]) sharp, at mid-exposure; depth (H, W) filled [m]. Borders that come into view
    repeat the image's edge. Raises InputError when frames is out of bounds.
    """
    if not 1 <= frames <= MAX_FRAMES:
        raise InputError(f'frames must lie in [1, {MAX_FRAMES}], got {frames}')
    seen = seen_inverse_depth(motion, depth, camera, frames)
    y, x = np.mgrid[: camera.height, : camera.width].astype(np.float32)
    views = []
    for i in range(frames):
        t = np.float32((i + 0.5) / frames - 0.5)
        f = flow(motion.by_rows, 1 / seen[..., i], camera)
        from_x, from_y = x - t * f[..., 0], y - t * f[..., 1]
        view = cv2.remap(image, from_x, from_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
        views.append(np.clip(np.asarray(view, np.float32), 0, 1))
    return views
