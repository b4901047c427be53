"""Garbage into every decoder: an InputError of one line may come out, and nothing else."""

import importlib.util
from pathlib import Path
import random
import subprocess
import sys

import fuzz
from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

FUZZ = Path(fuzz.__file__)
every_decoder = pytest.mark.parametrize('name', fuzz.DECODERS)


@pytest.fixture(scope='module')
def sound():
    return {name: fuzz.seeds(name) for name in fuzz.DECODERS}


@every_decoder
def test_sound_inputs_are_taken(name, sound):
    taken = [fuzz.decode(name, data) for data in sound[name]]
    assert any(taken)


@pytest.mark.filterwarnings('ignore:invalid value:RuntimeWarning')
@every_decoder
@settings(max_examples=60)
@given(seed=st.integers(0, 2**32))
def test_sound_inputs_that_are_changed_raise_nothing_else(name, sound, seed):
    rng = random.Random(seed)
    data = bytearray(rng.choice(sound[name]))
    for _ in range(rng.randint(1, 8)):
        at = rng.randrange(len(data) + 1)
        change = rng.randrange(4)
        if change == 0:
            del data[at : at + rng.randint(1, 40)]
        elif change == 1:
            data[at:at] = rng.randbytes(rng.randint(1, 20))
        elif change == 2:
            data[at : at + 8] = rng.choice([0, 1, 2**31, 2**63, 2**64 - 1]).to_bytes(8, 'little')
        else:
            data[at : at + 1] = rng.randbytes(1)
    fuzz.decode(name, bytes(data))


@pytest.mark.filterwarnings('ignore:invalid value:RuntimeWarning')
@every_decoder
@settings(max_examples=60)
@given(data=st.binary(max_size=300))
def test_any_bytes_raise_nothing_else(name, data):
    fuzz.decode(name, data)


@pytest.mark.skipif(not importlib.util.find_spec('atheris'), reason='atheris is not installed')
@pytest.mark.parametrize('name', ['cdr', 'bag'])
def test_a_short_guided_run_finds_nothing(name, tmp_path):
    limits = ['-runs=20000', '-max_total_time=4', '-rss_limit_mb=3000', '-timeout=20']
    command = [sys.executable, FUZZ, name, '-seed=1', *limits]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, timeout=120)
    assert done.returncode == 0, done.stdout[-3000:].decode(errors='replace')
    assert b'DONE' in done.stderr
    assert not list(tmp_path.glob('crash-*'))
