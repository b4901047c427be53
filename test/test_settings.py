"""What the live node may be told."""

from dataclasses import fields
import json

from depth_deblur_ros.core.data import InputError
from depth_deblur_ros.core.params import knobs
from depth_deblur_ros.settings import DECLARED, NodeParams, settings_from, without_node_values
import pytest

CAMERA = {
    **{'fx': 60.0, 'fy': 60.0, 'cx': 31.5, 'cy': 23.5, 'width': 64, 'height': 48},
    **{'depth_scale': 1000.0, 'exposure': 0.03, 'transfer': 'srgb'},
}


def test_names_of_the_node_and_of_the_solver_do_not_meet():
    names = [knob.name for knob in DECLARED]
    assert len(names) == len(set(names)) == len(knobs()) + len(fields(NodeParams))


def test_what_is_not_named_stays_as_it_was():
    before = settings_from({'mode': 'fast', 'sync_slop_s': 0.05})
    after = settings_from({'threads': 1, 'exposure_s': 0.01}, before)
    assert (after.solver.mode, after.solver.threads) == ('fast', 1)
    assert (after.node.sync_slop_s, after.given.exposure_s) == (0.05, 0.01)
    assert settings_from({'use_sim_time': True}, after) is after


@pytest.mark.parametrize(
    ('values', 'text'),
    [
        ({'sync_slop_s': 2.0}, r'sync_slop_s must lie in \[0.0, 1.0\], got 2.0'),
        ({'jpeg_quality': 0}, 'jpeg_quality must lie in'),
        ({'lazy': 1}, 'lazy must be of type bool, got 1'),
        ({'colour_topic': ''}, "colour_topic must be a topic name, got ''"),
        ({'depth_topic': '/a//b'}, 'depth_topic must be a topic name'),
        ({'depth_topic': '/1st'}, 'depth_topic must be a topic name'),
        ({'colour_transport': 'theora'}, 'colour_transport must be one of'),
        ({'camera': 'nowhere.json'}, 'camera must be a file or one of tum_fr1'),
        ({'mode': 'quick'}, 'mode must be one of'),
    ],
)
def test_what_cannot_work_is_refused_with_the_reason(values, text):
    with pytest.raises(InputError, match=text):
        settings_from(values)


@pytest.mark.parametrize('name', ['a', '/a/b_1', '~/image', 'rgb/image_rect_color'])
def test_names_that_ros_takes_are_taken(name):
    assert settings_from({'colour_topic': name}).sources()['colour'].topic == name


def test_a_camera_file_brings_its_exposure_unless_one_is_given(tmp_path):
    path = tmp_path / 'camera.json'
    path.write_text(json.dumps(CAMERA))
    settings = settings_from({'camera': str(path), 'transfer': 'linear'})
    assert settings.given.exposure_s == 0.03
    assert settings.given.camera.transfer == 'linear'
    assert not settings.sources()['camera_info'].needed
    assert settings_from({'camera': str(path), 'exposure_s': 0.01}).given.exposure_s == 0.01
    assert settings_from({'camera': 'tum_fr1'}).given.camera.distortion


def test_transports_are_named_as_image_transport_does():
    sources = settings_from(
        {'colour_transport': 'compressed', 'depth_transport': 'compressedDepth'}
    ).sources()
    assert sources['colour'].suffix == '/compressed'
    assert sources['depth'].suffix == '/compressedDepth'
    assert sources['depth'].kind == 'sensor_msgs/msg/CompressedImage'


def test_the_command_line_passes_over_what_is_for_the_node():
    values = {'mode': 'fast', 'lazy': True, 'use_sim_time': True, 'typo': 1}
    values['qos_overrides./a.subscription.depth'] = 3
    assert without_node_values(values) == {'mode': 'fast', 'typo': 1}
