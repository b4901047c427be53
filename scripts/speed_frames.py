"""Frames of any size and blur, and the peers that the solver's speed is measured against."""

from __future__ import annotations

from collections.abc import Callable

import cv2
from depth_deblur_ros.core.blur import blur_operator
from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, Motion, RgbdFrame
from depth_deblur_ros.core.geometry import blur_length
from depth_deblur_ros.core.light import light_from_stored, stored_from_light
from numba import njit, prange, set_num_threads
import numpy as np

KERNEL, STEPS = 25, 30  # side [px] and iterations of Richardson-Lucy
NOISE = 0.005  # stored values
SPINS = 60_000_000


def texture(rng: np.random.Generator, height: int, width: int) -> FloatImage:
    """Give a picture (H, W, 3) with edges at all scales."""
    channels = []
    for _ in range(3):
        mix = np.zeros((height, width), np.float32)
        for size in (0.7, 1.5, 3, 6, 12):
            noise = cv2.GaussianBlur(
                rng.standard_normal((height, width)).astype(np.float32), (0, 0), size
            )
            mix += noise / noise.std() * np.sqrt(size)
        channels.append(0.5 + 0.25 * np.sign(mix) + 0.05 * mix / mix.std())
    grey = channels[0][..., None]
    return np.clip(0.6 * grey + 0.4 * np.stack(channels, -1), 0, 1).astype(np.float32)


def blurred_frame(
    width: int, height: int, blur_px: float, transfer: str = 'srgb', noise: float = NOISE
) -> tuple[RgbdFrame, Motion]:
    """Give a frame of a wall with a box before it, mean blur as asked, and its true motion."""
    rng = np.random.default_rng(0)
    focal = 0.82 * width
    middle = width / 2 - 0.5, height / 2 - 0.5
    camera = CameraIntrinsics(focal, focal, *middle, width, height, transfer=transfer)
    y, x = np.mgrid[:height, :width] / np.float32(width)
    depth = (1.5 + 1.5 * x + 0.5 * y).astype(np.float32)
    depth[height // 3 : 2 * height // 3, width // 4 : width // 2] = 1.2
    p = np.array([0.01, 0.02, 0.004, 0.01, 0.005, 0.005])
    motion = Motion.from_vector(p * blur_px / blur_length(p, depth, camera))
    blur = blur_operator(motion, depth, camera)
    sharp = texture(rng, *blur.latent_shape[:2])
    taken = stored_from_light(blur.apply(light_from_stored(sharp, transfer)), transfer)
    taken = taken + noise * rng.standard_normal(taken.shape, np.float32)
    return RgbdFrame(np.clip(taken, 0, 1), depth, camera), motion


def line_kernel(length: float) -> FloatImage:
    """Give a horizontal line of the length [px] as a point-spread function (25, 25)."""
    psf = np.zeros((KERNEL, KERNEL), np.float32)
    half = round(length / 2)
    psf[KERNEL // 2, KERNEL // 2 - half : KERNEL // 2 + half + 1] = 1 / (2 * half + 1)
    return psf


def peers(image: FloatImage, length: float) -> dict[str, Callable[[], object]]:
    """Give the peers by name; each is told one straight blur for the whole image."""
    from skimage.restoration import richardson_lucy, wiener  # no part of our memory and start

    psf = line_kernel(length)
    channels = [np.ascontiguousarray(image[..., c]) for c in range(3)]
    return {
        'Richardson-Lucy, 30 steps': lambda: [
            richardson_lucy(c, psf, num_iter=STEPS) for c in channels
        ],
        'uniform Wiener': lambda: [wiener(c, psf, 0.01) for c in channels],
    }


@njit(cache=True, nogil=True, parallel=True)
def _spin(out):  # type: ignore[no-untyped-def]
    for k in prange(64):
        x = np.float64(k)
        for _ in range(SPINS // 64):
            x = np.sqrt(x + 1.0)
        out[k] = x


def compute_bound(threads: int) -> Callable[[], object]:
    """Give a kernel that only calculates, on so many threads."""

    def work() -> None:
        set_num_threads(threads)
        _spin(np.zeros(64))

    return work
