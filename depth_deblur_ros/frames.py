"""
From a pair of messages to what the solver takes, and to what it says: shared by bags and topics.

Images with distortion are undistorted first; the frame's camera is then one without.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
import traceback
from typing import Any

from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    DeblurResult,
    FloatImage,
    InputError,
    RgbdFrame,
)
from depth_deblur_ros.core.lens import undistorted
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.messages import (
    camera_from_msg,
    depth_from_msg,
    Fields,
    header_fields,
    image_from_msg,
    stamp_ns,
)
from depth_deblur_ros.results import refused_result, result_messages
from depth_deblur_ros.tracking import Tracker


@dataclass(frozen=True, eq=False)
class Pair:
    """A colour message, its depth message, and what was known when it came; log time [ns]."""

    colour: Any
    depth: Any
    info: Any
    exposure: float | None
    log_ns: int


@dataclass(frozen=True)
class Given:
    """
    What is known of the images beside their messages.

    camera counts more than camera_info, exposure_s less than an exposure topic; rectified says
    that camera_info's distortion has been undone; transfer is that of CameraIntrinsics.
    """

    camera: CameraIntrinsics | None = None
    exposure_s: float | None = None
    rectified: bool = True
    transfer: str = 'srgb'


@dataclass(frozen=True, eq=False)
class SolvedPair:
    """
    A pair with its result.

    reason says why the solver did not take it, trace where it broke down; frame is what it took,
    with the exposure, told or tracked; doubt is that exposure's relative standard deviation.
    """

    pair: Pair
    frame: RgbdFrame | None
    result: DeblurResult
    reason: str = ''
    trace: str = ''
    doubt: float = 0.0

    def messages(self) -> list[tuple[str, Fields]]:
        """Give topic and fields of the messages about this pair, with its colour's header."""
        source = self.pair.colour.header
        header = header_fields(stamp_ns(source), source.frame_id)
        camera = self.frame.camera if self.frame else None
        exposure = self.frame.exposure if self.frame else None
        found = result_messages(
            self.result, camera, exposure, header, self.reason, doubt=self.doubt
        )
        return list(found)


def solve_pair(
    pair: Pair, given: Given, params: SolverParams, tracker: Tracker, following: Pair | None = None
) -> SolvedPair:
    """
    Solve one pair; what cannot be solved is failed, with the reason and its image as it was.

    following: the next pair, where it is there already.
    """
    frame = None
    try:
        frame = frame_from_pair(pair, given)
        tracked = tracker.follow(frame, params, _frame_if_any(following, given))
        exposure = tracked.exposure
        if exposure is None:
            return SolvedPair(pair, frame, tracked.result)
        frame = replace(frame, exposure=exposure.seconds)
        return SolvedPair(pair, frame, tracked.result, doubt=exposure.doubt)
    except InputError as error:
        image, depth = (frame.image, frame.depth) if frame else (_image(pair.colour), None)
        return SolvedPair(pair, frame, refused_result(image, depth), str(error))


def solve_anyhow(
    pair: Pair, given: Given, params: SolverParams, tracker: Tracker, following: Pair | None = None
) -> SolvedPair:
    """Solve one pair as solve_pair does; a solver that breaks down has failed, too."""
    try:
        return solve_pair(pair, given, params, tracker, following)
    except Exception as error:
        reason = f'the solver broke down: {type(error).__name__}: {error}'
        result = refused_result(_image(pair.colour), None)
        return SolvedPair(pair, None, result, reason, traceback.format_exc())


def _frame_if_any(pair: Pair | None, given: Given) -> RgbdFrame | None:
    try:
        return frame_from_pair(pair, given) if pair else None
    except InputError:
        return None


def frame_from_pair(pair: Pair, given: Given | None = None) -> RgbdFrame:
    """Read a pair of messages."""
    given = given or Given()
    if pair.info is None and given.camera is None:
        raise InputError('no camera_info has come yet')
    frame = RgbdFrame(
        image=image_from_msg(pair.colour),
        depth=depth_from_msg(pair.depth),
        camera=given.camera or camera_from_msg(pair.info, given.transfer, given.rectified),
        exposure=given.exposure_s if pair.exposure is None else pair.exposure,
        stamp_ns=stamp_ns(pair.colour.header),
    )
    return undistorted(frame)


def _image(msg: Any) -> FloatImage | None:
    try:
        return image_from_msg(msg)
    except InputError:
        return None
