"""A replayed bag read back: every frame, its motion with its spread, and the truth."""

from dataclasses import replace
import json

from depth_deblur_ros import cli
from depth_deblur_ros.bag import BagWriter
from depth_deblur_ros.core.data import (
    CameraIntrinsics,
    DeblurResult,
    InputError,
    Motion,
    Outcome,
)
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.messages import (
    camera_info_fields,
    depth_fields,
    header_fields,
    image_fields,
)
from depth_deblur_ros.notes import SHOTS
from depth_deblur_ros.replay import replay
from depth_deblur_ros.review import review
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

CAMERA = CameraIntrinsics(60, 60, 31.5, 23.5, 64, 48)
START, STEP, EXPOSURE = 1_305_031_231_096_775_000, 33_333_333, 0.02
FRAMES = 12
GAP = 6  # of one more colour frame that has no depth
VELOCITY = np.array([0.5, -1.0, 0.3, 0.2, 0.1, -0.4])  # rad/s, m/s, of the camera in its own frame
SPREAD = np.diag(np.arange(1.0, 7.0)) * 1e-8
IMAGE, DEPTH = np.full((48, 64, 3), 0.5, np.float32), np.full((48, 64), 2, np.float32)


def write_bag(path, truth=None):
    """Give a bag of FRAMES pairs, a colour frame without a depth among them, and some truth."""
    with BagWriter(path) as bag:
        for k in range(FRAMES + 1):
            stamp = START + k * STEP
            header = header_fields(stamp, 'camera')
            bag.write(
                '/rgb/camera_info',
                'sensor_msgs/msg/CameraInfo',
                camera_info_fields(CAMERA, header),
                stamp,
            )
            image = image_fields(IMAGE, header)
            bag.write('/rgb/image_rect_color', 'sensor_msgs/msg/Image', image, stamp)
            if k != GAP:
                depth = depth_fields(DEPTH, header)
                bag.write('/depth_registered/image_rect', 'sensor_msgs/msg/Image', depth, stamp)
            if truth:
                truth(bag, stamp, header)
    return path


def xyz(values):
    return dict(zip('xyz', map(float, values), strict=True))


def twist(bag, stamp, header):
    fields = {'linear': xyz(VELOCITY[3:]), 'angular': xyz(VELOCITY[:3])}
    fields = {'header': header, 'twist': fields}
    bag.write('/ground_truth/motion', 'geometry_msgs/msg/TwistStamped', fields, stamp)


