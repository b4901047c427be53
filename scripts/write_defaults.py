"""Write config/deblur.yaml, the camera presets and the README's tables from the code."""

from collections.abc import Iterable
from dataclasses import Field, fields
import json
from pathlib import Path
from typing import Any

from depth_deblur_ros.core.params import knobs
from depth_deblur_ros.results import COMPRESSED, LIVE_TYPES, TYPES
from depth_deblur_ros.settings import NodeParams, settings_from

ROOT = Path(__file__).resolve().parents[1]
RESULTS = {  # what the README says of each topic in TYPES
    'deblurred/image': 'the sharp image',
    'deblurred/camera_info': 'its camera, without distortion if it was undone',
    'deblurred/depth': 'the filled depth, 32FC1, metres',
    'displacement': 'its way over the exposure, rad and metres; always',
    'motion': "the camera's own velocity; only when the sign and the exposure are known",
    'motion_with_covariance': 'the same, when the exposure is known; sign open: mean 0 '
    'and a covariance that spans both signs',
    'result': 'outcome, quality, sign_resolved, blur_px, seconds, exposure where it is known',
}
INPUTS = {  # and of each source of the live node
    'colour': 'in: rgb8, bgr8, rgba8, bgra8, mono8, mono16, 16-bit colour, Bayer',
    'depth': "in: 16UC1 (millimetres) or 32FC1 (metres), of the colour's size",
    'camera_info': 'in, unless the parameter `camera` tells it',
    'exposure': 'in, seconds, optional; the latest before an image counts, else `exposure_s`, '
    'else it is estimated',
    'imu': "in, optional: its gyro; `gyro_rotation` turns its axes into the camera's",
}
OTHERS = (
    (COMPRESSED, LIVE_TYPES[COMPRESSED], 'out: the sharp image as JPEG'),
    (
        '/diagnostics',
        'diagnostic_msgs/msg/DiagnosticArray',
        'out, once a second: rates, latency, every lost frame with its reason',
    ),
)
MODES = {  # the motion, the image, what for
    'full': (
        'found and refined',
        'all rounds of the image step (`reweightings`, `cg_steps`)',
        'pictures, data sets, SLAM after the fact',
    ),
    'fast': (
        'found; that of the first frame refined briefly, or as in full if it is clean',
        'fewer rounds: softer where the blur is long',
        'live',
    ),
    'motion': (
        'as in fast',
        'left as it is',
        'odometry: from the second frame on it costs the search alone',
    ),
}
TUM = {
    'colour_topic': '/camera/rgb/image_color',
    'depth_topic': '/camera/depth/image',
    'camera_info_topic': '/camera/rgb/camera_info',
}
PRESETS: dict[str, tuple[str, dict[str, Any]]] = {
    'tum_fr1': (
        'TUM RGB-D, freiburg1: images as taken, with the published calibration.',
        {**TUM, 'camera': 'tum_fr1'},
    ),
    'tum_fr2': (
        'TUM RGB-D, freiburg2: images as taken, with the published calibration.',
        {**TUM, 'camera': 'tum_fr2'},
    ),
    'tum_fr3': (
        'TUM RGB-D, freiburg3: images that are rectified already.',
        {**TUM, 'camera': 'tum_fr3'},
    ),
    'realsense_d435': (
        'Intel RealSense D435 with realsense2_camera, align_depth.enable:=true. The colour image\n'
        '# is taken by a rolling shutter: keep the exposure fixed and short, and state it here.',
        {
            'colour_topic': '/camera/camera/color/image_raw',
            'depth_topic': '/camera/camera/aligned_depth_to_color/image_raw',
            'camera_info_topic': '/camera/camera/color/camera_info',
            'rectified': False,
            'exposure_s': 0.0,
        },
    ),
    'azure_kinect': (
        'Azure Kinect with azure_kinect_ros_driver, depth and colour on. The colour image is\n'
        '# taken by a rolling shutter: keep the exposure fixed, and state it here.',
        {
            'colour_topic': '/rgb/image_raw',
            'depth_topic': '/depth_to_rgb/image_raw',
            'camera_info_topic': '/rgb/camera_info',
            'rectified': False,
            'exposure_s': 0.0,
        },
    ),
}


