"""What is said about a frame: signs, blocks, and what may not be said."""

from dataclasses import replace
import json

from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    DeblurResult,
    EnergyStep,
    Motion,
    Outcome,
)
from depth_deblur_ros.messages import header_fields
from depth_deblur_ros.results import (
    CAMERA_INFO,
    DEPTH,
    DISPLACEMENT,
    IMAGE,
    MOTION,
    motion_record,
    MOTION_WITH_COVARIANCE,
    refused_result,
    RESULT,
    result_messages,
    twist_covariance,
    TYPES,
)
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
import numpy as np
import pytest

HEADER = header_fields(1_305_031_231_096_775_000, 'camera')
CAMERA = CameraIntrinsics(500, 500, 31.5, 23.5, 64, 48)
numbers = st.floats(-1, 1)
vectors = hnp.arrays(np.float64, 6, elements=numbers)
factors = hnp.arrays(np.float64, (6, 6), elements=numbers)


def result(p=range(1, 7), covariance=None, outcome=Outcome.SOLVED, sign=True):
    return DeblurResult(
        image=np.full((48, 64, 3), 0.5, np.float32),
        depth=np.full((48, 64), 2, np.float32),
        motion=Motion.from_vector(p, covariance),
        outcome=outcome,
        sign_resolved=sign,
        quality=0.75,
        blur_px=5.5,
        seconds=1.25,
    )


def said(result, exposure=0.5, **more):
    return dict(result_messages(result, CAMERA, exposure, HEADER, **more))


def xyz(fields):
    return [fields['x'], fields['y'], fields['z']]


def test_the_twist_is_the_cameras_own_velocity():
    twist = said(result())[MOTION]['twist']
    assert xyz(twist['angular']) == [-2, -4, -6]
    assert xyz(twist['linear']) == [-8, -10, -12]


def test_the_displacement_needs_no_exposure_and_no_sign():
    messages = said(result(sign=False), exposure=None)
    assert set(messages) == {IMAGE, CAMERA_INFO, DEPTH, DISPLACEMENT, RESULT}
    twist = messages[DISPLACEMENT]['twist']
    assert xyz(twist['angular']) == [-1, -2, -3]
    assert xyz(twist['linear']) == [-4, -5, -6]


@pytest.mark.parametrize(
    ('outcome', 'sign', 'exposure', 'motion', 'with_covariance'),
    [
        (Outcome.SOLVED, True, 0.5, True, True),
        (Outcome.SOLVED, False, 0.5, False, True),
        (Outcome.SOLVED, True, None, False, False),
        (Outcome.FAILED, True, 0.5, False, True),
        (Outcome.SHARP, True, 0.5, True, True),
    ],
)
def test_a_twist_is_sent_only_where_it_is_known(outcome, sign, exposure, motion, with_covariance):
    messages = said(result(outcome=outcome, sign=sign), exposure)
    assert (MOTION in messages) == motion
    assert (MOTION_WITH_COVARIANCE in messages) == with_covariance
    assert set(messages) <= set(TYPES)


def test_the_blocks_of_the_covariance_are_swapped():
    p = np.diag([1.0, 2, 3, 4, 5, 6])
    p[0, 3] = p[3, 0] = 0.5  # theta x with v x
    swapped = twist_covariance(result(covariance=p), 0.5)
    assert np.diag(swapped).tolist() == [16, 20, 24, 4, 8, 12]
    assert swapped[3, 0] == swapped[0, 3] == 2


@given(p=vectors, factor=factors, exposure=st.floats(1e-3, 1))
def test_an_open_sign_widens_the_covariance_by_the_motion(p, factor, exposure):
    spread = factor @ factor.T
    known = twist_covariance(result(p, spread), exposure)
    open_ = twist_covariance(result(p, spread, sign=False), exposure)
    twist = -np.r_[p[3:], p[:3]] / exposure
    np.testing.assert_allclose(open_ - known, np.outer(twist, twist), atol=1e-9 / exposure**2)
    np.testing.assert_array_equal(open_, open_.T)
    assert np.linalg.eigvalsh(open_).min() > -1e-9 / exposure**2


def test_an_open_sign_has_mean_zero():
    twist = said(result(sign=False))[MOTION_WITH_COVARIANCE]['twist']
    assert xyz(twist['twist']['linear']) == xyz(twist['twist']['angular']) == [0, 0, 0]
    assert len(twist['covariance']) == 36


def test_a_failed_frame_claims_no_still_camera():
    failed = said(result(np.zeros(6), outcome=Outcome.FAILED))[MOTION_WITH_COVARIANCE]['twist']
    assert np.diag(np.reshape(failed['covariance'], (6, 6))).min() >= 1e6


@pytest.mark.parametrize(
    ('outcome', 'reason', 'level'),
    [
        (Outcome.SOLVED, '', 0),
        (Outcome.SHARP, '', 0),
        (Outcome.FAILED, '', 1),
        (Outcome.FAILED, 'all depth is missing', 2),
    ],
)
def test_the_status_says_what_became_of_the_frame(outcome, reason, level):
    status = said(result(outcome=outcome), reason=reason)[RESULT]
    assert status['level'] == level
    assert reason in status['message']
    values = {entry['key']: entry['value'] for entry in status['values']}
    assert values == {
        'outcome': outcome.value,
        'quality': '0.75',
        'sign_resolved': 'true',
        'blur_px': '5.5',
        'seconds': '1.25',
        'stamp': '1305031231.096775000',
        'exposure': '0.5',
    }
    unknown = said(result(), exposure=None)[RESULT]['values']
    assert 'exposure' not in {entry['key'] for entry in unknown}


def test_a_frame_that_could_not_be_read_sends_no_picture():
    messages = dict(result_messages(refused_result(None, None), None, None, HEADER, 'broken'))
    assert set(messages) == {DISPLACEMENT, RESULT}


def test_the_record_keeps_the_stamp_to_the_microsecond():
    record = motion_record(result(), 1_305_031_231_096_775_000, None)
    assert repr(record['stamp']) == '1305031231.096775'
    assert record['theta'] == [1, 2, 3]
    assert record['v'] == [4, 5, 6]
    assert len(record['covariance']) == 36
    assert record['exposure'] is None
    assert (record['outcome'], record['sign_resolved'], record['blur_px']) == ('solved', True, 5.5)


def test_energies_stand_in_the_record_of_the_method_that_has_them():
    assert 'energies' not in motion_record(result(), 0, None)
    steps = (EnergyStep(3, 'before turn 1', {'intensities': 2.0, 'motion': -1.0}),)
    record = motion_record(replace(result(), energies=steps), 0, None)
    assert json.loads(json.dumps(record))['energies'] == [
        {'level': 3, 'step': 'before turn 1', 'terms': {'intensities': 2.0, 'motion': -1.0}}
    ]
