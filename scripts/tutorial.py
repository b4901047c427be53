"""
Walk through the Python API on the sample bag, from reading a frame to the page of a run.

usage: python scripts/tutorial.py FOLDER [--bag BAG]; pictures, a bag and a page go into FOLDER.
Each step is one function; read them from top to bottom. docs/python.md tells more of each name.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path

from depth_deblur_ros import deblur, DeblurResult, Outcome, RgbdFrame, SolverParams
from depth_deblur_ros.bag import BagReader, decoded
from depth_deblur_ros.core.sequence import sharp_sequence
from depth_deblur_ros.folders import write_image, write_json, write_text, write_video
from depth_deblur_ros.frames import frame_from_pair
from depth_deblur_ros.page import run_page
from depth_deblur_ros.recording import choose_topics, PairReader
from depth_deblur_ros.replay import replay
from depth_deblur_ros.report import draw_frame
from depth_deblur_ros.results import motion_record
from depth_deblur_ros.review import review, TWIST_TOPIC
from depth_deblur_ros.tracking import Tracker
import numpy as np

SAMPLE = Path(__file__).resolve().parents[1] / 'bags/sample'
FRAMES = 4  # the first of the bag, for the steps that solve
SLOP_NS = 20_000_000  # colour and depth of a pair are at most so far apart


def read_frames(bag: Path) -> Iterator[RgbdFrame]:
    """Step 1: frames out of a recording; topics are found, colour and depth paired by stamp."""
    with BagReader(bag) as reader:
        topics = choose_topics(reader, {}, with_info=True)
        for pair in PairReader(reader, topics, SLOP_NS).pairs(0, None):
            yield frame_from_pair(pair)


def deblur_one(frame: RgbdFrame, folder: Path) -> DeblurResult:
    """Step 2: the motion in one blurred image, and the sharp image."""
    result = deblur(frame, SolverParams(mode='fast'))
    print(f'one frame: {result.outcome.value}, blurred over {result.blur_px:.1f} px')
    write_image(folder / 'sharp.png', result.image)
    write_image(folder / 'panels.png', draw_frame(frame, result))
    write_json(folder / 'motion.json', motion_record(result, frame.stamp_ns, frame.exposure))
    return result


def look_inside(frame: RgbdFrame, result: DeblurResult, folder: Path) -> None:
    """Step 3: how sure the motion is, and the sharp views that the exposure averaged."""
    sure = np.sqrt(np.diag(result.motion.covariance))
    for name, values, spread in (
        ('theta [rad]', result.motion.theta, sure[:3]),
        ('v [m]', result.motion.v, sure[3:]),
    ):
        pairs = zip(values, spread, strict=True)
        print(f'  {name}:', ', '.join(f'{v:+.4f} +- {s:.4f}' for v, s in pairs))
    views = sharp_sequence(result.image, result.depth, result.motion, frame.camera, 9)
    write_video(folder / 'during_the_exposure.mp4', views)


def follow(frames: list[RgbdFrame]) -> None:
    """Step 4: the frames around one tell forwards from backwards, so that there is a velocity."""
    tracker, params = Tracker(), SolverParams(mode='motion')
    for frame, following in zip(frames, [*frames[1:], None], strict=True):
        tracked = tracker.follow(frame, params, following)
        result, exposure = tracked.result, tracked.exposure
        if result.outcome is Outcome.SOLVED and result.sign_resolved and exposure:
            velocity = -result.motion.v / exposure.seconds  # the camera moves, the scene stands
            print(f'  at {frame.stamp_ns / 1e9:.3f} s: camera {np.round(velocity, 2)} m/s')


def whole_recording(bag: Path, folder: Path) -> float:
    """Step 5: all of it: another bag, one page to look at; give the median error of the speed."""
    out = folder / 'bag'
    summary = replay(bag, out, params=SolverParams(mode='motion'), overwrite=True)
    print(f'the bag: {summary}')
    write_text(folder / 'bag.html', run_page(review(bag, out)))
    found, truth = velocities(out, '/motion'), velocities(bag, TWIST_TOPIC)
    return float(np.median([np.linalg.norm(found[t] - truth[t]) for t in found if t in truth]))


def velocities(bag: Path, topic: str) -> dict[int, np.ndarray]:
    """Read the linear velocities [m/s] of a topic of TwistStamped, by log time [ns]."""
    with BagReader(bag) as reader:
        messages = [(m.log_ns, decoded(m).twist.linear) for m in reader.messages({topic})]
    return {log: np.array([v.x, v.y, v.z]) for log, v in messages}


def main() -> None:
    """Go through the steps."""
    parser = argparse.ArgumentParser(description='Walk through the Python API.')
    parser.add_argument('folder', type=Path)
    parser.add_argument('--bag', type=Path, default=SAMPLE)
    args = parser.parse_args()
    frames = [frame for _, frame in zip(range(FRAMES), read_frames(args.bag), strict=False)]
    print(f'{len(frames)} frames of {frames[0].camera.width}x{frames[0].camera.height}')
    result = deblur_one(frames[-1], args.folder)
    look_inside(frames[-1], result, args.folder)
    follow(frames)
    error = whole_recording(args.bag, args.folder)
    print(f'error of the velocity against the truth of the bag, median: {error:.3f} m/s')


if __name__ == '__main__':
    main()