def pose(bag, stamp, _):
    """Write poses at 300 Hz, of a camera that turns and moves as it says by itself."""
    for late in range(0, STEP, STEP // 10):
        t = (stamp + late - START) / 1e9
        turn = Rotation.from_rotvec([0.3, -0.2, 0.9]) * Rotation.from_rotvec(t * VELOCITY[:3])
        steps = np.linspace(0, t, 200)
        turns = Rotation.from_rotvec([0.3, -0.2, 0.9]) * Rotation.from_rotvec(
            steps[:, None] * VELOCITY[:3]
        )
        place = np.trapezoid(turns.apply(VELOCITY[3:]), steps, axis=0)
        fields = {
            'header': header_fields(stamp + late, 'world'),
            'pose': {
                'position': xyz(place),
                'orientation': dict(zip('xyzw', map(float, turn.as_quat()), strict=True)),
            },
        }
        kind = 'geometry_msgs/msg/PoseStamped'
        bag.write('/ground_truth/pose', kind, fields, stamp + late)


def solve(frame, params):
    """Pretend: the true motion with its sign open; one frame refused, one failed."""
    number = round((frame.stamp_ns - START) / STEP)
    if number == 3:
        raise InputError('no such frame')
    failed = number == 5
    p = np.zeros(6) if failed else -VELOCITY * EXPOSURE * (-1) ** number
    return DeblurResult(
        image=frame.image,
        depth=frame.depth,
        motion=Motion.from_vector(p, SPREAD),
        outcome=Outcome.FAILED if failed else Outcome.SOLVED,
        sign_resolved=number == 0,
        quality=0.75,
        blur_px=4.0,
        seconds=0.5,
    )


def replayed(folder, truth=None, exposure_s=EXPOSURE, **more):
    bag = write_bag(folder / 'in', truth)
    replay(bag, folder / 'out', params=SolverParams(), solve=solve, exposure_s=exposure_s, **more)
    return bag, folder / 'out'


def test_every_frame_comes_back_as_it_was_told(tmp_path):
    run = review(*replayed(tmp_path))
    assert [n.stamp_ns for n in run.notes] == [
        START + k * STEP for k in range(FRAMES + 1) if k != GAP
    ]
    first = run.notes[0]
    assert (first.outcome, first.sign_resolved, first.exposure) == (Outcome.SOLVED, True, EXPOSURE)
    assert (first.quality, first.blur_px) == (0.75, 4.0)
    assert first.seconds == pytest.approx(0.5, abs=0.3)  # following the camera takes some, too
    np.testing.assert_allclose(first.twist, VELOCITY)
    np.testing.assert_allclose(run.notes[1].twist, -VELOCITY)
    for k in (0, 1):  # the covariance of an open sign spans both signs: that is taken off again
        np.testing.assert_allclose(run.notes[k].deviation, np.sqrt(np.diag(SPREAD)), rtol=1e-6)
    assert run.notes[3].reason == 'no such frame'
    assert run.notes[5].outcome is Outcome.FAILED and np.isnan(run.notes[5].twist).all()


def test_pictures_are_those_of_frames_that_went_through(tmp_path):
    run = review(*replayed(tmp_path))
    assert len(run.shots) == SHOTS
    taken = {shot.stamp_ns for shot in run.shots}
    assert START in taken and START + 3 * STEP not in taken


def filled(frame, params):
    """Pretend as solve does, without holes."""
    return replace(solve(frame, params), depth=DEPTH)


def test_what_a_distorting_lens_took_is_shown_undistorted(tmp_path, monkeypatch):
    image = np.repeat(np.tile(np.linspace(0, 1, 64, dtype=np.float32), (48, 1))[..., None], 3, 2)
    lens = replace(CAMERA, distortion=(0.5, 0, 0, 0, 0))
    monkeypatch.setitem(globals(), 'IMAGE', image)
    monkeypatch.setitem(globals(), 'CAMERA', lens)
    bag, params = write_bag(tmp_path / 'in'), SolverParams(rectified=False)
    replay(bag, tmp_path / 'out', params=params, solve=filled)
    run = review(bag, tmp_path / 'out', params=params)
    first = run.shots[0].pictures
    assert first['blurred'] == first['sharp']  # as the solver gives it back
    command = ['report', str(bag), str(tmp_path / 'out')]
    pages = []
    for more in ([], ['--rectified', 'false']):
        cli.main(command + more)
        pages.append((tmp_path / 'out.html').read_text())
    assert ['<span>unchanged</span>' in page for page in pages] == [False, True]


def test_colour_frames_without_a_pair_are_counted(tmp_path):
    bag, out = replayed(tmp_path, start=0.11)
    run = review(bag, out)
    assert sum(run.lost.values()) == 1
    assert run.notes[0].stamp_ns == START + 4 * STEP
    told = review(bag, out, lost={'no depth': 3})
    assert told.lost == {'no depth': 3}


@pytest.mark.parametrize('truth', [twist, pose])
def test_the_truth_is_the_cameras_velocity_in_its_own_frame(tmp_path, truth):
    run = review(*replayed(tmp_path, truth))
    assert len(run.truth) >= FRAMES - 1  # no pose stands before the first frame
    for velocity in run.truth.values():
        np.testing.assert_allclose(velocity, VELOCITY, atol=2e-3)


def test_without_an_exposure_there_is_no_velocity(tmp_path):
    run = review(*replayed(tmp_path, exposure_s=None))
    assert all(np.isnan(n.twist).all() and np.isnan(n.deviation).all() for n in run.notes)


def test_energies_come_from_the_estimates(tmp_path):
    bag, out = replayed(tmp_path, estimates=tmp_path / 'all.jsonl')
    lines = [json.loads(line) for line in (tmp_path / 'all.jsonl').read_text().splitlines()]
    lines[2]['energies'] = [{'level': 1, 'step': 'before turn 1', 'terms': {'variation': 1.0}}]
    (tmp_path / 'all.jsonl').write_text('\n'.join(map(json.dumps, lines)))
    notes = review(bag, out, estimates=tmp_path / 'all.jsonl').notes
    assert [bool(n.energies) for n in notes] == [k == 2 for k in range(FRAMES)]
    (tmp_path / 'bad.jsonl').write_text('{"stamp": 1, "energies": [3]}')
    with pytest.raises(InputError, match='no file of estimates'):
        review(bag, out, estimates=tmp_path / 'bad.jsonl')


def test_a_bag_without_results_is_refused(tmp_path):
    bag = write_bag(tmp_path / 'in')
    with pytest.raises(InputError, match='no output of replay'):
        review(bag, bag)


def test_the_command_line_writes_the_page(tmp_path, capsys):
    bag, out = replayed(tmp_path)
    assert cli.main(['report', str(bag), str(out)]) == cli.DONE
    assert (tmp_path / 'out.html').read_text().startswith('<!doctype html>')
    assert '12 frames, pictures of 8' in capsys.readouterr().out
    assert cli.main(['report', str(bag), str(out), '-o', str(tmp_path / 'p/q.html')]) == cli.DONE
    assert (tmp_path / 'p/q.html').is_file()


def test_replay_writes_the_page_too(tmp_path):
    bag = write_bag(tmp_path / 'in')
    options = ['--report', '--mode', 'motion', '--duration', '0.1']
    cli.main(['replay', str(bag), str(tmp_path / 'out'), *options])
    assert 'Frame 1 of 4' in (tmp_path / 'out.html').read_text()
