"""
Where the paper's method starts: one blur kernel for the whole image, by normalised sparsity.

Notation: y = d B differences of the blurred grey light, x those of the sharp one, both (2, H, W);
k kernel (n, n), k >= 0, sum k = 1. Minimises, (21) of docs/method.md,

    lambda |k * x - y|^2 + |x|_1 / |x|_2 + psi |k|_1

by turns in x (shrinkage steps at a fixed |x|_2) and in k (reweighted least squares), from a small
kernel on a small image to a large one. [KTF11] Krishnan, Tay & Fergus, CVPR 2011.
"""

from __future__ import annotations

from collections.abc import Callable
import math

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, Vector
from depth_deblur_ros.core.energy import differences
from depth_deblur_ros.core.geometry import interaction_matrix
import numpy as np
import numpy.typing as npt
from scipy import fft

Array = npt.NDArray[np.float64]

TURNS = 20  # of x and k at each kernel size
RENEWALS, SHRINKS = 2, 2  # of |x|_2 in each turn; steps at a fixed |x|_2
THRESHOLD = 0.4  # of rms(y) while |x|_2 = |y|_2: what 1 / (2 lambda |x|_2) comes to
MOST_THRESHOLD = 2.0  # times THRESHOLD: a fading x must not fade all the more
PSI = 1e-4  # of |x|^2, per weight of k
REWEIGHTINGS = 2
LEAST = 1e-4  # k; smaller weights count as this in the reweighting
DUST = 0.05  # of the largest k: less is noise
EXACT, SOLVING = 1e-5, 200  # of the least squares: relative, and conjugate gradient steps
GROWTH = math.sqrt(2)  # from one kernel size to the next


def motions_of_flow(u: Vector, depth: FloatImage, camera: CameraIntrinsics) -> tuple[Vector, ...]:
    """
    Give the rotation and the translation, p (6,) each, that come nearest to a flow u (2,) [px].

    In least squares over all pixels, (22): one kernel does not tell the two apart.
    """
    y, x = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    j = interaction_matrix(x, y, depth.astype(np.float64), camera)
    normal = np.einsum('yxai,yxaj->ij', j, j, optimize=True)
    right = np.einsum('yxai,a->i', j, u)
    turn, shift = np.zeros(6), np.zeros(6)
    turn[:3] = np.linalg.solve(normal[:3, :3], right[:3])
    shift[3:] = np.linalg.solve(normal[3:, 3:], right[3:])
    return turn, shift


def uniform_kernel(grey: FloatImage, size: int) -> Array:
    """Give the kernel (size, size) that blurs the grey light (H, W) if all of it blurs alike."""
    kernel, x = _point(3), None
    for n in _sizes(size):
        y = differences(_resized(grey, n / size).astype(np.float64))
        y = y / max(float(np.sqrt(np.square(y).mean())), 1e-12)
        kernel = _enlarged(kernel, n)
        x = y if x is None else np.stack([cv2.resize(c, y.shape[:0:-1]) for c in x])
        for _ in range(TURNS):
            x = _sharper(x, kernel, y)
            kernel = _refitted(kernel, x, y)
    return kernel


def streak(kernel: Array) -> Vector:
    """Give the straight flow (2,) [px] that spreads along its line as the kernel does, (22)."""
    i = np.arange(kernel.shape[0], dtype=np.float64)
    dx, dy = i - kernel.sum(0) @ i, i - kernel.sum(1) @ i
    cross = float(dy @ kernel @ dx)
    moments = np.array([[kernel.sum(0) @ dx**2, cross], [cross, kernel.sum(1) @ dy**2]])
    values, vectors = np.linalg.eigh(moments)
    # A box of length u has the variance u^2 / 12.
    return np.asarray(math.sqrt(12 * max(values[1], 0)) * vectors[:, 1])


