"""The grid that JPEG leaves: found with its strength, and not where there is none."""

import cv2
from depth_deblur_ros.core.compression import block_sigma
import numpy as np
from pictures import swept, texture
import pytest


def stored(quality=None, shift=0):
    """Give a blurred picture (H, W, 3), as JPEG keeps it, without its first rows and columns."""
    grey = np.rint(255 * swept(texture(1), 12, 0.4)).astype(np.uint8)
    picture = np.repeat(grey[..., None], 3, 2)
    if quality:
        data = cv2.imencode('.jpg', picture, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        picture = cv2.imdecode(data, cv2.IMREAD_COLOR)
    return picture[shift:, shift:].astype(np.float32) / 255


@pytest.mark.parametrize('shift', [0, 3])
@pytest.mark.parametrize('quality', [40, 60])
def test_what_jpeg_took_is_estimated_wherever_its_grid_begins(quality, shift):
    found = stored(quality, shift)
    taken = float((found - stored(None, shift)).std())
    assert 0.5 < block_sigma(found) / taken < 2.5  # more where fine texture was taken


@pytest.mark.parametrize('noise', [0, 0.01])
def test_without_jpeg_there_is_no_grid(noise):
    picture = stored()
    picture = picture + noise * np.random.default_rng(0).standard_normal(picture.shape)
    assert block_sigma(picture.astype(np.float32)) == 0


def test_lines_of_the_scene_are_no_grid():
    picture = stored()
    picture[100:, 152:] = 0.9  # at borders of blocks
    assert block_sigma(picture) == 0


def test_a_tiny_picture_shows_no_grid():
    assert block_sigma(np.zeros((40, 400, 3), np.float32)) == 0
