"""
The distortion of a lens undone: from a frame as it was taken to that of a pinhole camera, K kept.

The models are OpenCV's: plumb_bob and rational_polynomial, 4, 5 or 8 coefficients.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, RgbdFrame
import numpy as np


def undistorted(frame: RgbdFrame) -> RgbdFrame:
    """Give the frame as a camera without distortion sees it; depth that is not seen is a hole."""
    if not frame.camera.distortion:
        return frame
    map_x, map_y = _undistortion(frame.camera)
    border = cv2.BORDER_REPLICATE
    image = cv2.remap(frame.image, map_x, map_y, cv2.INTER_LINEAR, borderMode=border)
    # Depths are never mixed: between a near and a far thing there is nothing.
    depth = cv2.remap(frame.depth, map_x, map_y, cv2.INTER_NEAREST, borderValue=np.nan)
    return replace(
        frame,
        image=np.asarray(image, np.float32).clip(0, 1),
        depth=np.asarray(depth, np.float32),
        camera=replace(frame.camera, distortion=None),
    )


@lru_cache(maxsize=2)
def _undistortion(camera: CameraIntrinsics) -> tuple[FloatImage, FloatImage]:
    """Give, for each pixel without distortion, where it is in the image as it was taken."""
    k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    size = (camera.width, camera.height)
    coefficients = np.array(camera.distortion)
    maps = cv2.initUndistortRectifyMap(k, coefficients, None, k, size, cv2.CV_32FC1)
    return np.asarray(maps[0]), np.asarray(maps[1])