def _sizes(size: int) -> list[int]:
    """List odd kernel sizes from 3 to size, each about GROWTH of the one before."""
    found = [size]
    while found[0] > 3:
        found.insert(0, max(3, min(found[0] - 2, int(found[0] / GROWTH) // 2 * 2 + 1)))
    return found


def _resized(image: FloatImage, scale: float) -> FloatImage:
    """Shrink an image, a little cropped so that its sides suit the Fourier transform."""
    height, width = image.shape
    high, wide = (_fast_side(max(8, round(n * scale))) for n in (height, width))
    crop = image[: min(height, round(high / scale)), : min(width, round(wide / scale))]
    return np.asarray(cv2.resize(crop, (wide, high), interpolation=cv2.INTER_AREA), np.float32)


def _fast_side(n: int) -> int:
    while fft.next_fast_len(n, real=True) != n:
        n -= 1
    return n


def _point(n: int) -> Array:
    """Give a kernel that blurs by about a pixel in all directions."""
    k = np.zeros((n, n))
    k[n // 2, n // 2 - 1 : n // 2 + 2] = k[n // 2 - 1 : n // 2 + 2, n // 2] = 1
    return np.asarray(k / k.sum())


def _enlarged(kernel: Array, n: int) -> Array:
    if kernel.shape[0] == n:
        return kernel
    k = np.maximum(cv2.resize(kernel, (n, n), interpolation=cv2.INTER_CUBIC), 0)
    return np.asarray(k / k.sum())


def _sharper(x: Array, kernel: Array, y: Array) -> Array:
    """Take shrinkage steps in x: |k * x - y|^2 falls, and what is small becomes zero."""
    n, shape = kernel.shape[0] // 2, y.shape[1:]
    wide = np.zeros(shape)
    wide[: kernel.shape[0], : kernel.shape[1]] = kernel
    k, target = fft.rfft2(np.roll(wide, (-n, -n), (0, 1))), fft.rfft2(y)
    full = float(np.linalg.norm(y))
    for _ in range(RENEWALS):
        least = THRESHOLD * min(full / max(float(np.linalg.norm(x)), 1e-12), MOST_THRESHOLD)
        for _ in range(SHRINKS):
            x = x - fft.irfft2(np.conj(k) * (k * fft.rfft2(x) - target), shape)
            x = np.sign(x) * np.maximum(np.abs(x) - least, 0)
    return x


def _refitted(kernel: Array, x: Array, y: Array) -> Array:
    """Solve for k by least squares with weights psi / k_old, then clip, dust and normalise it."""
    n, shape = kernel.shape[0], y.shape[1:]
    xf, yf = fft.rfft2(x), fft.rfft2(y)
    auto = fft.irfft2(np.square(np.abs(xf)).sum(0), shape)
    cross = fft.irfft2((np.conj(xf) * yf).sum(0), shape)
    here = np.arange(n) - n // 2
    lags = np.arange(1 - n, n)
    product = _correlation(auto[np.ix_(lags, lags)])
    power = auto[0, 0]
    if power <= 0:
        return kernel
    k = kernel
    for _ in range(REWEIGHTINGS):
        weight = PSI * power / np.maximum(k, LEAST)
        k = np.maximum(_solved(product, weight, power, cross[np.ix_(here, here)], k), 0)
        k = k / k.sum() if k.sum() > 0 else kernel
    k = np.where(k < DUST * k.max(), 0, k)
    return np.asarray(k / k.sum())


def _correlation(lags: Array) -> Callable[[Array], Array]:
    """Give the product of kernels (n, n) with the form of correlation at lags (2n - 1, 2n - 1)."""
    n = (lags.shape[0] + 1) // 2
    side = fft.next_fast_len(lags.shape[0], real=True)
    wide = np.zeros((side, side))
    wide[: 2 * n - 1, : 2 * n - 1] = lags
    spectrum = fft.rfft2(np.roll(wide, (1 - n, 1 - n), (0, 1)))

    def product(k: Array) -> Array:
        spread = fft.irfft2(spectrum * fft.rfft2(k, (side, side)), (side, side))
        return np.asarray(spread[:n, :n])

    return product


def _solved(
    product: Callable[[Array], Array], weight: Array, power: float, right: Array, k: Array
) -> Array:
    """Solve (form + weight) k = right from k on, by conjugate gradients scaled by the diagonal."""
    scale = 1 / (power + weight)
    r = right - product(k) - weight * k
    z = scale * r
    d, rz = z, float(np.vdot(r, z))
    least = EXACT**2 * float(np.vdot(right, scale * right))
    for _ in range(SOLVING):
        if rz <= least:
            break
        s = product(d) + weight * d
        a = rz / float(np.vdot(d, s))
        k, r = k + a * d, r - a * s
        z = scale * r
        rz, last = float(np.vdot(r, z)), rz
        d = z + rz / last * d
    return k
