"""Write config/deblur.yaml and the README's parameter table from the solver's parameters."""

from dataclasses import Field
from pathlib import Path
from typing import Any

from depth_deblur_ros.core.params import knobs

ROOT = Path(__file__).resolve().parents[1]
BEGIN, END = '<!-- parameters -->\n', '<!-- end of parameters -->\n'


def yaml_text() -> str:
    """Give the defaults as a ROS parameter file."""
    lines = [
        '# The defaults of every solver parameter; change what you need, leave out the rest.',
        '/**:',
        '  ros__parameters:',
    ]
    for knob in knobs():
        lines += [
            f'    # {knob.metadata["help"]}; {_limits(knob)}',
            f'    {knob.name}: {_number(knob.default)}',
        ]
    return '\n'.join(lines) + '\n'


def table_text() -> str:
    """Give the parameters as a Markdown table."""
    lines = ['| parameter | default | limits | |', '|---|---|---|---|']
    for knob in knobs():
        lines.append(
            f'| `{knob.name}` | {_number(knob.default)} | {_limits(knob)} | '
            f'{knob.metadata["help"]} |'
        )
    return '\n'.join(lines) + '\n'


def with_table(readme: str) -> str:
    """Give the README with the table between its marks renewed."""
    head, rest = readme.split(BEGIN)
    return head + BEGIN + table_text() + END + rest.split(END)[1]


def _limits(knob: Field[Any]) -> str:
    if 'choices' in knob.metadata:
        return 'one of ' + ', '.join(knob.metadata['choices'])
    return f'{_number(knob.metadata["low"])} to {_number(knob.metadata["high"])}'


def _number(value: Any) -> str:
    text = str(value)  # 1e-05 alone is text to YAML 1.1
    return text if '.' in text or not isinstance(value, float) else text.replace('e', '.0e')


if __name__ == '__main__':
    (ROOT / 'config/deblur.yaml').write_text(yaml_text())
    readme = ROOT / 'README.md'
    readme.write_text(with_table(readme.read_text()))
