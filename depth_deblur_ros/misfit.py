"""
What the image step has gained: (7) of docs/method.md for the image as taken and for the sharp one.

(7) adds up the misfit, how far the image under its motion is from what was taken, and the prior,
how unlike a sharp image it is. Told at the two levels of the image step, for pages of a run.
"""

from __future__ import annotations

import cv2
from depth_deblur_ros.core.blur import blur_operator, BlurOperator
from depth_deblur_ros.core.data import (
    DeblurResult,
    EnergyStep,
    FloatImage,
    MIN_SIDE,
    Outcome,
    RgbdFrame,
)
from depth_deblur_ros.core.latent import noise_sigma, SATURATED, SIGMA_FLOOR, SPACING
from depth_deblur_ros.core.light import light_from_stored, light_slope
from depth_deblur_ros.core.quadratic import EPSILON, EXPONENT
import numpy as np

GREY_LEVELS = 255.0
LINKS = (((0, 1), 1.0), ((1, 0), 1.0), ((1, 1), 0.5), ((1, -1), 0.5))  # (y, x) and the weight


def energies_of(frame: RgbdFrame, result: DeblurResult, prior: float) -> tuple[EnergyStep, ...]:
    """
    Give (7) before and after the image step, at half (level 0) and at full size (level 1).

    Terms misfit and prior [grey levels^2], mean over the samples; prior as the parameter of that
    name. Empty where the image was left as it is.
    """
    change = np.abs(result.image - frame.image).max()  # of what a bag has rounded, too
    if result.outcome is not Outcome.SOLVED or change * GREY_LEVELS < 1:
        return ()
    taken, sharp = (_colour(image) for image in (frame.image, result.image))
    sigma, steps = noise_sigma(taken), []
    for level, parts in enumerate((2, 1)):
        width, height = frame.camera.width // parts, frame.camera.height // parts
        if min(width, height) < MIN_SIDE:
            continue
        camera = frame.camera.scaled(width, height)
        depth = _resized(result.depth, width, height, cv2.INTER_NEAREST)
        blur = blur_operator(result.motion, depth, camera, SPACING)
        first, last = (_resized(image, width, height, cv2.INTER_AREA) for image in (taken, sharp))
        weight = prior * max(sigma / parts, SIGMA_FLOOR[camera.transfer]) ** 2
        for step, image in (('before', first), ('after', last)):
            terms = {
                'misfit': _misfit(image, first, blur, camera.transfer),
                'prior': weight * _roughness(image),
            }
            steps.append(EnergyStep(level, step, terms))
    return tuple(steps)


def _misfit(sharp: FloatImage, taken: FloatImage, blur: BlurOperator, transfer: str) -> float:
    """Give 1/2 |A L - B|^2_W of images (H, W, 3), stored values, without a rim that looks out."""
    missing = light_from_stored(taken, transfer) - blur.apply(
        blur.widen(light_from_stored(sharp, transfer))
    )
    missing[(taken >= SATURATED) & (missing <= 0)] = 0
    missing /= light_slope(taken, transfer)
    m = min(blur.margin, min(taken.shape[:2]) // 4)
    power = float(np.square(missing[m:-m, m:-m], dtype=np.float64).mean())
    return GREY_LEVELS**2 / 2 * power


def _roughness(stored: FloatImage) -> float:
    """Give the prior's sum of (|d u|^2 + eps^2)^(alpha / 2) / alpha, mean over the samples."""
    total = 0.0
    for (down, aside), weight in LINKS:
        here = stored[: stored.shape[0] - down, max(-aside, 0) : stored.shape[1] - max(aside, 0)]
        there = stored[down:, max(aside, 0) : stored.shape[1] - max(-aside, 0)]
        power = np.square(there - here).mean(axis=2, dtype=np.float64) + EPSILON**2
        total += weight / EXPONENT * float(np.power(power, EXPONENT / 2).sum())
    return GREY_LEVELS**2 * total / float(stored.shape[0] * stored.shape[1])


def _colour(image: FloatImage) -> FloatImage:
    return image if image.ndim == 3 else np.repeat(image[..., None], 3, 2)


def _resized(image: FloatImage, width: int, height: int, how: int) -> FloatImage:
    if image.shape[:2] == (height, width):
        return image
    return np.asarray(cv2.resize(image, (width, height), interpolation=how), np.float32)
