"""Every tunable once: CLI flags, config/deblur.yaml and the README table come from here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, Field, field, fields
import math
from typing import Any

from depth_deblur_ros.core.data import InputError

MODES = ('full', 'fast', 'motion')
METHODS = ('spectra', 'paper')
STAMPS = ('start', 'middle', 'end')


def knob(default: float, low: float, high: float, text: str) -> Any:
    """Declare a number with its limits."""
    return field(default=default, metadata={'low': low, 'high': high, 'help': text})


def choice(default: str, choices: tuple[str, ...], text: str) -> Any:
    """Declare one of a few words."""
    return field(default=default, metadata={'choices': choices, 'help': text})


def free(default: bool | str, text: str) -> Any:
    """Declare a switch, or a text without limits."""
    return field(default=default, metadata={'help': text})


@dataclass(frozen=True)
class SolverParams:
    """Solver settings, checked when made; InputError names the value and its bounds."""

    mode: str = choice(
        'full', MODES, 'full: best image; fast: fewer image steps; motion: no image step'
    )
    neighbours: str = choice(
        'heed',
        ('heed', 'ignore'),
        'heed: the frames around one tell its sign and exposure; ignore: each frame alone',
    )
    gyro_rotation: str = free(
        '0 0 0 1', "from the gyro's axes to the camera's, as a quaternion x y z w"
    )
    gyro_noise: float = knob(0.01, 0.0, 1.0, 'of a reading of the gyro, at least [rad/s]')
    gyro_bias: float = knob(0.05, 0.0, 10.0, 'of the gyro, standard deviation [rad/s]')
    gyro_delay_s: float = knob(
        0.0, -1.0, 1.0, "how far the gyro's stamps are behind the camera's, mid-exposure [s]"
    )
    rectified: bool = free(True, 'P of camera_info counts; false: K and D, undistorts first')
    stamp_at: str = choice(
        'middle', STAMPS, 'which instant of the exposure the stamp of an image means'
    )
    threads: int = knob(2, 1, 256, 'threads of the compiled kernels')
    prior: float = knob(2.7, 0.01, 100.0, 'weight of the image prior: more is smoother [c]')
    reweightings: int = knob(3, 1, 20, 'quadratic problems that the image step solves')
    cg_steps: int = knob(10, 1, 100, 'conjugate gradient steps in each of them')
    method: str = choice(
        'spectra', METHODS, "paper: the paper's method and the parameters below; slow, a baseline"
    )
    mu1: float = knob(-20.0, -50.0, 0.0, 'paper: reward of motion')
    mu2: float = knob(0.2, 0.0, 1e6, 'paper: smoothness of the flow, less at edges of the image')
    mu3: float = knob(0.2, 0.0, 1e6, 'paper: smoothness of the flow, less at edges of the depth')
    mu4: float = knob(0.05, 0.0, 100.0, 'paper: total variation, for values 0..255')
    sigma_b: float = knob(0.01, 0.0001, 10.0, 'paper: edge of the image, light 0..1 per pixel')
    sigma_d: float = knob(0.02, 0.0001, 100.0, 'paper: edge of the depth, metres per pixel')
    eta: float = knob(10.0, 0.0001, 1000.0, 'paper: primal step')
    gamma: float = knob(0.005, 0.0, 10.0, 'paper: dual step, for values 0..255')
    levels: int = knob(11, 1, 30, 'paper: pyramid levels')
    scale_factor: float = knob(0.9, 0.5, 0.95, 'paper: from one level to the next')
    kernel_size: int = knob(25, 5, 49, 'paper: side of the uniform kernel, pixels')
    alternations: int = knob(3, 1, 50, 'paper: turns of motion and image at each level')
    primal_dual_steps: int = knob(20, 1, 1000, 'paper: steps of the last image step')

    def __post_init__(self) -> None:
        check_values(self)


def knobs(kind: type = SolverParams) -> tuple[Field[Any], ...]:
    """Give the parameters: name, default, metadata (help; low and high, or choices)."""
    return fields(kind)


def check_values(record: Any) -> None:
    """Refuse a record of parameters with a value that is not allowed."""
    for declared in fields(record):
        value = _checked(declared, getattr(record, declared.name))
        object.__setattr__(record, declared.name, value)


def params_from_mapping(
    values: Mapping[str, Any], base: SolverParams | None = None
) -> SolverParams:
    """Make parameters from names and values, the others as in base; refuse unknown names."""
    known = {declared.name for declared in knobs()}
    for name in values:
        if name not in known:
            raise InputError(f'unknown parameter {name!r}; known are {", ".join(sorted(known))}')
    start = base or SolverParams()
    return SolverParams(**{name: values.get(name, getattr(start, name)) for name in known})


def _checked(declared: Field[Any], value: Any) -> Any:
    if 'choices' in declared.metadata:
        if value not in declared.metadata['choices']:
            raise InputError(
                f'{declared.name} must be one of {declared.metadata["choices"]}, got {value!r}'
            )
        return value
    kind: Any = type(declared.default)
    if kind in (bool, str):
        if not isinstance(value, kind):
            raise InputError(f'{declared.name} must be of type {kind.__name__}, got {value!r}')
        return value
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f'{declared.name} must be of type {kind.__name__}, got {value!r}')
    low, high = declared.metadata['low'], declared.metadata['high']
    if not math.isfinite(value) or not low <= value <= high:
        raise InputError(f'{declared.name} must lie in [{low}, {high}], got {value}')
    if kind(value) != value:
        raise InputError(f'{declared.name} must be of type {kind.__name__}, got {value!r}')
    return kind(value)
