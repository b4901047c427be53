"""The SROS2 policy against the topics and services that the live node really has."""

from pathlib import Path
import xml.etree.ElementTree as ET

from depth_deblur_ros.settings import settings_from
import pytest
import ros_parts
from ros_parts import Peer, Process, STUB

pytestmark = pytest.mark.ros
POLICY = Path(__file__).resolve().parents[1] / 'config/sros2_policy.xml'
NAME = 'depth_deblur'


def allowed(kind, direction):
    """Give the full names that the policy allows."""
    profile = ET.parse(POLICY).getroot().find('.//profile')
    assert (profile.get('ns'), profile.get('node')) == ('/', NAME)
    found = profile.findall(f'{kind}s[@{direction}="ALLOW"]/{kind}')
    return {f'/{e.text}'.replace('//', '/').replace('/~', f'/{NAME}') for e in found}


def test_the_policy_allows_what_the_node_does_and_nothing_else(monkeypatch, tmp_path):
    ros_parts.private_domain(monkeypatch)
    peer = Peer()
    options = ['-p', 'lazy:=false', '-p', 'use_sim_time:=true']
    node = Process([*STUB, '--ros-args', *options], tmp_path / 'log')
    try:
        peer.until(lambda: peer.status()[0].startswith(('nothing', 'idle', 'no pair')), 60)
        asked = (NAME, '/')
        heard = {name for name, _ in peer.node.get_subscriber_names_and_types_by_node(*asked)}
        said = {name for name, _ in peer.node.get_publisher_names_and_types_by_node(*asked)}
        served = {name for name, _ in peer.node.get_service_names_and_types_by_node(*asked)}
        used = peer.node.get_client_names_and_types_by_node(*asked)
        assert node.stop() == 0
    finally:
        node.kill()
        peer.close()
    transports = {name for name in allowed('topic', 'subscribe') if name.endswith('ompressed')}
    transports |= {name for name in allowed('topic', 'subscribe') if 'compressedDepth' in name}
    assert heard == allowed('topic', 'subscribe') - transports
    assert said == allowed('topic', 'publish')
    assert served == allowed('service', 'reply')
    assert used == []


def test_the_policy_names_every_input_of_the_defaults():
    names = {f'/{source.topic}{source.suffix}' for source in settings_from({}).sources().values()}
    assert names <= allowed('topic', 'subscribe')
