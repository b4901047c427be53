"""Hole filling by plain loops in float64, the twin of core/depth.py."""

from depth_deblur_ros.core.depth import ASKED, BACKGROUND, COLOUR_SIGMA
import numpy as np


def fill_by_loops(depth, measured, colours, nearest, seeds):
    """Give depth (H, W) filled; colours (H, W, C), nearest (H, W) rows of seeds (n, 3 + C)."""
    filled = depth.astype(np.float64)
    for y, x in np.argwhere(~measured):
        near = seeds[nearest[y, x], :2] - np.float32([y, x])
        asked = seeds[_asked(y, x, np.sqrt(np.square(near).sum()), nearest)].astype(np.float64)
        r2 = np.square(asked[:, :2] - (y, x)).sum(1)
        c2 = np.square(asked[:, 3:] - colours[y, x]).mean(1)
        z = asked[:, 2]
        cost = c2 / (2 * COLOUR_SIGMA**2) + BACKGROUND * (1 - z / z.max())
        filled[y, x] = np.average(z, weights=(r2[0] / r2) ** 2 * np.exp(-cost))
    return filled


def _asked(y, x, near, nearest):
    """Round in float32, as the kernel does: a pixel is asked or it is not."""
    at = np.floor(np.float32([y, x]) + ASKED * np.float32(near) + np.float32(0.5)).astype(int)
    inside = np.clip(at, 0, np.array(nearest.shape) - 1)
    return nearest[inside[:, 0], inside[:, 1]]