def yaml_text() -> str:
    """Give the defaults as a ROS parameter file."""
    lines = [
        '# The defaults of every parameter; change what you need, leave out the rest.',
        '/**:',
        '  ros__parameters:',
        '    # --- the solver, here and on the command line ---',
    ]
    lines += _entries(knobs())
    lines += ['    # --- the live node alone ---', *_entries(fields(NodeParams))]
    return '\n'.join(lines) + '\n'


def _entries(declared: tuple[Field[Any], ...]) -> list[str]:
    lines = []
    for knob in declared:
        limits = f'; {_limits(knob)}' if _limits(knob) else ''
        lines += [
            f'    # {knob.metadata["help"]}{limits}',
            f'    {knob.name}: {_value(knob.default)}',
        ]
    return lines


def preset_text(name: str) -> str:
    """Give what a camera needs beside the defaults, as a ROS parameter file."""
    text, values = PRESETS[name]
    lines = [f'# {text}', '/**:', '  ros__parameters:']
    lines += [f'    {key}: {_value(value)}' for key, value in values.items()]
    return '\n'.join(lines) + '\n'


def table_text(declared: tuple[Field[Any], ...]) -> str:
    """Give parameters as a Markdown table."""
    lines = ['| parameter | default | limits | |', '|---|---|---|---|']
    for knob in declared:
        lines.append(
            f'| `{knob.name}` | {_value(knob.default)} | {_limits(knob)} | '
            f'{knob.metadata["help"]} |'
        )
    return '\n'.join(lines) + '\n'


def topics_text(rows: Iterable[tuple[str, str, str]]) -> str:
    """Give topics with their types, and what is said of them, as a Markdown table."""
    lines = ['| topic | type | |', '|---|---|---|']
    lines += [f'| `{name}` | {kind.replace("/msg/", "/")} | {text} |' for name, kind, text in rows]
    return '\n'.join(lines) + '\n'


def modes_text() -> str:
    """Give the modes with their CPU times, as scripts/bench_speed.py left them."""
    spent = json.loads((ROOT / 'docs/speed.json').read_text())['modes']
    lines = [
        '| `mode` | the motion | the image | first frame, next ones | for |',
        '|---' * 5 + '|',
    ]
    for mode, (motion, image, purpose) in MODES.items():
        found = [spent.get(f'{mode}, {start}') for start in ('cold', 'tracking')]
        cost = ', '.join(f'{entry["cpu"]:.2g} s' for entry in found if entry)
        lines.append(f'| {mode} | {motion} | {image} | {cost} | {purpose} |')
    return '\n'.join(lines) + '\n'


def tables() -> dict[str, str]:
    """Give the tables of the README by their marks."""
    sources = settings_from({}).sources()
    taken = [(source.topic, source.kind, INPUTS[k]) for k, source in sources.items()]
    given = [(name, kind, RESULTS[name]) for name, kind in TYPES.items()]
    return {
        'results': topics_text(given),
        'node topics': topics_text([*taken, *OTHERS]),
        'modes': modes_text(),
        'parameters': table_text(knobs()),
        'node parameters': table_text(fields(NodeParams)),
    }


def with_tables(readme: str) -> str:
    """Give the README with the tables between their marks renewed."""
    for name, text in tables().items():
        begin, end = f'<!-- {name} -->\n', f'<!-- end of {name} -->\n'
        head, rest = readme.split(begin)
        readme = head + begin + text + end + rest.split(end)[1]
    return readme


def _limits(knob: Field[Any]) -> str:
    if 'choices' in knob.metadata:
        return 'one of ' + ', '.join(knob.metadata['choices'])
    if 'low' in knob.metadata:
        return f'{_value(knob.metadata["low"])} to {_value(knob.metadata["high"])}'
    return 'true, false' if isinstance(knob.default, bool) else ''


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if value == '':
        return "''"
    text = str(value)  # 1e-05 alone is text to YAML 1.1
    return text if '.' in text or not isinstance(value, float) else text.replace('e', '.0e')


if __name__ == '__main__':
    (ROOT / 'config/deblur.yaml').write_text(yaml_text())
    for preset in PRESETS:
        (ROOT / f'config/presets/{preset}.yaml').write_text(preset_text(preset))
    page = ROOT / 'README.md'
    page.write_text(with_tables(page.read_text()))
