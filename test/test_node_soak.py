"""Three minutes at 30 Hz, 640x480, with the real solver: nothing lost, nothing piles up."""

import os
import sys

import numpy as np
import play_bag
import pytest
import ros_parts
from sensor_msgs.msg import Image
from soak import memory_mb
from watched_node import EVERY_S

pytestmark = [pytest.mark.ros, pytest.mark.slow, pytest.mark.timeout(420)]

SECONDS = float(os.environ.get('SOAK_SECONDS', '120'))
PARTS = 4
SETTLED_S = 60.0  # before them; until then tables are still made
LAST_S = 1.0  # of an idle node
GROWTH_LIMIT = 0.1  # MB in a part: 12 MB in an hour
RESIDENT_LIMIT = 400.0  # MB, of what no allocator knows, too
PLAYER = ros_parts.ROOT / 'scripts/play_bag.py'
WATCHED = sys.executable, ros_parts.ROOT / 'test/watched_node.py'
LOSS_LIMIT = 0.001  # of what is sent, beside what came while a busy machine stopped the node


def stream(peer, seconds, log):
    """Send frames for so long, and listen; give how many were sent."""
    player = ros_parts.Process([sys.executable, PLAYER, '--frames', int(30 * seconds)], log)
    try:
        while player.process.poll() is None:
            peer.spin(1.0)
            peer.heard['deblurred/image'].clear()
        return len(player.json()['stamps'])
    finally:
        player.kill()


def used_mb(peer, path):
    """Give the memory [MB] in use when nothing waits."""
    peer.settled(timeout=60)
    peer.spin(2 * LAST_S)
    return float(np.median(np.loadtxt(path)[-int(LAST_S / EVERY_S) :]))


def test_three_minutes_at_thirty_hertz(monkeypatch, tmp_path, record_property):
    ros_parts.private_domain(monkeypatch)
    remaps = [w for old, new in play_bag.REMAP.items() for w in ('-r', f'{old}:={new}')]
    used = tmp_path / 'used'
    peer = ros_parts.Peer()
    peer.listen(Image, 'deblurred/image')
    node = ros_parts.Process(
        [*WATCHED, used, '--ros-args', *remaps, '-p', 'mode:=motion'],
        tmp_path / 'node',
        PYTHONMALLOC='malloc',
    )
    try:
        peer.until(lambda: peer.status()[0].startswith('nothing on'), 90)
        sent, idle = stream(peer, SETTLED_S, tmp_path / 'player'), [used_mb(peer, used)]
        for _ in range(PARTS):
            sent += stream(peer, SECONDS / PARTS, tmp_path / 'player')
            idle.append(used_mb(peer, used))
        values, resident = peer.settled(timeout=60), memory_mb(node.pid)
        assert node.stop() == 0
    finally:
        node.kill()
        peer.close()
    roles = 'colour', 'depth'
    lost = {role: int(values[f'{role} lost in transport']) for role in roles}
    queued = {role: int(values[f'{role} lost in a full queue']) for role in roles}
    growth = np.diff(idle)
    figures = {
        'sent': sent,
        'lost in transport': lost,
        'of these in a full queue': queued,
        'published': int(values['published']),
        'memory in use [MB]': np.round(idle, 2).tolist(),
        'resident [MB]': round(resident),
        'latency p99 [s]': float(values['latency p99 [s]']),
    }
    record_property('soak', figures)
    sys.stdout.write(f'{figures}\n')
    ros_parts.assert_all_accounted(values)
    assert int(values['arrived']) == sent - lost['colour']
    assert int(values['depth arrived']) == sent - lost['depth']
    assert sum(lost.values()) - sum(queued.values()) <= LOSS_LIMIT * sent, figures
    # A leak grows in each part; room for messages that have to wait is made once, in some.
    assert growth.min() < GROWTH_LIMIT, figures
    assert resident < RESIDENT_LIMIT, figures
    assert int(values['published']) > 0
