"""Compiling is announced once, and only where it happens."""

import os
from pathlib import Path
import subprocess
import sys
from types import SimpleNamespace

from depth_deblur_ros import compiling
from depth_deblur_ros.core import descent, leaning
from depth_deblur_ros.core.data import CameraIntrinsics, Motion, Outcome, RgbdFrame
from depth_deblur_ros.core.joint import Effort, refine
from depth_deblur_ros.core.solver import restore_known
from depth_deblur_ros.core.start import Start
import numpy as np
import pytest

HELPED = descent._descend, leaning._lean_rows

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


def test_the_helper_compiles_what_a_frame_needs():
    """Another kind of array would be compiled for nothing."""
    rng = np.random.default_rng(0)
    camera = CameraIntrinsics(64.0, 64.0, 31.5, 31.5, 96, 96)
    frame = RgbdFrame(rng.random((96, 96, 3), np.float32), np.ones((96, 96), np.float32), camera)
    turn = Motion(np.array([0.0, 0.05, 0.0]), np.zeros(3), covariance=1e-4 * np.eye(6))
    restore_known(frame, turn)
    start = Start(turn, Outcome.SOLVED, 1.0, spread=1e-4 * np.eye(9))
    refine(frame.image[..., 0].copy(), frame.depth, camera, start, Effort(moves=1))
    needed = [set(kernel.signatures) for kernel in HELPED]
    compiling.main()
    assert all(needed)
    assert needed == [set(kernel.signatures) for kernel in HELPED]


@pytest.mark.parametrize(
    ('module', 'cache', 'cores', 'said', 'called'),
    [
        ('depth_deblur_ros.core.light', '/cache', 2, 1, 1),
        ('depth_deblur_ros.core.light', '/cache', 1, 1, 0),
        ('depth_deblur_ros.core.light', None, 2, 1, 0),  # what it compiled would be lost
        ('skimage.filters', '/cache', 2, 0, 0),
    ],
)
def test_a_helper_is_called_where_it_is_of_use(monkeypatch, module, cache, cores, said, called):
    lines, calls = [], []
    monkeypatch.setattr(compiling, 'call_helper', lambda: calls.append(1))
    monkeypatch.setattr(compiling, 'cores', lambda: cores)
    teller = compiling._Teller(lines.append)
    kernel = SimpleNamespace(
        py_func=SimpleNamespace(__module__=module), stats=SimpleNamespace(cache_path=cache)
    )
    for _ in range(2):
        teller.on_start(SimpleNamespace(data={'dispatcher': kernel}))
    assert (len(lines), len(calls)) == (said, called)


def forget_helper():
    """Let the helper end, if there is one, and the next be another."""
    helper = compiling.call_helper() if compiling.call_helper.cache_info().currsize else None
    compiling.call_helper.cache_clear()
    if helper:
        helper.stdin.close()
        helper.wait(120)


@pytest.fixture
def fresh_helper():
    """Call it as if nobody had before."""
    forget_helper()
    yield compiling.call_helper
    forget_helper()


def test_a_helper_is_called_once_and_does_its_work(fresh_helper):
    helper = fresh_helper()
    assert fresh_helper() is helper
    assert helper.wait(120) == 0


def test_a_helper_that_is_left_alone_ends_before_its_next_kernel(
    fresh_helper, monkeypatch, tmp_path
):
    monkeypatch.setenv('NUMBA_CACHE_DIR', str(tmp_path))
    helper = fresh_helper()
    helper.stdin.close()  # as when this process ends, however it ends
    assert helper.wait(120) == 0
    assert not list(tmp_path.rglob('*descend*.nbc'))


def test_without_a_helper_nothing_is_lost(fresh_helper, monkeypatch):
    monkeypatch.setattr(sys, 'executable', '/nothing/there')
    assert fresh_helper() is None
