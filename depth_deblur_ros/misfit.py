"""
What the image step has gained: (7) of docs/method.md for the image as taken and for the sharp one.

(7) adds up the misfit, how far the image under its motion is from what was taken, and the prior,
how unlike a sharp image it is. Told at the two levels of the image step, for pages of a run.
"""

from __future__ import annotations

from depth_deblur_ros.core.blur import blur_operator, BlurOperator
from depth_deblur_ros.core.data import (
    DeblurResult,
    EnergyStep,
    FloatImage,
    MIN_SIDE,
    Outcome,
    RgbdFrame,
)
from depth_deblur_ros.core.latent import picture_sigma, SATURATED, SIGMA_FLOOR, SPACING
from depth_deblur_ros.core.light import as_colour, light_from_stored, light_slope
from depth_deblur_ros.core.pyramid import Level, scaled_level
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
    taken, sharp = (
        Level(as_colour(image), result.depth, frame.camera)
        for image in (frame.image, result.image)
    )
    sigma, steps = picture_sigma(taken.image), []
    for size, parts in enumerate((2, 1)):
        width, height = frame.camera.width // parts, frame.camera.height // parts
        if min(width, height) < MIN_SIDE:
            continue
        first, last = (scaled_level(level, width, height) for level in (taken, sharp))
        blur = blur_operator(result.motion, first.depth, first.camera, SPACING)
        transfer = frame.camera.transfer
        weight = prior * max(sigma / parts, SIGMA_FLOOR[transfer]) ** 2
        for step, level in (('before', first), ('after', last)):
            terms = {
                'misfit': _misfit(level.image, first.image, blur, transfer),
                'prior': weight * _roughness(level.image),
            }
            steps.append(EnergyStep(size, step, terms))
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
