"""The layouts of the viewers ask for topics of the contract, of types that they can show."""

import json
from pathlib import Path
import re

from depth_deblur_ros.results import TYPES
from depth_deblur_ros.settings import NodeParams
import pytest
from rosbags.interfaces import Nodetype
from rosbags.typesys import get_typestore, Stores
import yaml

CONFIG = Path(__file__).resolve().parents[1] / 'config'
IMAGE, INFO = 'sensor_msgs/msg/Image', 'sensor_msgs/msg/CameraInfo'
TWIST, STATUS = 'geometry_msgs/msg/TwistStamped', 'diagnostic_msgs/msg/DiagnosticStatus'
ARRAY = 'diagnostic_msgs/msg/DiagnosticArray'
DEFAULTS = NodeParams()
CONTRACT = {f'/{topic}': kind for topic, kind in TYPES.items()} | {
    f'/{DEFAULTS.colour_topic}': IMAGE,
    f'/{DEFAULTS.depth_topic}': IMAGE,
    f'/{DEFAULTS.camera_info_topic}': INFO,
    '/diagnostics': ARRAY,
}
STORE = get_typestore(Stores.ROS2_JAZZY)
LAYOUT = json.loads((CONFIG / 'foxglove.json').read_text())
PANELS = LAYOUT['configById']
PLOTTED = [p['value'] for panel in PANELS.values() for p in panel.get('paths', ())]
RVIZ = yaml.safe_load((CONFIG / 'view.rviz').read_text())['Visualization Manager']
SHOWS = {'rviz_default_plugins/Image': IMAGE, 'rviz_default_plugins/TwistStamped': TWIST}


def field_type(path):
    """Give the type at a Foxglove message path; a name that is not there is a KeyError."""
    topic, *names = re.sub(r'\[:\](\{[^}]*\})?', '', path).split('.')
    kind = CONTRACT[topic]
    for name in names:
        node, detail = dict(STORE.fielddefs[kind][1])[name]
        if node in (Nodetype.SEQUENCE, Nodetype.ARRAY):
            node, detail = detail[0]
        kind = detail if node is Nodetype.NAME else detail[0]
    return kind


def leaves(layout):
    if isinstance(layout, str):
        return [layout]
    assert layout['direction'] in ('row', 'column') and 0 < layout['splitPercentage'] < 100
    return leaves(layout['first']) + leaves(layout['second'])


def topics_of(panel):
    mode = panel.get('imageMode', {})
    found = [mode.get('imageTopic'), panel.get('topicPath'), panel.get('topicToRender')]
    return {t for t in found if t} | {p['value'].split('.')[0] for p in panel.get('paths', ())}


# The settings that the panels of Foxglove (and Lichtblick) know, as their sources name them.
KNOWN = {
    'Image': {'foxglovePanelTitle', 'imageMode'},
    'Plot': {'foxglovePanelTitle', 'paths', 'isSynced', 'xAxisVal', 'sidebarDimension'}
    | {'showLegend', 'legendDisplay', 'showPlotValuesInLegend'}
    | {'showXAxisLabels', 'showYAxisLabels'},
    'RawMessages': {'topicPath', 'diffEnabled', 'diffMethod', 'diffTopicPath'}
    | {'showFullMessageForDiff'},
    'DiagnosticSummary': {'topicToRender', 'minLevel', 'hardwareIdFilter', 'pinnedIds'}
    | {'sortByLevel'},
    'DiagnosticStatusPanel': {'topicToRender', 'selectedHardwareId', 'selectedName'},
}


@pytest.mark.parametrize('name', PANELS)
def test_each_panel_has_settings_that_its_viewer_knows(name):
    kind, panel = name.split('!')[0], PANELS[name]
    assert set(panel) <= KNOWN[kind]
    for path in panel.get('paths', ()):
        assert set(path) == {'value', 'label', 'enabled', 'timestampMethod'}
        assert path['timestampMethod'] in ('headerStamp', 'receiveTime')


def test_the_status_that_is_picked_is_the_one_that_the_node_sends():
    source = (CONFIG.parent / 'depth_deblur_ros/node.py').read_text()
    node, status = PANELS['DiagnosticStatusPanel!node']['selectedName'].split(': ')
    assert f"NAME = '{node}'" in source and f"f'{{self.get_name()}}: {status}'" in source


def test_every_panel_has_its_place_and_its_settings():
    placed = leaves(LAYOUT['layout'])
    assert sorted(placed) == sorted(PANELS)


def test_foxglove_shows_input_output_twist_and_diagnostics():
    shown = set().union(*map(topics_of, PANELS.values()))
    assert shown <= set(CONTRACT)
    assert {CONTRACT[t] for t in shown} == {IMAGE, TWIST, STATUS, ARRAY}
    assert {'/rgb/image_rect_color', '/deblurred/image', '/motion', '/diagnostics'} <= shown


@pytest.mark.parametrize('name', PANELS)
def test_each_panel_can_show_the_type_of_its_topic(name):
    panel, kind = PANELS[name], name.split('!')[0]
    if kind == 'Image':
        mode = panel['imageMode']
        assert CONTRACT[mode['imageTopic']] == IMAGE
        assert CONTRACT[mode['calibrationTopic']] == INFO
    elif kind.startswith('Diagnostic'):
        assert CONTRACT[panel['topicToRender']] == ARRAY
    elif kind == 'RawMessages':
        assert panel['topicPath'] in CONTRACT
    else:
        assert kind == 'Plot' and panel['paths']
        assert all(path['enabled'] for path in panel['paths'])


@pytest.mark.parametrize('path', PLOTTED)
def test_every_curve_is_a_number_of_its_message(path):
    # The values of a DiagnosticStatus are text; Foxglove reads the numbers in it.
    assert field_type(path) == ('string' if '{key==' in path else 'float64')


@pytest.mark.parametrize('name', ['blur_px', 'seconds'])
def test_the_values_that_are_plotted_are_said(name):
    from test_results import RESULT, result, said

    entries = {entry['key']: entry['value'] for entry in said(result())[RESULT]['values']}
    assert f'/result.values[:]{{key=="{name}"}}.value' in PLOTTED
    assert float(entries[name]) > 0


def test_rviz_shows_input_output_and_twist():
    shown = {d['Topic']['Value']: d['Class'] for d in RVIZ['Displays']}
    assert {'/rgb/image_rect_color', '/deblurred/image', '/motion'} <= set(shown)
    for topic, display in shown.items():
        assert CONTRACT[topic] == SHOWS[display]
    reliable = {d['Topic']['Reliability Policy'] for d in RVIZ['Displays'] if '/rgb' in str(d)}
    assert reliable == {'Best Effort'}  # as cameras send


def test_the_layouts_are_installed():
    setup = (CONFIG.parent / 'setup.py').read_text()
    assert 'config/foxglove.json' in setup and 'config/view.rviz' in setup
