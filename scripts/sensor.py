"""What a camera and a depth camera make of the light and the depth: noise, steps and holes."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt
from raycast import Array, Light
from scene import DepthView, Rng
from textures import srgb_from_linear

GAIN = 1.7  # exposure of the picture; the lightest spots saturate
FULL_WELL = 40000.0  # electrons at white: shot noise
READ_NOISE = 12.0  # electrons

DISPARITY = 43.5  # px m; focal length times base line of the structured-light sensor
DISPARITY_STEP = 1 / 8  # px
DISPARITY_NOISE = 0.08  # px
EDGE_JITTER = 0.8  # px; how ragged the edges are
RANGE = (0.5, 4.5)  # m
WEAKEST = 0.0028  # reflectance x cosine / depth^2 [1/m^2] that still gives a return
GRAZING = 0.14  # cosine of incidence
MIRROR = 0.9  # cosine of incidence below which a shiny surface sends the light elsewhere
MATCHING = 3.0  # px; sigma of the sensor's matching window
BORDER = 8  # px; half the widest window, lost on the side of the projector


def photograph(light: Light, rng: Rng) -> npt.NDArray[np.uint8]:
    """Turn linear light (H, W, 3) into an 8-bit sRGB picture with shot and read noise."""
    electrons = rng.poisson(light * (GAIN * FULL_WELL)) + rng.normal(0, READ_NOISE, light.shape)
    picture = np.rint(255 * srgb_from_linear(electrons / FULL_WELL))
    return picture.astype(np.uint8)


def _smooth_noise(rng: Rng, shape: tuple[int, int], sigma: float) -> Array:
    noise = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), sigma)
    return np.asarray(noise / noise.std(), np.float64)


def _moved(rng: Rng, where: Array) -> npt.NDArray[np.int64]:
    """Shift pixel coordinates at random, smoothly, within the image."""
    shift = EDGE_JITTER * _smooth_noise(rng, where.shape, 1.5)
    return np.clip(np.rint(where + shift), 0, where.max()).astype(np.int64)


def depth_picture(view: DepthView, light: Light, rng: Rng) -> npt.NDArray[np.uint16]:
    """
    Turn an exact depth view into what a structured-light camera gives: (H, W) mm, 0 = hole.

    light is the sharp picture of the same view: its dark surfaces send too little back.
    """
    shape = view.depth.shape
    y, x = (_moved(rng, where) for where in np.indices(shape).astype(float))
    depth, cosine = view.depth[y, x], view.incidence[y, x]
    error = DISPARITY_NOISE * _smooth_noise(rng, shape, 1.5)
    disparity = np.rint((DISPARITY / depth + error) / DISPARITY_STEP) * DISPARITY_STEP
    reflected = cv2.GaussianBlur(light.mean(axis=2), (0, 0), MATCHING)
    back = reflected[y, x] * cosine / depth**2
    seen = view.lit[y, x] & (depth > RANGE[0]) & (depth < RANGE[1]) & (cosine > GRAZING)
    seen &= back * np.exp(0.5 * _smooth_noise(rng, shape, 2.0)) > WEAKEST
    seen &= (view.shine[y, x] < 0.5) | (cosine > MIRROR)
    seen[:, :BORDER] = False
    measured = 1000 * DISPARITY / np.maximum(disparity, DISPARITY_STEP)
    return np.where(seen, np.rint(measured), 0).astype(np.uint16)
