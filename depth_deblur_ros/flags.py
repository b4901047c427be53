"""
Flags that commands share, and what they are turned into.

Whatever cannot work raises an InputError of one line.
"""

from __future__ import annotations

import argparse
from dataclasses import Field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
import re
from typing import Any, NoReturn

from depth_deblur_ros.core.data import InputError
from depth_deblur_ros.core.params import knobs, params_from_mapping, SolverParams
import yaml

TRUTHS = {'true': True, 'false': False}


class Parser(argparse.ArgumentParser):
    """Say what is wrong in one line, as for every other bad input; show usage in one, too."""

    def error(self, message: str) -> NoReturn:
        """Refuse the line; --help tells the rest."""
        raise InputError(f'{message} (see {self.prog} --help)')

    def format_help(self) -> str:
        """Begin with what is needed alone: every flag stands in the list below it."""
        needed = self._get_formatter()
        needed.add_usage(None, [action for action in self._actions if action.required], [], '')
        self.usage = f'{needed.format_help().strip()} [options]'
        return super().format_help()


class _RosYaml(yaml.SafeLoader):
    """Read 1e-05 as a number, as ROS does; YAML 1.1 takes it for text."""


_RosYaml.add_implicit_resolver(
    'tag:yaml.org,2002:float', re.compile(r'[-+]?\d+(\.\d*)?[eE][-+]?\d+$'), list('-+0123456789')
)


def installed_version() -> str:
    """Give the version, which stands in package.xml, as installing has noted it."""
    try:
        return version('depth_deblur_ros')
    except PackageNotFoundError:
        return 'not installed'


def topic(text: str) -> tuple[str, str]:
    """Split NAME=TOPIC."""
    name, equals, topic = text.partition('=')
    if not (name and equals and topic):
        raise argparse.ArgumentTypeError(f'{text!r} is not of the form NAME=TOPIC')
    return name, topic


def truth(text: str) -> bool:
    """Read true or false."""
    if text.lower() not in TRUTHS:
        raise argparse.ArgumentTypeError(f'{text!r} is neither true nor false')
    return TRUTHS[text.lower()]


def solver_flags(parser: Parser) -> None:
    """Add --params and one flag for each solver parameter; a flag counts more than the file."""
    group = parser.add_argument_group('solver parameters')
    group.add_argument('--params', type=Path, metavar='FILE', help='YAML, as ROS takes it')
    for knob in knobs():
        _knob_flag(group, knob)


def _knob_flag(group: argparse._ActionsContainer, knob: Field[Any]) -> None:
    meta = knob.metadata
    limits = 'TEXT'
    if 'choices' in meta:
        limits = '|'.join(meta['choices'])
    elif isinstance(knob.default, bool):
        limits = '|'.join(TRUTHS)
    elif 'low' in meta:
        limits = f'{meta["low"]}..{meta["high"]}'
    group.add_argument(
        '--' + knob.name.replace('_', '-'),
        type=truth if isinstance(knob.default, bool) else type(knob.default),
        default=argparse.SUPPRESS,
        metavar=limits,
        help=f'{meta["help"]} (default: {_shown(knob.default)})'.replace('%', '%%'),
    )


def source_flags(parser: Parser) -> None:
    """Add the flags that say which topics of a bag are meant."""
    parser.add_argument('--camera', type=Path, help='camera.json instead of the camera_info topic')
    parser.add_argument(
        '--topics',
        nargs='+',
        type=topic,
        metavar='NAME=TOPIC',
        help='for colour, depth, info, exposure (default: the usual names, else the only fit)',
    )


def rectified_flag(parser: Parser) -> None:
    """Add the one solver parameter that counts where a solved bag is only read."""
    _knob_flag(parser, next(knob for knob in knobs() if knob.name == 'rectified'))


def _shown(value: Any) -> str:
    return str(value).lower() if isinstance(value, bool) else str(value)


def solver_params(args: argparse.Namespace) -> SolverParams:
    """Give the parameters of the line, else of its file, else the defaults."""
    file = getattr(args, 'params', None)
    base = params_from_mapping(read_params(file) if file else {})
    given = {knob.name: getattr(args, knob.name) for knob in knobs() if hasattr(args, knob.name)}
    return params_from_mapping(given, base)


def read_params(path: Path) -> dict[str, Any]:
    """Read the solver's part of a ROS parameter file, under /**: ros__parameters:."""
    from depth_deblur_ros.settings import without_node_values

    try:
        content = yaml.load(path.read_text(), _RosYaml)
    except OSError as error:
        raise InputError(f'cannot read {path}: {error.strerror}') from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        line = ' '.join(str(error).split())
        raise InputError(f'{path} is not YAML: {line}') from error
    try:
        return without_node_values(content['/**']['ros__parameters'])
    except (AttributeError, KeyError, TypeError):
        raise InputError(f'{path} must hold /**: ros__parameters: NAME: VALUE') from None
