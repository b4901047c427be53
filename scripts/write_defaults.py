"""Write config/deblur.yaml, the camera presets and the README's parameter tables from the code."""

from dataclasses import Field, fields
from pathlib import Path
from typing import Any

from depth_deblur_ros.core.params import knobs
from depth_deblur_ros.settings import NodeParams

ROOT = Path(__file__).resolve().parents[1]
TABLES = {'parameters': knobs(), 'node parameters': fields(NodeParams)}
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
    for name, declared in TABLES.items():
        if name == 'node parameters':
            lines.append('    # --- the live node alone ---')
        for knob in declared:
            limits = f'; {_limits(knob)}' if _limits(knob) else ''
            lines += [
                f'    # {knob.metadata["help"]}{limits}',
                f'    {knob.name}: {_value(knob.default)}',
            ]
    return '\n'.join(lines) + '\n'


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


def with_table(readme: str) -> str:
    """Give the README with the tables between their marks renewed."""
    for name, declared in TABLES.items():
        begin, end = f'<!-- {name} -->\n', f'<!-- end of {name} -->\n'
        head, rest = readme.split(begin)
        readme = head + begin + table_text(declared) + end + rest.split(end)[1]
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
    page.write_text(with_table(page.read_text()))
