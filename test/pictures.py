"""Cheap pictures for the blind start: natural-looking textures, as sharp as a camera's."""

import cv2
import numpy as np


def texture(seed, shape=(240, 320)):
    """Give a grey picture (H, W) with edges at all scales."""
    rng, mix = np.random.default_rng(seed), np.zeros(shape)
    for size in (0.7, 1.5, 3, 6, 12):
        noise = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), size)
        mix += noise / noise.std() * np.sqrt(size)
    return np.clip(0.5 + 0.25 * np.sign(mix) + 0.05 * mix / mix.std(), 0, 1).astype(np.float32)


def swept(picture, length, angle=0.0, sigma=0.0):
    """Blur a picture along a straight line [px, rad], with noise; borders repeat."""
    views = max(33, int(2 * length))
    total = np.zeros(picture.shape, np.float64)
    for t in (np.arange(views) + 0.5) / views - 0.5:
        shift = t * length * np.array([np.cos(angle), np.sin(angle)])
        matrix = np.array([[1, 0, shift[0]], [0, 1, shift[1]]])
        size = picture.shape[::-1]
        total += cv2.warpAffine(picture, matrix, size, borderMode=cv2.BORDER_REPLICATE)
    noise = sigma * np.random.default_rng(0).standard_normal(picture.shape)
    return np.clip(total / views + noise, 0, 1).astype(np.float32)
