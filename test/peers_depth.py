"""
Other ways to fill depth, as good as they can be made, and the errors to compare them by.

Each way takes depth (H, W) float32 [m], NaN = hole, and guide (H, W, 3) 0..1, and keeps what was
measured.
[LLW04] Levin, Lischinski & Weiss, Colorization using optimization, SIGGRAPH 2004.
[MIN14] Min et al., Fast global image smoothing based on weighted least squares, TIP 2014.
"""

import time

import cv2
from depth_deblur_ros.folders import read_camera, read_depth, read_frame
import numpy as np
from scipy import ndimage, sparse
from scipy.linalg import solveh_banded
from scipy.sparse.linalg import spsolve


def nearest(depth, guide):
    """Take the nearest measurement."""
    del guide
    index = ndimage.distance_transform_edt(
        np.isnan(depth), return_distances=False, return_indices=True
    )
    return depth[tuple(index)]


def inpaint(flag, radius):
    """
    Give cv2.inpaint with a flag and radius [px], on 16 bit over the range of the measurements.

    Better than 8 bit; on float32 its Telea takes values of more than about 1 for something else.
    """

    def fill(depth, guide):
        del guide
        hole = np.isnan(depth)
        low, high = np.nanmin(depth), np.nanmax(depth)
        span = max(high - low, 1e-6)
        code = np.where(hole, 0, np.round((depth - low) / span * 65535)).astype(np.uint16)
        value = cv2.inpaint(code, hole.astype(np.uint8), radius, flag)
        return np.where(hole, value / np.float32(65535) * span + low, depth)

    return fill


def levin(sigma):
    """
    Give [LLW04]: each hole pixel the mean of its 8 neighbours, weighted by likeness of colour.

    sigma: of the colour difference, or None for the paper's own, from the variance of 3x3 pixels.
    """

    def fill(depth, guide):
        hole = np.isnan(depth)
        weights, neighbours = _links(guide.astype(np.float64), sigma)
        take = hole & (weights > 0)
        rows = np.broadcast_to(np.arange(depth.size).reshape(depth.shape), weights.shape)
        shape = (depth.size, depth.size)
        mean = sparse.csr_matrix((weights[take], (rows[take], neighbours[take])), shape)[
            hole.ravel()
        ]
        known = np.flatnonzero(~hole)
        system = sparse.eye(hole.sum()) - mean[:, np.flatnonzero(hole)]
        filled = depth.copy()
        filled[hole] = spsolve(system.tocsc(), mean[:, known] @ depth[~hole].astype(np.float64))
        return filled

    return fill


def _links(guide, sigma):
    """Give weights (8, H, W) that sum to 1 over the neighbours, and their flat indices."""
    height, width = guide.shape[:2]
    colours = np.pad(guide, ((1, 1), (1, 1), (0, 0)), 'edge')
    index = np.pad(np.arange(height * width).reshape(height, width), 1, constant_values=-1)
    window = [(y, x) for y in range(3) for x in range(3) if (y, x) != (1, 1)]
    seen = np.stack([colours[y : y + height, x : x + width] for y, x in window])
    neighbours = np.stack([index[y : y + height, x : x + width] for y, x in window])
    d2 = np.square(seen - guide).sum(-1)
    if sigma is None:
        variance = np.concatenate([seen, guide[None]]).var(0).sum(-1)
        spread = np.maximum(0.6 * variance, np.maximum(-d2.min(0) / np.log(0.01), 2e-6))
        weights = np.exp(-d2 / spread)
    else:
        weights = np.exp(-d2 / (2 * sigma**2)) + 1e-6
    weights = np.where(neighbours < 0, 0, weights)
    return weights / weights.sum(0), neighbours


def fast_global_smoother(strength, sigma, passes=3):
    """Give [MIN14], normalised: the smoothed measurements over the smoothed mask of them."""

    def fill(depth, guide):
        hole = np.isnan(depth)
        stack = np.stack([np.where(hole, 0, depth), np.where(hole, 0, 1)], -1).astype(np.float64)
        steps = [np.sqrt(np.square(np.diff(guide, axis=a)).sum(-1)) for a in (1, 0)]
        wx, wy = (np.maximum(np.exp(-step / sigma), 1e-3) for step in steps)
        for k in range(passes):
            share = 1.5 * strength * 4.0 ** (passes - 1 - k) / (4.0**passes - 1)
            stack = _smooth_rows(stack, share * wx)
            stack = _smooth_rows(stack.swapaxes(0, 1), share * wy.T).swapaxes(0, 1)
        return np.where(hole, stack[..., 0] / stack[..., 1], depth).astype(np.float32)

    return fill


def _smooth_rows(stack, links):
    """Solve (1 + links' Laplacian) u = stack along all rows: one long tridiagonal system."""
    height, width, channels = stack.shape
    link = np.zeros((height, width))
    link[:, :-1] = links
    flat = link.ravel()
    diagonal = 1 + flat + np.r_[0, flat[:-1]]
    upper = np.r_[0, -flat[:-1]]
    solved = solveh_banded(np.stack([upper, diagonal]), stack.reshape(-1, channels))
    return solved.reshape(height, width, channels)


PEERS = {
    'nearest measurement': nearest,
    'cv2.inpaint NS, radius 3': inpaint(cv2.INPAINT_NS, 3),
    'cv2.inpaint NS, radius 5': inpaint(cv2.INPAINT_NS, 5),
    'cv2.inpaint Telea, radius 3': inpaint(cv2.INPAINT_TELEA, 3),
    'cv2.inpaint Telea, radius 5': inpaint(cv2.INPAINT_TELEA, 5),
    'Levin colorization, local variance': levin(None),
    'Levin colorization, sigma 0.02': levin(0.02),
    'fast global smoother, normalised': fast_global_smoother(3.0, 0.05),
}


def camera_cases(data):
    """Give (frame, true depth) of the cases with a depth camera's holes and noise."""
    for folder in sorted((data / 'eval').glob('camera-*')):
        frame = read_frame(folder / 'rgb.png', folder / 'depth.png', folder / 'camera.json')
        scale = read_camera(folder / 'camera.json').depth_scale
        yield frame, read_depth(folder / 'truth/depth.png', scale, frame.camera)


def score(fill, cases):
    """Give the mean over the cases of `errors`, and the median time [ms] for 640x480 pixels."""
    found, times = [], []
    for frame, truth in cases:
        begin = time.perf_counter()
        filled = fill(frame.depth, frame.image)
        times.append((time.perf_counter() - begin) * 1e3 * 640 * 480 / truth.size)
        found.append(errors(filled, frame.depth, truth))
    return {key: np.mean([e[key] for e in found]) for key in found[0]} | {'ms': np.median(times)}


def errors(filled, depth, truth):
    """Give the errors of depth [mm] and inverse depth [1/km], where the truth is known."""
    known = truth > 0
    hole = known & ~(depth > 0)
    z, true = filled[hole].astype(np.float64), truth[hole].astype(np.float64)
    return {
        'rmse': 1e3 * _rms(z - true),
        'mae': 1e3 * np.abs(z - true).mean(),
        'rmse_inverse': 1e3 * _rms(1 / z - 1 / true),
        'rmse_all': 1e3 * _rms(filled[known].astype(np.float64) - truth[known]),
        'mae_all': 1e3 * np.abs(filled[known].astype(np.float64) - truth[known]).mean(),
        'bad': 100 * (np.abs(z / true - 1) > 0.05).mean(),
    }


def _rms(x):
    return np.sqrt(np.square(x).mean())
