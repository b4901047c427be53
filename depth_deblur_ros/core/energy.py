"""
The paper's energy, term by term, each with its gradient.

Notation: L (h, w, 3) latent light 0..1 on the widened grid, B (H, W, 3) blurred light 0..1, A_p
the blur of motion p (blur.py), r = A_p L - B; d = forward differences, per pixel of the level at
hand; D depth [m]; F flow over the exposure [px], linear in p. Sums run over pixels and channels;
with all weights in these units (alternation.py converts them),

    E = |r|^2 + |d r|^2 + mu1 |p|^2 + S(p) + mu4 |d L|_1,  (23) of docs/method.md,

where |p|^2 = p' N p is the mean square of the flow, since rad and metres do not add up.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, Vector
from depth_deblur_ros.core.geometry import interaction_matrix
import numpy as np
import numpy.typing as npt

F = TypeVar('F', bound=np.floating)

TERMS = ('intensities', 'differences', 'motion', 'smoothness', 'variation')


@dataclass(frozen=True)
class EdgeWeights:
    """mu2, mu3, and differences that count as edges: sigma_B [light], sigma_D [m], per pixel."""

    mu2: float
    mu3: float
    sigma_b: float
    sigma_d: float


def differences(u: npt.NDArray[F]) -> npt.NDArray[F]:
    """Give d u (2, ...): forward differences down and right, zero at the far border."""
    d = np.zeros((2, *u.shape), u.dtype)
    d[0, :-1] = u[1:] - u[:-1]
    d[1, :, :-1] = u[:, 1:] - u[:, :-1]
    return d


def differences_adjoint(d: npt.NDArray[F]) -> npt.NDArray[F]:
    """Give d' of a field (2, ...), so that <d u, q> = <u, d' q> to rounding."""
    u = np.zeros(d.shape[1:], d.dtype)
    u[:-1] -= d[0, :-1]
    u[1:] += d[0, :-1]
    u[:, :-1] -= d[1, :, :-1]
    u[:, 1:] += d[1, :, :-1]
    return u


def intensity_term(residual: npt.NDArray[F]) -> float:
    """Give |r|^2, the first part of (24)."""
    return _power(residual)


def intensity_gradient(residual: npt.NDArray[F]) -> npt.NDArray[F]:
    """Give the gradient of |r|^2 with respect to A L."""
    return 2 * residual


def difference_term(residual: npt.NDArray[F]) -> float:
    """Give |d r|^2, the second part of (24)."""
    return _power(differences(residual))


def difference_gradient(residual: npt.NDArray[F]) -> npt.NDArray[F]:
    """Give the gradient of |d r|^2 with respect to A L."""
    return 2 * differences_adjoint(differences(residual))


def data_weight(residual: npt.NDArray[F]) -> npt.NDArray[F]:
    """Apply M = 1 + d' d: both parts of the data term are <r, M r>."""
    return residual + differences_adjoint(differences(residual))


def motion_norm(depth: FloatImage, camera: CameraIntrinsics) -> Vector:
    """Give N (6, 6): p' N p is the mean squared length of the flow [px^2], (25)."""
    j = _flow_of_motion(depth, camera)
    return np.asarray(np.einsum('yxai,yxaj->ij', j, j, optimize=True) / depth.size)


def motion_term(p: Vector, norm: Vector, mu1: float) -> float:
    """Give mu1 |p|^2: with mu1 < 0 it rewards motion, (25)."""
    return mu1 * float(p @ norm @ p)


def motion_gradient(p: Vector, norm: Vector, mu1: float) -> Vector:
    """Give the gradient of mu1 |p|^2."""
    return 2 * mu1 * norm @ p


def edge_weights(blurred: FloatImage, depth: FloatImage, weights: EdgeWeights) -> Vector:
    """Give (H, W): how much a flow difference costs, little at edges of image or depth, (27)."""
    channels = blurred.astype(np.float64).reshape(*depth.shape, -1)
    image = np.square(differences(channels)).sum(0).mean(-1)
    relief = np.square(differences(depth.astype(np.float64))).sum(0)
    return np.asarray(
        weights.mu2 * np.exp(-image / weights.sigma_b**2)
        + weights.mu3 * np.exp(-relief / weights.sigma_d**2)
    )


def smoothness_form(cost: Vector, depth: FloatImage, camera: CameraIntrinsics) -> Vector:
    """Give Q (6, 6): the flow is linear in p, so that its smoothness is S(p) = p' Q p, (26)."""
    d = differences(_flow_of_motion(depth, camera))
    return np.asarray(np.einsum('yx,kyxai,kyxaj->ij', cost, d, d, optimize=True))


def smoothness_term(p: Vector, form: Vector) -> float:
    """Give S(p), (26)."""
    return float(p @ form @ p)


def smoothness_gradient(p: Vector, form: Vector) -> Vector:
    """Give the gradient of S."""
    return 2 * form @ p


def variation_term(latent: npt.NDArray[F], mu4: float) -> float:
    """Give mu4 |d L|_1: the sum of the lengths of d L at each pixel of each channel."""
    return mu4 * float(np.sqrt(np.square(differences(latent)).sum(0)).sum(dtype=np.float64))


def variation_gradient(latent: npt.NDArray[F], mu4: float) -> npt.NDArray[F]:
    """Give a subgradient of mu4 |d L|_1: its gradient wherever no difference is zero."""
    d = differences(latent)
    length = np.sqrt(np.square(d).sum(0))
    unit = d / np.where(length > 0, length, 1)
    return (mu4 * differences_adjoint(unit)).astype(latent.dtype)


def _flow_of_motion(depth: FloatImage, camera: CameraIntrinsics) -> Vector:
    """Give J (H, W, 2, 6) of every pixel, (3)."""
    y, x = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    return interaction_matrix(x, y, depth.astype(np.float64), camera)


def _power(u: npt.NDArray[F]) -> float:
    return float(np.square(u).sum(dtype=np.float64))
