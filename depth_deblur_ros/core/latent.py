"""
The sharp image when the motion is known.

Notation: L latent light, B blurred light, A the blur (blur.py), u = stored values of L, l' slope
of the transfer (light.py), sigma noise of the stored values, d(u) differences to the eight
neighbours. Minimises, (7) of docs/method.md,

    1/2 |A L - B|^2_W + c sigma^2 sum (|d u|^2 + eps^2)^(alpha / 2),   W = 1 / l'(B)^2,

with differences of the three channels taken together, by iteratively reweighted least squares:
each step solves a quadratic problem (quadratic.py). Noise is even in stored values, not in light,
so both the data and the prior are weighted by the slope.
[KF09] Krishnan & Fergus, NIPS 2009: the hyper-Laplacian prior. [IRLS] Levin et al., SIGGRAPH 2007.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import math

import cv2
from depth_deblur_ros.core.blur import blur_operator
from depth_deblur_ros.core.compression import block_sigma
from depth_deblur_ros.core.data import CameraIntrinsics, FloatImage, MIN_SIDE, Motion
from depth_deblur_ros.core.descent import conjugate_gradients
from depth_deblur_ros.core.geometry import blur_length
from depth_deblur_ros.core.light import light_ease, light_from_stored, stored_from_light
from depth_deblur_ros.core.pyramid import Level, scaled_level
from depth_deblur_ros.core.quadratic import reweighted
from depth_deblur_ros.core.sweep import Sweep
from depth_deblur_ros.core.threads import each, on_threads, SHARED
from numba import njit
import numpy as np

# px of mean blur for which half of a size is worth it (of the full one it always is), and what
# noise adds to them in brief
SHOWN, SHOWN_LATER = 3.0, 6.0
SATURATED = 0.99  # stored values above may stand for any amount of light
FEW = 0.02  # share of them up to which the first guess tells which of them count
# px of the longest blur, and of a block's own, from one instant of the exposure to the next, and
# what noise adds to them in brief
SPACING, OWN_SPACING = 1.5, 0.5
WIDER, OWN_WIDER = 2.0, 1.0
OF_LONG = 1 / 3  # what noise adds to them over long blurs, in brief: a share of the mean blur
SLACK = 0.2  # px beyond a cell that a block may read, as far as noise hides it; `sweep_of`
COARSE_OUTER, COARSE_LONGER = 2, 1.5  # reweightings at half the size, and how much longer each
EARLIER = 2 / 3  # by how much noise may shorten all reweightings but the last
CLEAN = 0.003  # sigma [stored units] up to which all steps are worth it
# Least sigma [stored units]: 8 bit rounding for averaged values; real cameras hide their noise
# from the estimate by demosaicing, and lens and shutter leave more unexplained.
SIGMA_FLOOR = {'linear': 0.0025, 'srgb': 0.012}


@dataclass(frozen=True)
class LatentSteps:
    """How long and how smooth: prior weight c, reweightings, conjugate gradient steps in each."""

    prior: float
    outer: int
    inner: int
    brief: bool = False  # fewer steps and instants yet where noise hides what they bring
    early: float = 1.0  # share of the steps in all reweightings but the last

    def within(self, k: int) -> int:
        """Give the steps in reweighting k."""
        return self.inner if k == self.outer - 1 else math.ceil(self.early * self.inner)


@dataclass(frozen=True)
class Effort:
    """Noise, and what is done at a size and at those below it."""

    sigma: float  # stored units
    steps: LatentSteps
    spacing: tuple[float, float]  # px of the longest blur and of a block's for an instant
    long: float  # px from one instant to the next, at least
    slack: float  # px, `sweep.sweep_of`
    longer: float  # how much longer each reweighting is at half the size
    sizes: int  # how many below this one


def noise_sigma(stored: FloatImage) -> float:
    """
    Estimate the noise [stored units] of a blurred image (H, W, 3), from its flattest fifth.

    Second differences across both axes remove planes; motion blur leaves little else in flat
    parts.
    """
    mask = np.array([1, -2, 1], np.float32)
    d = np.atleast_3d(cv2.sepFilter2D(stored, -1, mask, mask)[1:-1, 1:-1])
    height, width = (n // 8 * 8 for n in d.shape[:2])
    square = np.square(d[:height, :width])
    blocks = cv2.resize(square, (width // 8, height // 8), interpolation=cv2.INTER_AREA)
    power = np.atleast_3d(blocks).mean(axis=2)
    # The mask (1 -2 1)' (1 -2 1) has a sum of squares of 36.
    return float(np.sqrt(np.percentile(power, 20) / 36))


def picture_sigma(stored: FloatImage) -> float:
    """Estimate noise and what JPEG took [stored units], of a blurred image (H, W, 3)."""
    return math.hypot(*each(lambda estimate: estimate(stored), (noise_sigma, block_sigma)))


def is_clean(stored: FloatImage, transfer: str) -> bool:
    """Tell whether no noise, JPEG or curve of a camera hides what a blurred image knows."""
    return SIGMA_FLOOR[transfer] <= CLEAN and picture_sigma(stored) <= CLEAN


def restore_coarse_to_fine(
    blurred: FloatImage,
    depth: FloatImage,
    motion: Motion,
    camera: CameraIntrinsics,
    steps: LatentSteps,
) -> FloatImage:
    """
    Give the sharp image (H, W, 3), stored values, under a known motion; depth (H, W) filled [m].

    At half the size an eighth of the work brings most of what is long and slow to converge, and
    so on, as long as blur shows. Noise makes the prior weigh more, which takes fewer steps, and
    in brief fewer instants.
    """
    sigma = picture_sigma(blurred)
    worth = math.sqrt(CLEAN / max(CLEAN, sigma, SIGMA_FLOOR[camera.transfer]))
    haste = 1 - worth if steps.brief else 0.0
    steps = replace(steps, inner=math.ceil(worth * steps.inner), early=1 - EARLIER * haste)
    length = blur_length(motion.by_rows, depth, camera)
    spacing = (SPACING + WIDER * haste, OWN_SPACING + OWN_WIDER * haste)
    sizes = 1 + math.floor(math.log2(max(length / (SHOWN + SHOWN_LATER * haste), 1)))
    slack = SLACK * min(1.0, 2 * (1 - worth))
    long = OF_LONG * haste * length
    effort = Effort(sigma, steps, spacing, long, slack, COARSE_LONGER - haste, sizes)
    light = _restored(Level(blurred, depth, camera), motion, effort)
    return stored_from_light(light, camera.transfer)


def _restored(level: Level, motion: Motion, effort: Effort) -> FloatImage:
    """Restore light from that of half the size, as long as there is one."""
    first, steps, camera = None, effort.steps, level.camera
    width, height = camera.width // 2, camera.height // 2
    if effort.sizes and min(width, height) >= MIN_SIDE:
        inner = round(effort.longer * steps.inner)
        coarse = replace(steps, outer=COARSE_OUTER, inner=inner)
        # Four pixels in one: half the noise.
        less = replace(
            effort,
            sigma=effort.sigma / 2,
            steps=coarse,
            long=effort.long / 2,
            sizes=effort.sizes - 1,
        )
        half = _restored(scaled_level(level, width, height), motion, less)
        first = _magnified(half, camera)
    longest, own = max(effort.spacing[0], effort.long), effort.spacing[1]
    sweep = blur_operator(motion, level.depth, camera, longest).thinned(own, effort.slack)
    return restored_light(level.image, sweep, camera.transfer, effort.sigma, steps, first=first)


def _magnified(light: FloatImage, camera: CameraIntrinsics) -> FloatImage:
    """Give light at a camera's size; what is brighter than can be stored stays so."""
    size, transfer = (camera.width, camera.height), camera.transfer
    stored = _resized(stored_from_light(light, transfer), *size, cv2.INTER_CUBIC)
    within = light_from_stored(np.clip(stored, 0, 1), transfer)
    beyond = np.maximum(light - 1, 0)
    return within + _resized(beyond, *size, cv2.INTER_LINEAR) if beyond.any() else within


