"""
The page that tells the algorithm: from one blurred RGB-D frame to the sharp image and the motion.

1 fill the depth map's holes, guided by the colours (depth.py)
2 find the motion from the bands that it leaves in the spectra, coarse and fine (start.py), or
  find that there is no blur or nothing to trust: then the frame passes unchanged
3 move on to where the image itself is likeliest (joint.py), unless the bands say otherwise: in
  mode full, and at the first frame in the others
4 restore the image under that motion (latent.py), near things passing before far ones (blur.py)

With `method` paper, 2 to 4 are the paper's: alternation.py.
"""

from __future__ import annotations

from dataclasses import replace
import time

import cv2
from depth_deblur_ros.core.data import (
    DeblurResult,
    EnergyStep,
    FloatImage,
    Motion,
    Outcome,
    RgbdFrame,
)
from depth_deblur_ros.core.depth import fill_depth, find_holes
from depth_deblur_ros.core.geometry import blur_length
from depth_deblur_ros.core.joint import Effort, refine
from depth_deblur_ros.core.latent import is_clean, LatentSteps, restore_coarse_to_fine
from depth_deblur_ros.core.lens import undistorted
from depth_deblur_ros.core.light import as_colour, light_from_stored, stored_from_light
from depth_deblur_ros.core.likelihood import Pace
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.core.start import blind_start, Start
from depth_deblur_ros.core.threads import at_most, both
from depth_deblur_ros.core.trust import calibrated, edges_of, OF_LIKELIHOOD, OF_SPECTRA
import numpy as np

SATURATED, EVENLY = 0.98, 0.02  # stored values; how many more pixels a channel may have there
SPARSE = 4  # every so many-th pixel tells that
FAST_OUTER, FAST_LONGER = 2, 1.2  # mode fast: reweightings, and how much longer each
# Of the joint refinement. A clean picture tells more the longer it is asked; another gives nearly
# all that it knows at the first look, at fewer pixels, and of long blurs at half the size.
CLEAN, NOISY = Effort(), Effort(120_000, enough=0.3, affordable=16.0, readable=24.0)
BRIEF = replace(
    NOISY,
    pixels=52_000,
    moves=2,
    enough=0.4,
    affordable=24.0,
    doubt=1.15,
    instants=8.0,
    pace=Pace(spacing=0.85, steps=6, last=8),
)


def deblur(
    frame: RgbdFrame,
    params: SolverParams | None = None,
    *,
    start: Motion | None = None,
    restore: bool = True,
) -> DeblurResult:
    """
    Find the sharp image and the camera's motion during the exposure of one frame.

    start: a further motion to start from (the previous frame's, say). restore: if not, the motion
    is found as the mode asks, and the image stays as it was taken, for `restore_known`.

    Pure: the same input gives the same output, but for seconds. One image cannot tell the sign of
    the motion, and no motion has none: sign_resolved is False. Image and depth of a lens with
    distortion are undistorted first, and come back so. Raises InputError when all depth is
    missing.
    """
    params, frame = params or SolverParams(), undistorted(frame)
    began = time.monotonic()
    with at_most(params.threads):
        if params.method == 'paper':
            depth = fill_depth(frame.depth, frame.image, threads=params.threads)
            found, energies = _alternated(frame, depth, params)
            result = _finish(frame, depth, found, params, began, restore=restore)
            return replace(result, energies=energies)
        holes, edges = both(
            lambda: find_holes(frame.depth, frame.image),
            lambda: edges_of(_grey(frame.image, _channels(frame.image))),
        )
        depth = holes.filled()
        found = blind_start(edges, depth, frame.camera, start)
        if found.outcome is Outcome.SOLVED:
            effort = _effort(frame, params.mode, known=start is not None)
            found = replace(found, motion=_settled(frame, depth, found, effort), scales=())
        return _finish(frame, depth, found, params, began, restore=restore)


def _effort(frame: RgbdFrame, mode: str, *, known: bool) -> Effort | None:
    """Say what the joint refinement may cost, if there is one; known: what about to expect."""
    if mode != 'full' and known:
        return None
    if is_clean(frame.image, frame.camera.transfer):
        return CLEAN
    return NOISY if mode == 'full' else BRIEF


