"""
What JPEG leaves in a picture: steps between its blocks, which tell how much it took away.

Notation: t third difference of stored values across a row (or column), e error of a block. Over
a border t has 2 (e' - e), whose mean square is 8 times that of e.
"""

from __future__ import annotations

import math

from depth_deblur_ros.core.data import FloatImage
import numpy as np

BLOCK = 8  # px
CLEAR = 1.6  # times the others, along both axes; without JPEG at most 1.36
SPARSE = 4  # every so many-th pixel along a border
LEAST_SIDE = 16 * BLOCK  # px; in smaller pictures chance looks like a grid


def block_sigma(stored: FloatImage) -> float:
    """Estimate what blocks are off [stored units] in an image (H, W, C); 0 where no grid shows."""
    if min(stored.shape[:2]) < LEAST_SIDE:
        return 0.0
    excess = []
    for picture in (stored, stored.swapaxes(0, 1)):
        x = np.ascontiguousarray(picture[:, ::SPARSE]).reshape(len(picture), -1)
        t = x[3:] - x[:-3] - 3 * (x[2:-1] - x[1:-2])
        power = np.einsum('ij,ij->i', t, t) / t.shape[1]
        # The median of rows, so that a line of the scene is no grid.
        phases = np.sort([np.median(power[k::BLOCK]) for k in range(BLOCK)])
        border, rest = float(phases[-1]), float(np.median(phases[:-1]))
        if border <= CLEAR * rest:
            return 0.0
        excess.append((border - rest) / 8)
    return math.sqrt(sum(excess) / 2)