def _resized(image: FloatImage, width: int, height: int, how: int) -> FloatImage:
    return np.asarray(cv2.resize(image, (width, height), interpolation=how), np.float32)


def restored_light(
    blurred: FloatImage,
    sweep: Sweep,
    transfer: str,
    sigma: float,
    steps: LatentSteps,
    *,
    first: FloatImage | None = None,
) -> FloatImage:
    """
    Give the sharp light (H, W, 3) of stored values under a known blur A; first: a guess.

    Where blurred values are saturated it may exceed 1.
    """
    height, width = blurred.shape[:2]
    stored = sweep.blurred_planes(blurred)
    light, noise = light_from_stored(stored, transfer), light_ease(stored, transfer)
    noise[:, :, width:] = 0
    full = stored >= SATURATED
    many = np.count_nonzero(full) > FEW * blurred.size
    start = light[:, :, :width] if first is None else np.moveaxis(first, 2, 0)
    latent = sweep.widened(start)
    weight = np.float32(steps.prior * max(sigma, SIGMA_FLOOR[transfer]) ** 2)
    for k in range(steps.outer):
        if k == 0 or many:
            pull = sweep.missing(light, latent, sweep.taken)
            trust = noise.copy() if many else noise
            on_threads(_trust_rows, height, full, trust, pull)
            problem = reweighted(latent, sweep, transfer, trust, weight)
            slope = problem.slope(pull, latent)
        else:
            before, problem = problem, reweighted(latent, sweep, transfer, trust, weight)
            slope = problem.slope_after(before, slope, latent)
        latent = conjugate_gradients(problem, latent, slope, steps.within(k))
    r = sweep.room
    return np.asarray(cv2.merge([*latent[:, r : r + height, r : r + width]]), np.float32)


@njit(**SHARED)
def _trust_rows(first, end, full, trust, missing):  # type: ignore[no-untyped-def]
    """
    Take trust from what is full and of what is not missing, B - A L; leave their product there.

    What is saturated says only "at least this": it does not count where the model gives more.
    """
    for c in range(3):
        for y in range(first, end):
            for x in range(trust.shape[2]):
                counts = not full[c, y, x] or missing[c, y, x] > 0
                own = trust[c, y, x] if counts else np.float32(0)
                trust[c, y, x] = own
                missing[c, y, x] *= own
