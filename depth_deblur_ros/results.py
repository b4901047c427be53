"""
What is said about one frame: the messages on the result topics, and the record in the JSON files.

Topics are relative and messages are nested fields, so that the bag and the live node share them.
A twist is the camera's own velocity: minus the motion, over the exposure.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    DeblurResult,
    FloatImage,
    Motion,
    Outcome,
    Vector,
)
from depth_deblur_ros.messages import camera_info_fields, depth_fields, Fields, image_fields
import numpy as np
import numpy.typing as npt

IMAGE = 'deblurred/image'
COMPRESSED = f'{IMAGE}/compressed'
CAMERA_INFO = 'deblurred/camera_info'
DEPTH = 'deblurred/depth'
MOTION = 'motion'
MOTION_WITH_COVARIANCE = 'motion_with_covariance'
DISPLACEMENT = 'displacement'
RESULT = 'result'
TYPES = {
    IMAGE: 'sensor_msgs/msg/Image',
    CAMERA_INFO: 'sensor_msgs/msg/CameraInfo',
    DEPTH: 'sensor_msgs/msg/Image',
    MOTION: 'geometry_msgs/msg/TwistStamped',
    MOTION_WITH_COVARIANCE: 'geometry_msgs/msg/TwistWithCovarianceStamped',
    DISPLACEMENT: 'geometry_msgs/msg/TwistStamped',
    RESULT: 'diagnostic_msgs/msg/DiagnosticStatus',
}
LIVE_TYPES = {**TYPES, COMPRESSED: 'sensor_msgs/msg/CompressedImage'}

# (m/s)^2, (rad/s)^2 of a frame without a motion to trust: as good as nothing, but a number.
UNKNOWN_VARIANCE = 1e6
_OK, _WARN, _ERROR = 0, 1, 2
_LINEAR_FIRST = [3, 4, 5, 0, 1, 2]  # ROS says linear, angular; Motion says theta, v


def result_messages(
    result: DeblurResult,
    camera: CameraIntrinsics | None,
    exposure: float | None,
    header: Fields,
    reason: str = '',
    *,
    doubt: float = 0.0,
) -> Iterator[tuple[str, Fields]]:
    """
    Give topic and fields of every message that may be sent about a frame.

    reason says why a frame could not be solved at all; of its image, depth and camera, only those
    that could be read are sent. doubt is the relative standard deviation of the exposure.
    """
    motion = result.motion
    if result.image.size:
        yield IMAGE, image_fields(result.image, header)
    if camera is not None:
        yield CAMERA_INFO, camera_info_fields(camera, header)
    if result.depth.size:
        yield DEPTH, depth_fields(result.depth, header)
    if exposure is not None:
        if result.sign_resolved and result.outcome is not Outcome.FAILED:
            yield MOTION, _twist_stamped(motion, exposure, header)
        yield MOTION_WITH_COVARIANCE, _twist_with_covariance(result, exposure, header, doubt)
    yield DISPLACEMENT, _twist_stamped(motion, 1.0, header)
    yield RESULT, _status(result, exposure, header, reason)


def refused_result(image: FloatImage | None, depth: FloatImage | None) -> DeblurResult:
    """Give the result of a frame that the solver did not take, with what of it could be read."""
    nothing = np.zeros((0, 0), np.float32)
    return DeblurResult(
        image=nothing if image is None else image,
        depth=nothing if depth is None else depth,
        motion=Motion(np.zeros(3), np.zeros(3)),
        outcome=Outcome.FAILED,
        sign_resolved=False,
        quality=0.0,
        blur_px=0.0,
        seconds=0.0,
    )


def motion_record(result: DeblurResult, stamp_ns: int, exposure: float | None) -> dict[str, Any]:
    """
    Give what stands in motion.json, and in one line of an estimates file.

    energies stands there only where the method has some.
    """
    record = {
        'stamp': stamp_ns / 1_000_000_000,  # of whole numbers: rounded once
        'theta': result.motion.theta.tolist(),
        'v': result.motion.v.tolist(),
        'covariance': result.motion.covariance.ravel().tolist(),
        'exposure': exposure,
        'sign_resolved': bool(result.sign_resolved),
        'outcome': result.outcome.value,
        'quality': float(result.quality),
        'blur_px': float(result.blur_px),
        'seconds': float(result.seconds),
    }
    if result.energies:
        record['energies'] = [
            {'level': e.level, 'step': e.step, 'terms': dict(e.terms)} for e in result.energies
        ]
    return record


def twist_covariance(
    result: DeblurResult, exposure: float, doubt: float = 0.0
) -> npt.NDArray[np.float64]:
    """
    Give the (6, 6) covariance of the camera's velocity, in the order linear, angular.

    Where the sign is open, the mean is zero and p p' + P is the second moment about it. The
    exposure's relative standard deviation, doubt, adds doubt^2 p p'.
    """
    if result.outcome is Outcome.FAILED:
        return UNKNOWN_VARIANCE * np.eye(6)
    p = result.motion.vector
    spread = result.motion.covariance + doubt**2 * np.outer(p, p)
    if not result.sign_resolved:
        spread = spread + np.outer(p, p)
    swapped = spread[np.ix_(_LINEAR_FIRST, _LINEAR_FIRST)] / exposure**2
    return (swapped + swapped.T) / 2


def _twist_with_covariance(
    result: DeblurResult, exposure: float, header: Fields, doubt: float
) -> Fields:
    zero = np.zeros(3)
    known = result.sign_resolved and result.outcome is not Outcome.FAILED
    motion = result.motion if known else Motion(zero, zero)
    covariance = twist_covariance(result, exposure, doubt).ravel().tolist()
    twist = {'twist': _twist(motion, exposure), 'covariance': covariance}
    return {'header': header, 'twist': twist}


def _twist_stamped(motion: Motion, duration: float, header: Fields) -> Fields:
    return {'header': header, 'twist': _twist(motion, duration)}


def _twist(motion: Motion, duration: float) -> Fields:
    return {'linear': _xyz(motion.v, duration), 'angular': _xyz(motion.theta, duration)}


def _xyz(vector: Vector, duration: float) -> Fields:
    # 0.0 - x, not -x: no message shows a motion of -0.0.
    return {name: 0.0 - float(x) / duration for name, x in zip('xyz', vector, strict=True)}


def _status(result: DeblurResult, exposure: float | None, header: Fields, reason: str) -> Fields:
    """Give the DiagnosticStatus; reason says why the frame could not be solved at all."""
    failed = result.outcome is Outcome.FAILED
    stamp = header['stamp']
    values = {
        'outcome': result.outcome.value,
        'quality': f'{result.quality:.6g}',
        'sign_resolved': str(bool(result.sign_resolved)).lower(),
        'blur_px': f'{result.blur_px:.6g}',
        'seconds': f'{result.seconds:.6g}',
        'stamp': f'{stamp["sec"]}.{stamp["nanosec"]:09d}',
    }
    if exposure is not None:
        values['exposure'] = f'{exposure:.9g}'
    return {
        'level': _ERROR if reason else _WARN if failed else _OK,
        'name': 'depth_deblur',
        'message': reason or ('no motion to trust' if failed else result.outcome.value),
        'hardware_id': header['frame_id'],
        'values': [{'key': key, 'value': value} for key, value in values.items()],
    }
