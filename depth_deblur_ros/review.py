"""
A replayed bag read back: what the results say, with the pictures and the truth of the bag before.

The truth is a velocity on TWIST_TOPIC, or follows from the poses of the colour camera on
POSE_TOPIC; a stamp is taken for the middle of its exposure.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import replace
import json
from pathlib import Path
from typing import Any

from depth_deblur_ros.bag import BagReader, decoded
from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    DeblurResult,
    EnergyStep,
    InputError,
    Motion,
    Outcome,
    Vector,
)
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.frames import frame_from_pair, Given
from depth_deblur_ros.messages import depth_from_msg, image_from_msg, stamp_ns
from depth_deblur_ros.notes import Note, Run, shot_of, spread_evenly
from depth_deblur_ros.recording import choose_topics, PairReader
from depth_deblur_ros.results import DEPTH, DISPLACEMENT, IMAGE, MOTION_WITH_COVARIANCE, RESULT
import numpy as np
from scipy.spatial.transform import Rotation, Slerp

TWIST_TOPIC, POSE_TOPIC = '/ground_truth/motion', '/ground_truth/pose'
SHORTEST_BASE = 0.02  # s between the two poses of a velocity
WIDEST_GAP = 0.2  # s between recorded poses, over which nothing is said
DEFAULTS = SolverParams()
ERROR = 2  # level of a DiagnosticStatus: the solver did not take the frame


def review(
    bag: Path,
    out: Path,
    *,
    camera: CameraIntrinsics | None = None,
    topics: Mapping[str, str] | None = None,
    estimates: Path | None = None,
    lost: Mapping[str, int] | None = None,
    slop_s: float = 0.02,
    params: SolverParams = DEFAULTS,
) -> Run:
    """
    Read what a replay of `bag` left in `out`.

    camera, topics and params as replay took them; estimates, its file of that name, adds the
    energies; lost counts the colour frames without a pair, as replay does (default: those between
    the first result and the last).
    """
    with BagReader(out) as results:
        notes = _notes(results)
        able = [log for log, note in notes.items() if not note.reason]
        chosen = {able[k]: notes[able[k]] for k in spread_evenly(len(able))}
        images = dict(_images(results, chosen))
    ordered = sorted(notes.values(), key=lambda note: note.stamp_ns)
    if estimates:
        ordered = list(_with_energies(ordered, estimates))
    with BagReader(bag) as source:
        names = choose_topics(source, topics or {}, with_info=camera is None)
        pairs = PairReader(source, names, round(slop_s * 1e9))
        shots = []
        for pair in pairs.pairs(min(notes), max(notes) + round(slop_s * 1e9) + 1):
            if pair.log_ns in images:
                frame = frame_from_pair(pair, Given(camera, rectified=params.rectified))
                image, depth = images.pop(pair.log_ns)
                result = _result(chosen[pair.log_ns], image, depth)
                shots.append(shot_of(frame, result, params.prior))
        truth = _true_twists(source, ordered)
    return Run(
        Path(bag).name, ordered, shots, truth, dict(pairs.dropped if lost is None else lost)
    )


def _notes(results: BagReader) -> dict[int, Note]:
    """Give the notes by log time, in its order."""
    if f'/{RESULT}' not in results.topics:
        raise InputError(f'{results.path} is no output of replay: it has no topic /{RESULT}')
    told: dict[int, dict[str, Any]] = {}
    for message in results.messages({f'/{t}' for t in (RESULT, DISPLACEMENT)}):
        told.setdefault(message.log_ns, {})[message.topic.name] = decoded(message)
    notes = {
        log: _note(both[f'/{RESULT}'], both[f'/{DISPLACEMENT}'])
        for log, both in told.items()
        if len(both) == 2
    }
    if not notes:
        raise InputError(f'{results.path} holds no result')
    for message in results.messages({f'/{MOTION_WITH_COVARIANCE}'}):
        if message.log_ns in notes:
            notes[message.log_ns] = _with_deviation(notes[message.log_ns], decoded(message))
    return notes


def _note(status: Any, displacement: Any) -> Note:
    values = {entry.key: entry.value for entry in status.values}
    return Note(
        stamp_ns=stamp_ns(displacement.header),
        outcome=Outcome(values['outcome']),
        p=-_six(displacement.twist),
        deviation=np.full(6, np.nan),
        exposure=float(values['exposure']) if 'exposure' in values else None,
        sign_resolved=values['sign_resolved'] == 'true',
        quality=float(values['quality']),
        blur_px=float(values['blur_px']),
        seconds=float(values['seconds']),
        reason=status.message if ord(_byte(status.level)) == ERROR else '',
    )


def _byte(value: Any) -> bytes:
    return value if isinstance(value, bytes) else bytes([value])


def _six(twist: Any) -> Vector:
    """Give a twist message as (6,): angular, then linear."""
    return np.array([getattr(v, k) for v in (twist.angular, twist.linear) for k in 'xyz'])


def _with_deviation(note: Note, message: Any) -> Note:
    """Take the standard deviations out of a covariance, which spans both signs of an open one."""
    if note.exposure is None or note.outcome is Outcome.FAILED:
        return note
    linear_first = np.reshape(message.twist.covariance, (6, 6)).diagonal()
    variance = linear_first[[3, 4, 5, 0, 1, 2]] * note.exposure**2
    if not note.sign_resolved:
        variance = variance - note.p**2
    return replace(note, deviation=np.sqrt(np.maximum(variance, 0)))


def _images(results: BagReader, logs: Collection[int]) -> Iterator[tuple[int, tuple[Any, Any]]]:
    """Give the image and the depth messages at some log times."""
    found: dict[int, dict[str, Any]] = {}
    for message in results.messages({f'/{IMAGE}', f'/{DEPTH}'}):
        if message.log_ns in logs:
            both = found.setdefault(message.log_ns, {})
            both[message.topic.name] = decoded(message)
            if len(both) == 2:
                yield message.log_ns, (both[f'/{IMAGE}'], both[f'/{DEPTH}'])


def _result(note: Note, image: Any, depth: Any) -> DeblurResult:
    return DeblurResult(
        image=image_from_msg(image),
        depth=depth_from_msg(depth),
        motion=Motion.from_vector(note.p),
        outcome=note.outcome,
        sign_resolved=note.sign_resolved,
        quality=note.quality,
        blur_px=note.blur_px,
        seconds=note.seconds,
    )


def _with_energies(notes: list[Note], estimates: Path) -> Iterator[Note]:
    """Add the energies that the lines of an estimates file hold."""
    try:
        records = [json.loads(line) for line in Path(estimates).read_text().splitlines()]
        energies = {r['stamp']: r['energies'] for r in records if 'energies' in r}
        steps = {s: tuple(EnergyStep(**e) for e in many) for s, many in energies.items()}
    except OSError as error:
        raise InputError(f'cannot read {estimates}: {error.strerror}') from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f'{estimates} is no file of estimates: {error}') from error
    for note in notes:
        yield replace(note, energies=steps.get(note.stamp_ns / 1_000_000_000, ()))


def _true_twists(bag: BagReader, notes: list[Note]) -> dict[int, Vector]:
    """Give the true velocity (6,) [rad/s, m/s] at the notes' stamps, where the bag tells it."""
    wanted = {note.stamp_ns: note for note in notes}
    if getattr(bag.topics.get(TWIST_TOPIC), 'type', '') == 'geometry_msgs/msg/TwistStamped':
        said = map(decoded, bag.messages({TWIST_TOPIC}))
        truth = {stamp_ns(m.header): _six(m.twist) for m in said}
        return {stamp: twist for stamp, twist in truth.items() if stamp in wanted}
    if getattr(bag.topics.get(POSE_TOPIC), 'type', '') == 'geometry_msgs/msg/PoseStamped':
        poses = {stamp_ns(m.header): m.pose for m in map(decoded, bag.messages({POSE_TOPIC}))}
        return dict(_from_poses(dict(sorted(poses.items())), notes))
    return {}


