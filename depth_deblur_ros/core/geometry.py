"""
How a motion of the camera moves the pixels.

Notation: x, y pixel; (X, Y, Z) the point it sees; xn = (x - cx) / fx, yn = (y - cy) / fy; p (6,) =
(theta, v) the motion over the exposure (docs/architecture.md); w = 1 / Z inverse depth [1/m]. The
flow is affine in w: F(x, y) = a(x, y) + w(x, y) b(x, y). [LHP80] Longuet-Higgins & Prazdny, Proc.
R. Soc. B 208, 1980: the first-order flow, (3) of docs/method.md.
"""

from __future__ import annotations

from dataclasses import replace
import math

from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, Vector
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

ENOUGH = 6_000  # pixels that tell the mean length of a blur


def normalised_grid(camera: CameraIntrinsics) -> tuple[Array, Array]:
    """Give xn (1, W) and yn (H, 1), the rays (xn, yn, 1) of the pixel centres."""
    xn = (np.arange(camera.width, dtype=np.float64)[None, :] - camera.cx) / camera.fx
    yn = (np.arange(camera.height, dtype=np.float64)[:, None] - camera.cy) / camera.fy
    return xn, yn


def interaction_matrix(x: Array, y: Array, depth: Array, camera: CameraIntrinsics) -> Array:
    """
    Give J (..., 2, 6) of pixels x, y at depth [m], so that the flow over the exposure is J p [px].

    [LHP80]; docs/method.md (3). x, y, depth of one shape.
    """
    xn, yn = (x - camera.cx) / camera.fx, (y - camera.cy) / camera.fy
    w, zero = 1 / depth, np.zeros_like(xn)
    rows = [
        [-xn * yn, 1 + xn * xn, -yn, w, zero, -xn * w],
        [-(1 + yn * yn), xn * yn, xn, zero, w, -yn * w],
    ]
    focal = (camera.fx, camera.fy)
    return np.stack(
        [np.stack([f * c for c in row], -1) for f, row in zip(focal, rows, strict=True)], -2
    )


def rows_matrix(j: Array, y: Array, camera: CameraIntrinsics) -> Array:
    """Continue J (..., 2, 6) of pixels in rows y to (..., 2, 9), for p by rows."""
    yn = (y - camera.cy) / camera.fy
    return np.concatenate([j, yn[..., None, None] * j[..., :3]], -1)


def flow(
    p: npt.ArrayLike, depth: npt.NDArray[np.floating], camera: CameraIntrinsics
) -> FloatImage:
    """Give the first-order flow (H, W, 2) [px] of p (6,) or (9,), by rows; depth (H, W) [m]."""
    vector, xn, yn = np.zeros(9), *normalised_grid(camera)
    vector[: len(np.asarray(p))] = p
    tx, ty, tz = vector[:3, None, None] + vector[6:, None, None] * yn
    vx, vy, vz = vector[3:6].tolist()
    w = 1 / depth
    fx = camera.fx * (-xn * yn * tx + (1 + xn * xn) * ty - yn * tz + w * (vx - xn * vz))
    fy = camera.fy * (-(1 + yn * yn) * tx + xn * yn * ty + xn * tz + w * (vy - yn * vz))
    return np.stack([fx, fy], -1).astype(np.float32)


def rotation_matrix(theta: npt.ArrayLike) -> Array:
    """Give the rotation (3, 3) by the rotation vector theta [rad] (Rodrigues)."""
    vector: Vector = np.asarray(theta, np.float64)
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    if angle < 1e-8:
        return np.asarray(np.eye(3) + k)
    return np.asarray(
        np.eye(3) + math.sin(angle) / angle * k + (1 - math.cos(angle)) / angle**2 * k @ k
    )


def warp(
    p: npt.ArrayLike, t: float, depth: npt.NDArray[np.floating], camera: CameraIntrinsics
) -> Array:
    """Give where (H, W, 2) [px] each pixel stands at time t in [-1/2, 1/2], exactly."""
    vector = np.asarray(p, np.float64)
    xn, yn = normalised_grid(camera)
    z = np.asarray(depth, np.float64)
    points = np.stack([xn * z, yn * z, z], -1)
    moved = points @ rotation_matrix(t * vector[:3]).T + t * vector[3:]
    return np.stack(
        [
            camera.fx * moved[..., 0] / moved[..., 2] + camera.cx,
            camera.fy * moved[..., 1] / moved[..., 2] + camera.cy,
        ],
        -1,
    )


def blur_length(
    p: npt.ArrayLike, depth: npt.NDArray[np.floating], camera: CameraIntrinsics
) -> float:
    """Give the mean length [px] of the flow over the exposure, of ENOUGH pixels or more."""
    step = max(1, math.isqrt(depth.size // ENOUGH))
    some = depth[::step, ::step]
    height, width = some.shape
    fx, fy, cx, cy = (value / step for value in (camera.fx, camera.fy, camera.cx, camera.cy))
    sparse = replace(camera, fx=fx, fy=fy, cx=cx, cy=cy, width=width, height=height)
    f = flow(p, some, sparse)
    return step * float(np.hypot(f[..., 0], f[..., 1]).mean())
