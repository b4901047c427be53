"""Garbage and floods on the topics of the live node: it stays up, small, and its books balance."""

import os
import random
import time

from depth_deblur_ros.messages import camera_info_fields, filled, header_fields
import pytest
import ros_parts
from ros_parts import (
    assert_all_accounted,
    COLOUR,
    colour_message,
    DEPTH,
    depth_message,
    INFO,
    Process,
    STUB,
)
from sensor_msgs.msg import CameraInfo, Image
import soak
from std_msgs.msg import Float32

pytestmark = [pytest.mark.ros, pytest.mark.timeout(240)]
SECOND = 10**9
START = 1_700_000_000 * SECOND
GROWTH_MB = 400  # what hostile input may cost; one image that it claims would be 768 MB


@pytest.fixture
def node(peer, tmp_path):
    """Start the node with a stub for a solver; see that it ends well."""
    process = Process(
        [*STUB, '--ros-args', '-p', 'lazy:=false'], tmp_path / 'log', STUB_SECONDS='0.002'
    )
    peer.until(lambda: peer.status()[0], 60)
    peer.advertise({COLOUR: Image, DEPTH: Image, INFO: CameraInfo, 'exposure': Float32})
    yield process
    assert process.stop() == 0, process.text()
    assert 'Traceback' not in process.text()


def answers(peer, stamp):
    """Send a sound frame and see that its result comes."""
    results = peer.listen(Image, 'deblurred/image')
    end = time.monotonic() + 60
    while not results:
        assert time.monotonic() < end, peer.status()
        stamp += SECOND // 10
        peer.send_frame(stamp)
        peer.spin(0.3)


def hostile_images(rng):
    """Give changes to an image message, each a lie."""
    yield {'width': 16384, 'height': 16384, 'step': 3 * 16384}
    yield {'width': 2**32 - 1, 'height': 2**32 - 1, 'step': 2**32 - 1}
    yield {'width': 0, 'height': 0}
    yield {'step': 0}
    yield {'step': 2**32 - 1}
    yield {'data': b''}
    yield {'data': bytes(5_000_000)}
    for encoding in ('', '\u2603' * 100, '64FC1000', 'bayer_rggb8', '32FC1', 'rgba16', 'x' * 9999):
        yield {'encoding': encoding, 'is_bigendian': rng.randrange(256)}


def hostile_cameras():
    nan, inf = float('nan'), float('inf')
    for value in (nan, inf, -inf, 0.0, -1.0, 1e308):
        yield {'p': [value] * 12, 'k': [value] * 9}
    yield {'width': 2**32 - 1, 'height': 1, 'binning_x': 2**32 - 1}
    yield {'d': [nan] * 1000, 'distortion_model': 'no such model'}


def changed(message, fields):
    for name, value in fields.items():
        setattr(message, name, value)
    return message


def test_messages_that_lie_are_counted_and_cost_nothing(peer, node):
    rng, stamp = random.Random(0), START
    before = soak.memory_mb(node.pid)
    sent = 0
    for fields in hostile_images(rng):
        for topic in (COLOUR, DEPTH):
            stamp += SECOND
            lie = COLOUR if topic == COLOUR else DEPTH
            colour, depth = colour_message(stamp), depth_message(stamp)
            changed(colour if lie == COLOUR else depth, fields)
            peer.send(COLOUR, Image, colour)
            peer.send(DEPTH, Image, depth)
            sent += 1
            peer.spin(0.05)
    for fields in hostile_cameras():
        stamp += SECOND
        told = camera_info_fields(ros_parts.CAMERA, header_fields(stamp, 'camera'))
        peer.send(INFO, CameraInfo, changed(filled(CameraInfo(), told), fields))
        peer.send_frame(stamp, info=False)
        sent += 1
        peer.spin(0.05)
    for value in (float('nan'), float('inf'), -1.0, 0.0, 1e30):
        peer.send('exposure', Float32, Float32(data=value))
    answers(peer, stamp)
    values = peer.settled(timeout=60)
    assert_all_accounted(values)
    lost = int(values['colour lost in transport'])
    assert int(values['arrived']) >= sent - lost
    assert sum(int(n) for key, n in values.items() if key.startswith('failed: ')) > 0
    assert soak.memory_mb(node.pid) - before < GROWTH_MB


@pytest.mark.parametrize('topic', [COLOUR, DEPTH, INFO, 'exposure'])
def test_a_flood_on_one_topic_fills_no_memory(peer, node, topic):
    peer.send_frame(START)
    before = soak.memory_mb(node.pid)
    rng, sent = random.Random(1), 0
    end = time.monotonic() + 4
    while time.monotonic() < end:
        stamp = START + SECOND + rng.randrange(2 * SECOND)
        if topic == COLOUR:
            message, kind = colour_message(stamp), Image
        elif topic == DEPTH:
            message, kind = depth_message(stamp), Image
        elif topic == INFO:
            told = camera_info_fields(ros_parts.CAMERA, header_fields(stamp, 'camera'))
            message, kind = filled(CameraInfo(), told), CameraInfo
        else:
            message, kind = Float32(data=rng.random()), Float32
        peer.send(topic, kind, message)
        sent += 1
    answers(peer, START + 10 * SECOND)
    values = peer.settled(timeout=60)
    assert_all_accounted(values)
    assert sent > 100
    assert soak.memory_mb(node.pid) - before < GROWTH_MB


def test_frames_of_fifty_megabytes_without_depth_do_not_pile_up(peer, node):
    before = soak.memory_mb(node.pid)
    large = changed(colour_message(START), {'width': 4096, 'height': 4096, 'step': 3 * 4096})
    large.data = bytes(3 * 4096 * 4096)
    for i in range(40):
        large.header.stamp.nanosec = i * 20_000_000
        peer.send(COLOUR, Image, large)
        peer.spin(0.02)
    values = peer.settled(timeout=60)
    assert_all_accounted(values)
    # 20 may wait; the transport and the one being worked on hold some more.
    assert soak.memory_mb(node.pid) - before < 2500
    answers(peer, START + 10 * SECOND)


@pytest.mark.slow
def test_a_short_soak_with_faults(monkeypatch, tmp_path):
    """One minute of scripts/soak.py: faults of every kind, and the books balance."""
    ros_parts.private_domain(monkeypatch)
    figures = soak.Soak(float(os.environ.get('SOAK_FAULTS_SECONDS', '50')), 1, tmp_path).run()
    assert figures['exit code'] == 0, figures
    assert figures['unbalanced'] == [], figures
    assert figures['counts']['arrived'] > 0, figures
    assert sum(figures['events'].values()) >= 3, figures
