"""
Slow twins of the compiled kernels, in float64: loops over targets, sparse matrices and scipy.

They are written from the equations in the modules' docstrings, another way round than the
kernels: what a kernel scatters is gathered here, and an operator is a matrix whose transpose is
its adjoint.
"""

from depth_deblur_ros.core.templates import FLOOR, PATCH, REACH
import numpy as np
from scipy.ndimage import map_coordinates
from scipy.sparse import coo_matrix

NEIGHBOURS = ((0, 1), (1, 0), (1, 1), (1, -1))  # (dy, dx) of the four links that a pixel owns
LEAST_GROWTH = 0.1  # a surface that comes closer than this share of its depth counts as there


def instants(samples):
    """Give the mid-points of equal shares of the exposure, rounded as the kernels round them."""
    return ((np.arange(samples) + 0.5) / samples - 0.5).astype(np.float32).astype(np.float64)


def seen(nearness, ray, motion, flow, samples):
    """Give the inverse depth (H, W, N) that each pixel sees: the nearest of what covers it."""
    height, width = nearness.shape
    y, x = np.indices(nearness.shape)
    xn, yn = ray[:width][None], ray[width:][:, None]
    views = []
    for t in instants(samples):
        growth = 1 + t * (motion[0] * yn - motion[1] * xn + motion[5] * nearness)
        near = nearness / np.maximum(growth, LEAST_GROWTH)
        left, top = np.floor(x + t * flow[..., 0]), np.floor(y + t * flow[..., 1])
        view = np.zeros((height, width))
        for row in range(height):
            for column in range(width):
                covers = ((left == column) | (left == column - 1)) & (
                    (top == row) | (top == row - 1)
                )
                view[row, column] = near[covers].max(initial=0)
        views.append(fill_uncovered(view, nearness))
    return np.stack(views, -1)


def fill_uncovered(view, nearness):
    """Give each zero the lesser of the next values left and right of it; else what was at rest."""
    filled = view.copy()
    for row, column in zip(*np.nonzero(view == 0), strict=True):
        sides = view[row, :column][::-1], view[row, column + 1 :]
        first = [side[side > 0][0] for side in sides if (side > 0).any()]
        filled[row, column] = min(first) if first else nearness[row, column]
    return filled


def displacements(blur):
    """Give (dx, dy), (H, W, N) each: how far [px] from its own place each pixel reads at t_i."""
    flow_x, flow_y = flows(blur, kept(blur))
    t = instants(flow_x.shape[2])
    return -t * flow_x, -t * flow_y


