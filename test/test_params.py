"""Parameters: bounds, kinds, names."""

from dataclasses import asdict, FrozenInstanceError, replace
import math

from depth_deblur_ros.core.data import InputError
from depth_deblur_ros.core.params import knobs, params_from_mapping, SolverParams
import pytest

NUMBERS = [knob for knob in knobs() if 'low' in knob.metadata]
CHOICES = [knob for knob in knobs() if 'choices' in knob.metadata]
each_number = pytest.mark.parametrize('knob', NUMBERS, ids=lambda knob: knob.name)


def test_every_parameter_has_a_text_and_every_number_has_bounds():
    assert NUMBERS
    assert CHOICES
    for knob in knobs():
        assert knob.metadata['help']
        assert (knob in NUMBERS) == (type(knob.default) in (int, float))


@each_number
def test_both_bounds_are_allowed_and_what_lies_beyond_is_refused(knob):
    low, high = knob.metadata['low'], knob.metadata['high']
    assert low <= knob.default <= high
    for value in (low, high):
        assert getattr(SolverParams(**{knob.name: value}), knob.name) == value
    for value in (low - 1, high + 1, math.inf, -math.inf, math.nan):
        with pytest.raises(InputError) as error:
            SolverParams(**{knob.name: value})
        assert str(error.value) == f'{knob.name} must lie in [{low}, {high}], got {value}'


@each_number
@pytest.mark.parametrize('value', ['3', None, True, [3]])
def test_a_number_must_be_a_number(knob, value):
    with pytest.raises(InputError, match=f'{knob.name} must be of type (int|float), got '):
        SolverParams(**{knob.name: value})


@each_number
def test_a_value_takes_the_kind_of_its_default(knob):
    low = knob.metadata['low']
    given = float(low) if isinstance(knob.default, int) else low
    kept = getattr(SolverParams(**{knob.name: given}), knob.name)
    assert type(kept) is type(knob.default)
    if isinstance(knob.default, int):
        with pytest.raises(InputError, match=rf'{knob.name} must be of type int, got {low + 0.5}'):
            SolverParams(**{knob.name: low + 0.5})


@pytest.mark.parametrize('knob', CHOICES, ids=lambda knob: knob.name)
def test_a_choice_names_what_there_is_to_choose(knob):
    for value in knob.metadata['choices']:
        assert getattr(SolverParams(**{knob.name: value}), knob.name) == value
    for value in ('', 'FULL', 3, None):
        with pytest.raises(InputError) as error:
            SolverParams(**{knob.name: value})
        assert all(choice in str(error.value) for choice in knob.metadata['choices'])
        assert repr(value) in str(error.value)


def test_names_and_values_make_parameters():
    assert params_from_mapping({}) == SolverParams()
    assert params_from_mapping(asdict(SolverParams())) == SolverParams()
    base = SolverParams(threads=7)
    mixed = params_from_mapping({'mode': 'fast'}, base)
    assert (mixed.threads, mixed.mode) == (7, 'fast')


def test_an_unknown_name_is_refused_with_those_that_are_known():
    with pytest.raises(InputError) as error:
        params_from_mapping({'thread': 2})
    assert "unknown parameter 'thread'" in str(error.value)
    assert all(knob.name in str(error.value) for knob in knobs())


def test_parameters_are_frozen_and_checked_when_replaced():
    params = SolverParams()
    with pytest.raises(FrozenInstanceError):
        params.threads = 4
    with pytest.raises(InputError, match='threads must lie in'):
        replace(params, threads=0)