def _from_poses(poses: Mapping[int, Any], notes: list[Note]) -> Iterator[tuple[int, Vector]]:
    """Give the velocities of a camera in its own frame from its poses in the world, by stamp."""
    if len(poses) < 2:
        return
    stamps = np.array(list(poses), np.int64)
    times = (stamps - stamps[0]) / 1e9
    places = np.array([[getattr(p.position, k) for k in 'xyz'] for p in poses.values()])
    turns = np.array([[getattr(p.orientation, k) for k in 'xyzw'] for p in poses.values()])
    turning = Slerp(times, Rotation.from_quat(turns))
    for note in notes:
        middle = (note.stamp_ns - int(stamps[0])) / 1e9
        span = max(note.exposure or 0.0, SHORTEST_BASE)
        ends = middle - span / 2, middle + span / 2
        near = np.searchsorted(times, ends, 'right')
        if near[0] == 0 or near[1] == len(times):
            continue
        if times[near[1]] - times[near[0] - 1] > span + 2 * WIDEST_GAP:
            continue
        first, mid, last = turning([ends[0], middle, ends[1]])
        moved = [np.interp(ends, times, places[:, k]) for k in range(3)]
        shift = mid.inv().apply(np.array([b - a for a, b in moved]))
        yield note.stamp_ns, np.r_[(first.inv() * last).as_rotvec(), shift] / span