def thinned_displacements(blur, spacing):
    """Give as `displacements`, each block of 16 columns at instants of its own, and weights."""
    flow_x, flow_y = flows(blur, kept(blur))
    lengths = np.hypot(*flows(blur, blur.inverse_depth.astype(np.float64)))
    height, width, samples = flow_x.shape
    places, weights = np.zeros((2, height, width, samples)), np.zeros(flow_x.shape)
    for y, left in np.ndindex(height, width // 16):
        block = np.s_[y, 16 * left : 16 * left + 16]
        count = int(np.clip(np.ceil(lengths[block].max() / spacing), 3, samples))
        for i, t in enumerate(instants(count)):
            seen = int((i + 0.5) * samples / count)
            places[(0, *block, i)] = -t * flow_x[(*block, seen)]
            places[(1, *block, i)] = -t * flow_y[(*block, seen)]
            weights[(*block, i)] = 1 / count
    return *places, weights


def flows(blur, w):
    """Give the flow (x, y), (H, W, N) each [px], of inverse depth w (H, W, N)."""
    width = blur.inverse_depth.shape[1]
    vx, vy, vz, fx, fy = blur.motion[3:8].astype(np.float64)
    ray = blur.ray.astype(np.float64)
    xn, yn = ray[None, :width, None], ray[width:, None, None]
    tx, ty, tz = (blur.motion[k] + yn * blur.motion[8 + k] for k in range(3))
    flow_x = fx * (-xn * yn * tx + (1 + xn**2) * ty - yn * tz + w * (vx - xn * vz))
    flow_y = fy * (-(1 + yn**2) * tx + xn * yn * ty + xn * tz + w * (vy - yn * vz))
    return flow_x, flow_y


def kept(blur):
    """Give the inverse depth (H, W, N) as blocks keep it: in whole parts of the nearest, 65535."""
    height, width, samples = blur.inverse_depth.shape
    blocks = np.moveaxis(blur.sweep.layout.nearness, 2, 1).reshape(height, samples, -1)
    parts = np.moveaxis(blocks[..., :width], 1, 2).astype(np.float64)
    return parts * (blur.inverse_depth.max() / 65535)


def blur_matrix(blur):
    """Give A (H W, h w) of a BlurOperator, so that A @ latent is the blurred image."""
    return matrix_of(blur, *displacements(blur), 1 / blur.inverse_depth.shape[2])


def matrix_of(blur, dx, dy, share, slack=0.0):
    """Give A (H W, h w) that reads at these places, with these shares of the exposure."""
    height, width, _ = blur.inverse_depth.shape
    high, wide, _ = blur.latent_shape
    y, x = np.indices((height, width))
    far = blur.margin - 1
    dx, dy = np.clip(dx, -far, far), np.clip(dy, -far, far)
    left, top = cells(dx, dy, slack)
    rows = np.broadcast_to((y * width + x)[..., None], dx.shape)
    parts = []
    u, v = dx - left, dy - top
    for down, right in np.ndindex(2, 2):
        weight = (u if right else 1 - u) * (v if down else 1 - v) * share
        cell_x, cell_y = x[..., None] + left + right, y[..., None] + top + down
        place = (cell_y + blur.margin) * wide + cell_x + blur.margin
        parts.append((weight.ravel(), rows.ravel(), place.ravel()))
    values, i, j = (np.concatenate(part) for part in zip(*parts, strict=True))
    return coo_matrix((values, (i, j.astype(int))), (height * width, high * wide)).tocsr()


def cells(dx, dy, slack):
    """
    Give the upper left offset that each pixel reads at, (H, W, N) along x and y.

    Its own, or that of its block of 16 columns if none of them lies farther beyond than slack.
    """
    found = np.floor(dx), np.floor(dy)
    if slack == 0:
        return found
    for y, left, i in np.ndindex(len(dx), dx.shape[1] // 16, dx.shape[2]):
        block = np.s_[y, 16 * left : 16 * left + 16, i]
        common = [np.floor(d[block].min()) for d in (dx, dy)]
        for k, d in enumerate((dx[block], dy[block])):
            if np.floor(d.max()) > common[k]:
                common[k] = np.floor(d.min() + slack)
        beyond = max((d[block] - c).max() - 1 for d, c in zip((dx, dy), common, strict=True))
        if beyond < slack:
            for axis, own in zip(found, common, strict=True):
                axis[block] = own
    return found


def through(matrix, image, shape):
    """Send each channel of an image through a matrix."""
    flat = image.reshape(-1, image.shape[-1]).astype(np.float64)
    return (matrix @ flat).reshape(*shape[:2], image.shape[-1])


def links_inside(height, width):
    """List (y, x, k, y of the neighbour, x of the neighbour) of all links within the image."""
    found = []
    for y, x in np.ndindex(height, width):
        for k, (dy, dx) in enumerate(NEIGHBOURS):
            if y + dy < height and 0 <= x + dx < width:
                found.append((y, x, k, y + dy, x + dx))
    return found


def link_weights(stored, weight, epsilon, exponent):
    """Give the weights (H, W, 4) of one reweighting; those of links that lead outside are zero."""
    links = np.zeros((*stored.shape[:2], 4))
    for y, x, k, yy, xx in links_inside(*stored.shape[:2]):
        m = np.mean((stored[yy, xx].astype(np.float64) - stored[y, x]) ** 2) + epsilon**2
        links[y, x, k] = weight * (1 if k < 2 else 0.5) * m ** (exponent / 2 - 1)
    return links


def sparse_energy(stored, weight, epsilon, exponent):
    """Give the hyper-Laplacian energy of which one reweighting takes the gradient."""
    total = 0.0
    for y, x, k, yy, xx in links_inside(*stored.shape[:2]):
        m = np.mean((stored[yy, xx] - stored[y, x]) ** 2) + epsilon**2
        total += weight * (1 if k < 2 else 0.5) * 3 / exponent * m ** (exponent / 2)
    return total


def prior_energy(u, links, scale):
    """Give 1/2 sum of weight (u(x) - u(neighbour))^2 / slope^2 over the links and channels."""
    total = 0.0
    for y, x, k, yy, xx in links_inside(*u.shape[:2]):
        steep = np.maximum(scale[y, x], scale[yy, xx])
        total += 0.5 * links[y, x, k] * np.sum((u[y, x] - u[yy, xx]) ** 2 / steep)
    return total


def prior_matrix(links, scale):
    """Give the matrix (n, n) of prior_energy, n = H W C: its value is u' P u / 2."""
    shape = scale.shape
    matrix = np.zeros((scale.size, scale.size))
    for y, x, k, yy, xx in links_inside(*shape[:2]):
        for c in range(shape[2]):
            d = np.zeros(shape)
            d[y, x, c], d[yy, xx, c] = 1, -1
            d = d.ravel()
            matrix += links[y, x, k] / max(scale[y, x, c], scale[yy, xx, c]) * np.outer(d, d)
    return matrix


def templates(bins, us, v):
    """Give log-spectra (n, len(us)) of straight blurs (u, v), each sinc by itself."""
    fy, fx = np.meshgrid(np.fft.fftfreq(PATCH), np.fft.rfftfreq(PATCH), indexing='ij')
    spectra = np.sinc(fx[None] * us[:, None, None] + fy[None] * v) ** 2
    # The half spectrum is continued by its mirror image: S(-f) = S(f).
    left = np.roll(spectra[:, ::-1, 1:2], 1, axis=1)
    wide = np.concatenate([left, spectra, spectra[:, :, -2:-1]], 2)
    wide = (wide[:, :, :-2] + 4 * wide[:, :, 1:-1] + wide[:, :, 2:]) / 6
    wide = (np.roll(wide, 1, 1) + 4 * wide + np.roll(wide, -1, 1)) / 6
    return np.log(wide + FLOOR).reshape(len(us), -1)[:, bins].T


def score(q, evidence, even):
    """Give S of a motion with scipy's look-up of C and D."""
    c, d = 0.0, even
    for b, flow in enumerate(np.float64(evidence.flow_of_q) @ q):
        u, v = -flow if flow[1] < 0 else flow
        if abs(u) >= REACH or v >= REACH:
            d += evidence.weight[b]
            continue
        at = [[v], [u + REACH]]
        c += evidence.weight[b] * map_coordinates(np.float64(evidence.match[b]), at, order=1)[0]
        energy = map_coordinates(np.float64(evidence.energy), at, order=1)[0]
        along, down = evidence.sag[int(v), int(u + REACH)]
        energy -= u % 1 * (1 - u % 1) * along + v % 1 * (1 - v % 1) * down
        d += evidence.weight[b] * energy
    return -c / np.sqrt(d)
