"""What the live node may be told beside the solver's parameters: declared once, and checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
import re
from typing import Any

from depth_deblur_ros.core.data import InputError, TRANSFERS
from depth_deblur_ros.core.params import check_values, choice, free, knob, knobs, SolverParams
from depth_deblur_ros.folders import CameraFile, read_camera
from depth_deblur_ros.frames import Given
from depth_deblur_ros.tum import preset_camera, PRESETS

FROM_ROS = ('use_sim_time', 'qos_overrides', 'start_type_description_service')
READ_ONLY = ('autostart',)
_TOPIC = re.compile(r'~?/?([A-Za-z]\w*/)*[A-Za-z]\w*', re.ASCII)
_RESUBSCRIBE = ' (a change subscribes anew)'


@dataclass(frozen=True)
class NodeParams:
    """Settings of the live node; InputError names the value and its bounds."""

    autostart: bool = free(True, 'configure and activate at start; false: wait for ros2 lifecycle')
    lazy: bool = free(True, 'no work, and no images taken in, while nobody subscribes')
    colour_topic: str = free('rgb/image_rect_color', 'colour images' + _RESUBSCRIBE)
    depth_topic: str = free(
        'depth_registered/image_rect', 'depth registered to the colour' + _RESUBSCRIBE
    )
    camera_info_topic: str = free('rgb/camera_info', 'the colour camera' + _RESUBSCRIBE)
    exposure_topic: str = free('exposure', 'exposure times, seconds' + _RESUBSCRIBE)
    imu_topic: str = free('imu', 'gyro readings' + _RESUBSCRIBE)
    colour_transport: str = choice(
        'raw', ('raw', 'compressed'), 'compressed: read <colour_topic>/compressed'
    )
    depth_transport: str = choice(
        'raw', ('raw', 'compressed', 'compressedDepth'), 'read <depth_topic>/<depth_transport>'
    )
    sync_slop_s: float = knob(
        0.02, 0.0, 1.0, 'how far apart the stamps of colour and depth may be [s]'
    )
    exposure_s: float = knob(0.0, 0.0, 60.0, 'exposure where no topic tells it; 0 = unknown [s]')
    deadline_ms: float = knob(
        0.0, 0.0, 60000.0, 'for the solver: often missed, mode steps down; 0 = none [ms]'
    )
    camera: str = free(
        '', f'instead of camera_info: path of a camera.json, or {", ".join(PRESETS)}'
    )
    transfer: str = choice('srgb', TRANSFERS, 'in which space light was averaged; srgb: cameras')
    jpeg_quality: int = knob(95, 1, 100, 'of deblurred/image/compressed')

    def __post_init__(self) -> None:
        check_values(self)
        for name in (
            'colour_topic',
            'depth_topic',
            'camera_info_topic',
            'exposure_topic',
            'imu_topic',
        ):
            if not _TOPIC.fullmatch(getattr(self, name)):
                raise InputError(f'{name} must be a topic name, got {getattr(self, name)!r}')


@dataclass(frozen=True)
class Source:
    """A topic to read: its name before remapping, its message type, what follows the name."""

    topic: str
    kind: str
    needed: bool = True
    suffix: str = ''


@dataclass(frozen=True)
class Settings:
    """All that the node is told, and what follows for its frames."""

    solver: SolverParams
    node: NodeParams
    given: Given

    def sources(self) -> dict[str, Source]:
        """Give where the messages of each role come from."""
        node = self.node
        return {
            'colour': _image_source(node.colour_topic, node.colour_transport),
            'depth': _image_source(node.depth_topic, node.depth_transport),
            'camera_info': Source(
                node.camera_info_topic, 'sensor_msgs/msg/CameraInfo', not self.given.camera
            ),
            'exposure': Source(node.exposure_topic, 'std_msgs/msg/Float32', False),
            'imu': Source(node.imu_topic, 'sensor_msgs/msg/Imu', False),
        }


DECLARED = (*knobs(NodeParams), *knobs())


def settings_from(values: Mapping[str, Any], before: Settings | None = None) -> Settings:
    """Make settings from names and values, the others as before."""
    before = before or Settings(SolverParams(), NodeParams(), Given())
    own, solvers = ({knob.name for knob in knobs(kind)} for kind in (NodeParams, SolverParams))
    if not values.keys() & (own | solvers):
        return before
    node = replace(before.node, **{name: values[name] for name in values.keys() & own})
    solver = replace(before.solver, **{name: values[name] for name in values.keys() & solvers})
    return Settings(solver, node, _given(node, solver))


def without_node_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """Leave out of a ROS parameter file what only the node and ROS itself understand."""
    names = {declared.name for declared in knobs(NodeParams)}
    return {
        name: value
        for name, value in values.items()
        if name not in names and name.split('.')[0] not in FROM_ROS
    }


def _image_source(topic: str, transport: str) -> Source:
    if transport == 'raw':
        return Source(topic, 'sensor_msgs/msg/Image')
    return Source(topic, 'sensor_msgs/msg/CompressedImage', suffix=f'/{transport}')


def _given(node: NodeParams, solver: SolverParams) -> Given:
    file = _camera(node.camera) if node.camera else None
    return Given(
        camera=replace(file.intrinsics, transfer=node.transfer) if file else None,
        exposure_s=node.exposure_s or (file.exposure if file else None),
        rectified=solver.rectified,
        transfer=node.transfer,
    )


def _camera(name: str) -> CameraFile:
    if name in PRESETS:
        return preset_camera(name)
    if not Path(name).is_file():
        raise InputError(f'camera must be a file or one of {", ".join(PRESETS)}, got {name!r}')
    return read_camera(Path(name))
