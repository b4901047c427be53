"""Compiling is announced once, and only where it happens."""

import os
from pathlib import Path
import subprocess
import sys

import pytest

SOURCE = """
import sys
from depth_deblur_ros.compiling import tell_of_compiling
tell_of_compiling(lambda text: print(text, file=sys.stderr))
from depth_deblur_ros.core.light import light_from_stored
import numpy as np
light_from_stored(np.ones(4, np.float32), 'srgb')
light_from_stored(np.ones((4, 4), np.float32), 'srgb')
"""


@pytest.fixture
def read_only(tmp_path):
    """Give a copy of the package that cannot be written, and a home for caches."""
    package = Path(__file__).resolve().parents[1] / 'depth_deblur_ros'
    for path in package.rglob('*.py'):
        copy = tmp_path / 'lib' / path.relative_to(package.parent)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(path.read_bytes())
        (
            copy.parent / '__pycache__'
        ).touch()  # a file: no cache can be made there, not even by root
    return tmp_path


def run(folder):
    home = {'HOME': str(folder), 'XDG_CACHE_HOME': str(folder / 'cache')}
    env = {k: v for k, v in os.environ.items() if k not in ('NUMBA_CACHE_DIR', 'PYTHONPATH')}
    env |= {'PYTHONPATH': str(folder / 'lib'), 'PYTHONDONTWRITEBYTECODE': '1', **home}
    command = [sys.executable, '-c', SOURCE]
    done = subprocess.run(command, env=env, cwd=folder, check=True, capture_output=True, text=True)
    return done.stderr


def test_the_first_run_says_so_and_the_second_finds_the_kernels_elsewhere(read_only):
    first = run(read_only)
    assert first.count('compiling kernels') == 1
    assert str(read_only / 'cache') in first
    assert run(read_only) == ''
