"""From a pair of messages to a frame and to what is said about it."""

from dataclasses import replace
from types import SimpleNamespace

import cv2
from depth_deblur_ros.core.data import CameraIntrinsics, InputError, Outcome, RgbdFrame
from depth_deblur_ros.core.geometry import flow
from depth_deblur_ros.core.lens import undistorted
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.core.solver import deblur
from depth_deblur_ros.frames import frame_from_pair, Given, Pair, solve_anyhow
from depth_deblur_ros.messages import camera_info_fields, depth_fields, header_fields, image_fields
from depth_deblur_ros.results import CAMERA_INFO, IMAGE, RESULT
from depth_deblur_ros.tracking import Tracker
import numpy as np
from pictures import swept, texture
import pytest

LENS = (0.26, -0.95, -0.005, 0.003, 1.16)
CAMERA = CameraIntrinsics(260.0, 258.0, 159.0, 127.0, 320, 240)
HEADER = header_fields(7, 'c')


def as_message(fields):
    """Give nested fields as an object."""
    return SimpleNamespace(
        **{k: as_message(v) if isinstance(v, dict) else v for k, v in fields.items()}
    )


def info_of(camera, **changes):
    roi = {'x_offset': 0, 'y_offset': 0, 'width': 0, 'height': 0}
    fields = {**camera_info_fields(camera, header_fields(0, 'c')), 'roi': roi}
    return as_message({**fields, 'binning_x': 0, 'binning_y': 0, **changes})


def pair_of(info, depth=None):
    header = header_fields(7, 'c')
    colour = as_message(image_fields(np.full((240, 320, 3), 0.5, np.float32), header))
    depth = np.full((240, 320), 2, np.float32) if depth is None else depth
    return Pair(colour, as_message(depth_fields(depth, header)), info, None, 0)


def test_a_rectified_image_ignores_the_lens():
    frame = frame_from_pair(pair_of(info_of(replace(CAMERA, distortion=LENS))))
    assert frame.camera == CAMERA


def test_a_straight_line_is_straight_again():
    lens = (0.3, 0.0, 0.002, 0.001)
    camera = replace(CAMERA, distortion=lens)
    k = np.array([[260.0, 0, 159], [0, 258, 127], [0, 0, 1]])
    across = np.linspace(-0.5, 0.5, 2000)
    line = np.stack([across, np.full(2000, -0.35), np.ones(2000)], 1)
    pixels = cv2.projectPoints(line, np.zeros(3), np.zeros(3), k, np.array(lens))[0][:, 0]
    image = np.zeros((240, 320), np.float32)
    for x, y in pixels:
        cv2.circle(image, (round(x * 16), round(y * 16)), 24, 1.0, -1, cv2.LINE_AA, 4)
    assert np.ptp(pixels[:, 1]) > 3  # it was bent
    frame = undistorted(RgbdFrame(image, np.ones((240, 320), np.float32), camera))
    inner = frame.image[:, 40:280]
    rows = np.arange(240)[:, None]
    centres = (rows * inner).sum(0) / inner.sum(0)
    # The drawing itself is good to half a pixel.
    np.testing.assert_allclose(centres, 127 - 0.35 * 258, atol=0.6)
    assert frame.camera == CAMERA


def as_taken(image, camera, how):
    """Give what a camera whose lens distorts takes of what a pinhole camera sees."""
    k = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    pixels = np.indices(image.shape[:2])[::-1].reshape(2, -1).T.astype(np.float64)
    lens = np.array(camera.distortion)
    seen = cv2.undistortPoints(pixels[:, None], k, lens, P=k)[:, 0].astype(np.float32)
    x, y = seen.T.reshape(2, *image.shape[:2])
    return cv2.remap(image, x, y, how, borderMode=cv2.BORDER_REPLICATE)


def test_what_a_distorting_lens_takes_is_solved_as_well_as_what_a_pinhole_takes():
    depth = np.full((240, 320), 2, np.float32)
    image = swept(texture(3), 11.0, 0.4)
    pinhole = deblur(RgbdFrame(image, depth, CAMERA), SolverParams(mode='motion'))
    camera = replace(CAMERA, distortion=LENS)
    taken = as_taken(image, camera, cv2.INTER_CUBIC).clip(0, 1)
    assert np.abs(taken - image).mean() > 0.02
    info = info_of(CAMERA, d=list(LENS), distortion_model='plumb_bob')
    pair = replace(pair_of(info, depth), colour=as_message(image_fields(taken, HEADER)))
    frame = frame_from_pair(pair, Given(rectified=False))
    for found in (frame, RgbdFrame(taken, depth, camera)):
        result = deblur(found, SolverParams(mode='motion'))
        one, other = (flow(m.motion.vector, depth, CAMERA) for m in (result, pinhole))
        off = min(np.linalg.norm(one - s * other, axis=-1).mean() for s in (1, -1))
        assert result.outcome is pinhole.outcome is Outcome.SOLVED
        assert off < 0.5


def test_undistorted_depth_is_never_mixed():
    depth = np.where(np.arange(320) < 160, np.float32(1), np.float32(3)) * np.ones((240, 1), 'f4')
    camera = replace(CAMERA, distortion=(0.3, 0.0, 0.0, 0.0))
    frame = undistorted(RgbdFrame(np.zeros((240, 320), np.float32), depth, camera))
    assert set(np.unique(frame.depth[np.isfinite(frame.depth)])) == {1, 3}
    assert np.isnan(frame.depth).any()  # what lies outside of the image taken


@pytest.mark.parametrize('model', ['plumb_bob', 'rational_polynomial'])
def test_k_and_d_count_where_the_image_is_as_taken(model):
    d = [*LENS, 0.1, 0.01, 0.002] if model == 'rational_polynomial' else list(LENS)
    info = info_of(CAMERA, d=d, distortion_model=model, p=[0.0] * 12)
    frame = frame_from_pair(pair_of(info), Given(rectified=False))
    assert frame.camera == CAMERA
    assert np.isnan(frame.depth).any()


def test_a_lens_that_cannot_be_undone_is_refused():
    info = info_of(CAMERA, d=[0.1] * 4, distortion_model='equidistant')
    with pytest.raises(InputError, match="distortion model 'equidistant' is not one of"):
        frame_from_pair(pair_of(info), Given(rectified=False))


def test_no_camera_info_is_no_frame_unless_the_camera_is_given():
    with pytest.raises(InputError, match='no camera_info has come yet'):
        frame_from_pair(pair_of(None))
    assert frame_from_pair(pair_of(None), Given(camera=CAMERA, exposure_s=0.1)).exposure == 0.1


def test_a_solver_that_breaks_down_lets_the_image_pass():
    def solve(frame, params):
        raise MemoryError('no more')

    solved = solve_anyhow(pair_of(info_of(CAMERA)), Given(), SolverParams(), Tracker(solve))
    assert solved.result.outcome is Outcome.FAILED
    assert solved.reason == 'the solver broke down: MemoryError: no more'
    assert 'Traceback' in solved.trace
    messages = dict(solved.messages())
    assert (messages[IMAGE]['data'] == 128).all()
    assert messages[RESULT]['message'] == solved.reason
    assert messages[IMAGE]['header'] == header_fields(7, 'c')


def test_a_frame_that_is_refused_says_what_could_be_read():
    pair = pair_of(info_of(CAMERA), depth=np.ones((24, 32), np.float32))
    solved = solve_anyhow(pair, Given(), SolverParams(), Tracker())
    messages = dict(solved.messages())
    assert IMAGE in messages and CAMERA_INFO not in messages
    assert solved.reason.startswith('depth is 32x24 but the image is 320x240')
