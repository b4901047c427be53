"""The same stream through the live node, over real DDS, and through replay: the same motion."""

from dataclasses import replace
import json
from pathlib import Path
import sys

from depth_deblur_ros.bag import BagReader, BagWriter, decoded
from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.messages import (
    camera_info_fields,
    depth_fields,
    filled,
    header_fields,
    image_fields,
)
from depth_deblur_ros.replay import replay
from diagnostic_msgs.msg import DiagnosticStatus
from geometry_msgs.msg import TwistStamped
import numpy as np
import pytest
from ros_parts import COLOUR, DEPTH, INFO, Process
from sensor_msgs.msg import CameraInfo, Image
from turning import CAMERA, EXPOSURE, frame, Knowing, rate, START_NS

pytestmark = pytest.mark.ros
NODE = (sys.executable, str(Path(__file__).with_name('turning_node.py')))
FRAMES = 12
KINDS = {COLOUR: Image, DEPTH: Image, INFO: CameraInfo}


def messages(number, camera=CAMERA):
    """Give topic and fields of the messages of a frame."""
    made = frame(number)
    header = header_fields(made.stamp_ns, 'camera_optical_frame')
    yield INFO, camera_info_fields(camera, header)
    yield COLOUR, image_fields(made.image, header)
    yield DEPTH, depth_fields(made.depth, header)


def live(peer, log):
    """Give stamp and angular velocity of each twist, and how many frames had a result."""
    node = Process(NODE, log)
    twists = peer.listen(TwistStamped, 'motion')
    results = peer.listen(DiagnosticStatus, 'result')
    try:
        peer.advertise(KINDS)
        for number in range(FRAMES):
            for topic, fields in messages(number):
                peer.send(topic, KINDS[topic], filled(KINDS[topic](), fields))
            peer.until(lambda count=number + 1: len(results) == count)
        peer.spin(0.3)
    finally:
        node.stop()
    found = {}
    for twist in twists:
        stamp, turn = twist.header.stamp, twist.twist.angular
        found[stamp.sec * 10**9 + stamp.nanosec] = np.array([turn.x, turn.y, turn.z])
    return found, len(results)


def replayed(folder):
    with BagWriter(folder / 'in') as bag:
        for number in range(FRAMES):
            for topic, fields in messages(number):
                kind = f'sensor_msgs/msg/{KINDS[topic].__name__}'
                bag.write(f'/{topic}', kind, fields, frame(number).stamp_ns)
    lines = folder / 'motion.jsonl'
    params = SolverParams(mode='motion')
    replay(folder / 'in', folder / 'out', params=params, solve=Knowing(), estimates=lines)
    found = {}
    for number, line in enumerate(lines.read_text().splitlines()):
        record = json.loads(line)
        if record['sign_resolved']:
            turn = -np.array(record['theta']) / record['exposure']
            found[frame(number).stamp_ns] = turn
    return found, record['exposure']


def test_live_and_replay_tell_the_same_motion(peer, tmp_path):
    told_live, count = live(peer, tmp_path / 'log')
    told, exposure = replayed(tmp_path)
    assert count == FRAMES
    assert len(told) >= FRAMES - 1 and len(told_live) >= FRAMES - 4
    assert exposure == pytest.approx(EXPOSURE, rel=0.1)
    fast = [s for s in told_live if np.linalg.norm(rate((s - START_NS) / 1e9)) > 0.5]
    assert len(fast) >= 5
    for stamp in fast:
        truth = -rate((stamp - START_NS) / 1e9)
        for found in (told[stamp], told_live[stamp]):
            assert np.linalg.norm(found - truth) < 0.3 * np.linalg.norm(truth)


def test_a_lens_is_undone_live_as_in_replay(peer, tmp_path):
    sent = list(messages(0, replace(CAMERA, distortion=(0.3, -0.1, 0.0, 0.0, 0.0))))
    node = Process((*NODE, '--ros-args', '-p', 'rectified:=false'), tmp_path / 'log')
    pictures = peer.listen(Image, 'deblurred/image')
    infos = peer.listen(CameraInfo, 'deblurred/camera_info')
    try:
        peer.advertise(KINDS)
        for topic, fields in sent:
            peer.send(topic, KINDS[topic], filled(KINDS[topic](), fields))
        peer.until(lambda: pictures and infos)
    finally:
        node.stop()
    with BagWriter(tmp_path / 'in') as bag:
        for topic, fields in sent:
            kind = f'sensor_msgs/msg/{KINDS[topic].__name__}'
            bag.write(f'/{topic}', kind, fields, frame(0).stamp_ns)
    params = SolverParams(mode='motion', rectified=False)
    replay(tmp_path / 'in', tmp_path / 'out', params=params, solve=Knowing())
    with BagReader(tmp_path / 'out') as reader:
        (written,) = map(decoded, reader.messages({'/deblurred/image'}))
    assert bytes(pictures[0].data) == bytes(written.data) != bytes(sent[1][1]['data'])
    assert not any(infos[0].d)