def _settled(frame: RgbdFrame, depth: FloatImage, found: Start, effort: Effort | None) -> Motion:
    """Refine the motion, if it may cost that, and tell a covariance as large as errors are."""
    motion, share = found.motion, OF_SPECTRA
    if effort is not None:
        refined = _refined(frame, depth, found, effort)
        if found.explains(refined):
            motion, share = refined, OF_LIKELIHOOD[frame.camera.transfer] * effort.doubt
    blur_px = blur_length(motion.by_rows, depth, frame.camera)
    return calibrated(motion, found.axes, share * found.doubt, blur_px)


def _refined(frame: RgbdFrame, depth: FloatImage, found: Start, effort: Effort) -> Motion:
    """Move to where the image is likeliest."""
    light = light_from_stored(frame.image, frame.camera.transfer)
    light = _grey(light, _channels(frame.image))
    return refine(light, depth, frame.camera, found, effort)


def restore_known(
    frame: RgbdFrame, motion: Motion, params: SolverParams | None = None
) -> DeblurResult:
    """Restore the image under a known motion: the limit of any estimate of the motion."""
    params, frame = params or SolverParams(), undistorted(frame)
    began = time.monotonic()
    with at_most(params.threads):
        depth = fill_depth(frame.depth, frame.image, threads=params.threads)
        return _finish(frame, depth, Start(motion, Outcome.SOLVED, 1.0), params, began)


def _finish(
    frame: RgbdFrame,
    depth: FloatImage,
    found: Start,
    params: SolverParams,
    began: float,
    *,
    restore: bool = True,
) -> DeblurResult:
    """Restore the image where there is a motion and the mode asks for it; sum up."""
    wanted = restore and found.outcome is Outcome.SOLVED and params.mode != 'motion'
    return DeblurResult(
        image=_restored(frame, depth, found.motion, params) if wanted else frame.image,
        depth=depth,
        motion=found.motion,
        outcome=found.outcome,
        sign_resolved=False,
        quality=found.quality,
        blur_px=blur_length(found.motion.by_rows, depth, frame.camera),
        seconds=time.monotonic() - began,
    )


def _restored(
    frame: RgbdFrame, depth: FloatImage, motion: Motion, params: SolverParams
) -> FloatImage:
    """Run the image step on a colour or grey frame."""
    colour, camera = as_colour(frame.image), frame.camera
    if params.method == 'paper':
        from depth_deblur_ros.core.alternation import restore

        light = light_from_stored(colour, camera.transfer)
        latent = restore(light, depth, camera, motion.vector, params)
        sharp = stored_from_light(latent, camera.transfer)
    else:
        steps = LatentSteps(params.prior, params.reweightings, params.cg_steps)
        if params.mode == 'fast':
            inner = round(FAST_LONGER * steps.inner)
            steps = LatentSteps(steps.prior, min(FAST_OUTER, steps.outer), inner, brief=True)
        sharp = restore_coarse_to_fine(colour, depth, motion, camera, steps)
    return np.ascontiguousarray(sharp[..., 0]) if frame.image.ndim == 2 else sharp


def _alternated(
    frame: RgbdFrame, depth: FloatImage, params: SolverParams
) -> tuple[Start, tuple[EnergyStep, ...]]:
    """Find the motion by the paper's method, with the energies on the way."""
    from depth_deblur_ros.core.alternation import alternate  # brings scipy: half a second

    light = light_from_stored(as_colour(frame.image), frame.camera.transfer)
    found = alternate(light, depth, frame.camera, params)
    return Start(Motion.from_vector(found.p), found.outcome, found.quality), found.trace


def _grey(image: FloatImage, channels: FloatImage) -> FloatImage:
    if image.ndim == 2:
        return image
    first, count, others = int(channels.argmax()), channels.sum(), channels.copy()
    # As one channel and how far the others are from it: the mean of equal values is exact.
    others[0, first] -= count
    return np.asarray(image[..., first] + cv2.transform(image, others) / count, np.float32)


def _channels(image: FloatImage) -> FloatImage:
    """Give which channels (1, 3) make grey, 1 or 0: a mean of burnt and others is no light."""
    if image.ndim == 2:
        return np.ones((1, 1), np.float32)
    burnt = np.array(cv2.mean((image[::SPARSE, ::SPARSE] > SATURATED).view(np.uint8))[:3])
    chosen = burnt <= burnt.min() + EVENLY
    return np.asarray(chosen[None], np.float32)
