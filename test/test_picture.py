"""What a picture claims of itself is checked before its memory is asked for."""

import base64
import resource
import time

import cv2
from depth_deblur_ros.core.data import InputError
from depth_deblur_ros.picture import check_picture
import numpy as np
import pytest

GREY = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)
RGB = np.stack([GREY] * 3, axis=-1)
# Found by fuzzing: 149 bytes for which OpenCV takes 3.5 GB and 16 s.
BOMB = base64.b64decode(
    'iVBORw0KGgoAAAANSUhEUgAAAEAAAAAwCAAAAACEICPD1AAAXElEQVRIDaXBAQEAAAjCMN+MaEQjmiG+cUhBKtKQ'
    'DilIRRrSIQWpSEM6pCAVaUiHFKQiDemQglSkIR1SkIo0pEMKUpGGdEhBKtKQDilIRRrSIQWpSEM6pCAVaTgPTvse'
    'AQHCPe8AAAAASUVORK5CYII='
)


@pytest.mark.parametrize('image', [GREY, RGB, GREY.astype(np.uint16)], ids=['8', 'rgb', '16'])
@pytest.mark.parametrize(
    ('kind', 'flags'),
    [
        ('.png', []),
        ('.jpg', []),
        ('.jpg', [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        ('.jpg', [cv2.IMWRITE_JPEG_RST_INTERVAL, 1]),
    ],
)
def test_pictures_that_are_sound_pass(image, kind, flags):
    if kind == '.jpg':
        image = image.astype(np.uint8)
    check_picture(cv2.imencode(kind, image, flags)[1].tobytes())


def test_a_few_bytes_cannot_ask_for_gigabytes():
    before, begin = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    with pytest.raises(InputError, match=r'149 bytes of PNG cannot be decoded: \d+ are needed'):
        check_picture(BOMB)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 50_000  # kB
    assert time.monotonic() - begin < 1


@pytest.mark.parametrize('kind', ['.png', '.jpg'])
def test_a_picture_that_claims_a_huge_size_is_refused(kind):
    data = bytearray(cv2.imencode(kind, GREY)[1].tobytes())
    if kind == '.png':
        data[16:24] = (16384).to_bytes(4, 'big') * 2
    else:
        at = data.index(b'\xff\xc0')
        data[at + 5 : at + 9] = (16384).to_bytes(2, 'big') * 2
    with pytest.raises(InputError, match=r'16384x16384 is not within 1 and 64000000 pixels'):
        check_picture(bytes(data))


@pytest.mark.parametrize('kind', ['.png', '.jpg'])
def test_a_picture_without_its_beginning_is_refused(kind):
    data = cv2.imencode(kind, RGB)[1].tobytes()
    for length in range(20):
        with pytest.raises(InputError, match='cannot be decoded'):
            check_picture(data[:length])
    with pytest.raises(InputError, match='neither PNG nor JPEG'):
        check_picture(data[3:])


def test_a_png_without_its_end_is_refused():
    data = cv2.imencode('.png', RGB)[1].tobytes()
    for length in range(8, len(data) - 4, 7):
        with pytest.raises(InputError, match='cannot be decoded'):
            check_picture(data[:length])
