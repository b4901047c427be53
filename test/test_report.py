"""Pictures of frames: what they show, for every size and outcome."""

from dataclasses import replace

from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    DeblurResult,
    Motion,
    Outcome,
    RgbdFrame,
)
from depth_deblur_ros.report import draw_frame, summary
import numpy as np
import pytest


def frame_of(width=400, height=300, channels=3):
    rng = np.random.default_rng(0)
    size = (height, width, 3)[: 3 if channels == 3 else 2]
    depth = np.linspace(1, 3, height * width, dtype=np.float32).reshape(height, width).copy()
    depth[20:60, 20:60] = np.nan
    camera = CameraIntrinsics(width, width, width / 2, height / 2, width, height)
    return RgbdFrame(rng.random(size, np.float32), depth, camera, 0.02, 1_500_000_001)


def result_of(frame, outcome=Outcome.SOLVED, turn=0.05):
    motion = Motion([0, turn, 0], [0.01, 0, 0])
    filled = np.nan_to_num(frame.depth, nan=2.0)
    image = 1 - frame.image if outcome is Outcome.SOLVED else frame.image
    return DeblurResult(image, filled, motion, outcome, False, 0.8, 12.0, 3.0)


def test_the_panels_hold_the_images_as_they_are():
    frame = frame_of()
    picture = draw_frame(frame, result_of(frame))
    assert picture.dtype == np.uint8
    blurred, sharp = picture[30:330, 8:408], picture[30:330, 416:816]
    np.testing.assert_array_equal(blurred, np.rint(255 * frame.image))
    np.testing.assert_array_equal(sharp, np.rint(255 * (1 - frame.image)))


@pytest.mark.parametrize('size', [(32, 32), (1280, 720), (1194, 327), (640, 480), (48, 200)])
@pytest.mark.parametrize('channels', [1, 3])
def test_every_size_gives_panels_that_can_be_read(size, channels):
    frame = frame_of(*size, channels)
    height, width, _ = draw_frame(frame, result_of(frame)).shape
    panel = min(max(size[0], 360), 640)
    assert width == 3 * panel + 106
    assert height == 66 + round(panel / size[0] * size[1])


@pytest.mark.parametrize('outcome', Outcome)
def test_each_outcome_has_its_own_badge(outcome):
    frame = frame_of()
    badges = {o: draw_frame(frame, result_of(frame, o))[330:, :100].tobytes() for o in Outcome}
    assert len(set(badges.values())) == len(Outcome)
    assert outcome in badges


def test_the_paths_follow_the_motion_and_are_gone_without_one():
    frame = frame_of()
    plain, still, left, right = (
        draw_frame(frame, replace(result_of(frame), motion=Motion(theta, np.zeros(3))))
        for theta in ([0, 0, 0], [1e-6, 0, 0], [0, 0.05, 0], [0, -0.05, 0])
    )
    np.testing.assert_array_equal(still, plain)
    changed = (left != plain).any(axis=2)[30:330, 824:1224]
    assert 0.02 < changed.mean() < 0.5
    # A turn about y draws lines along x: a row that holds some is changed over a long stretch.
    assert changed.any(axis=1).mean() < 0.5 < changed.any(axis=0).mean()
    assert (left != right).any(axis=2).mean() < 0.01  # no arrow heads: the sign cannot be seen


def test_holes_are_darker_than_what_was_measured():
    frame = frame_of()
    still = replace(result_of(frame), motion=Motion(np.zeros(3), np.zeros(3)))
    whole = replace(frame, depth=np.nan_to_num(frame.depth, nan=2.0))
    with_holes, without = (
        draw_frame(f, still)[30:330, 824:1224].astype(int) for f in (frame, whole)
    )
    assert (with_holes[20:60, 20:60].sum() / without[20:60, 20:60].sum()) == pytest.approx(
        0.72, abs=0.02
    )
    np.testing.assert_array_equal(with_holes[100:], without[100:])


def test_a_plane_of_one_depth_can_be_drawn():
    frame = frame_of()
    flat = replace(result_of(frame), depth=np.full((300, 400), 2, np.float32))
    assert draw_frame(frame, flat).shape == (366, 1306, 3)


def test_the_summary_counts_the_outcomes():
    frame = frame_of()
    results = [result_of(frame, outcome) for outcome in (*Outcome, Outcome.SOLVED)]
    lines = summary(results).splitlines()
    assert lines[0] == 'frames    4: 1 sharp, 2 solved, 1 failed'
    assert lines[1] == 'blur      median 12.00 px, largest 12.00 px'
    assert lines[3] == 'time      median 3.00 s, largest 3.00 s'
    assert summary([]) == 'no frames'
