"""Every tunable once: CLI flags, config/deblur.yaml and the README table come from here."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, Field, field, fields
import math
from typing import Any

from depth_deblur_ros.core.data import InputError

MODES = ('full', 'fast', 'motion')


def _knob(default: float, low: float, high: float, text: str) -> Any:
    return field(default=default, metadata={'low': low, 'high': high, 'help': text})


def _choice(default: str, choices: tuple[str, ...], text: str) -> Any:
    return field(default=default, metadata={'choices': choices, 'help': text})


@dataclass(frozen=True)
class SolverParams:
    """Solver settings, checked when made; InputError names the value and its bounds."""

    mode: str = _choice(
        'full', MODES, 'full: best image; fast: fewer image steps; motion: no image step'
    )
    threads: int = _knob(2, 1, 256, 'threads of the compiled kernels')
    prior: float = _knob(2.7, 0.01, 100.0, 'weight of the image prior: more is smoother [c]')
    reweightings: int = _knob(3, 1, 20, 'quadratic problems that the image step solves')
    cg_steps: int = _knob(10, 1, 100, 'conjugate gradient steps in each of them')

    def __post_init__(self) -> None:
        for knob in knobs():
            object.__setattr__(self, knob.name, _checked(knob, getattr(self, knob.name)))


def knobs() -> tuple[Field[Any], ...]:
    """Give the solver's parameters: name, default, metadata (low and high, or choices; help)."""
    return fields(SolverParams)


def params_from_mapping(
    values: Mapping[str, Any], base: SolverParams | None = None
) -> SolverParams:
    """Make parameters from names and values, the others as in base; refuse unknown names."""
    known = {knob.name for knob in knobs()}
    for name in values:
        if name not in known:
            raise InputError(f'unknown parameter {name!r}; known are {", ".join(sorted(known))}')
    start = base or SolverParams()
    return SolverParams(**{name: values.get(name, getattr(start, name)) for name in known})


def _checked(knob: Field[Any], value: Any) -> Any:
    if 'choices' in knob.metadata:
        if value not in knob.metadata['choices']:
            raise InputError(
                f'{knob.name} must be one of {knob.metadata["choices"]}, got {value!r}'
            )
        return value
    kind: Any = type(knob.default)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f'{knob.name} must be of type {kind.__name__}, got {value!r}')
    low, high = knob.metadata['low'], knob.metadata['high']
    if not math.isfinite(value) or not low <= value <= high:
        raise InputError(f'{knob.name} must lie in [{low}, {high}], got {value}')
    if kind(value) != value:
        raise InputError(f'{knob.name} must be of type {kind.__name__}, got {value!r}')
    return kind(value)
