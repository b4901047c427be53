"""What pip and colcon make of the package, in a copy of what a clone holds."""

import os
from pathlib import Path
import shutil
import subprocess
import sys
import sysconfig
from zipfile import ZipFile

import pytest

ROOT = Path(__file__).resolve().parents[1]
NAME = 'depth_deblur_ros'


def run(*command, **options):
    done = subprocess.run(
        [str(word) for word in command], capture_output=True, text=True, timeout=200, **options
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


@pytest.fixture(scope='module')
def clone(tmp_path_factory):
    """Copy the files that git knows, as they are now."""
    if not (ROOT / '.git').exists() or not shutil.which('git'):
        pytest.skip('not a git checkout')
    target = tmp_path_factory.mktemp('workspace') / 'src' / NAME
    for name in run('git', 'ls-files', cwd=ROOT).splitlines():
        if (ROOT / name).is_file():
            (target / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, target / name)
    return target


@pytest.fixture
def colcon():
    pytest.importorskip('colcon_ros')
    return Path(sys.executable).parent / 'colcon'


def test_colcon_takes_it_for_an_ament_python_package(clone, colcon):
    assert run(colcon, 'list', cwd=clone.parents[1]).split() == [
        NAME,
        f'src/{NAME}',
        '(ros.ament_python)',
    ]


def test_colcon_puts_replay_where_ros_looks_for_it(clone, colcon):
    workspace = clone.parents[1]
    run(colcon, 'build', '--packages-select', NAME, cwd=workspace)
    prefix = workspace / 'install' / NAME
    assert (prefix / 'share/ament_index/resource_index/packages' / NAME).is_file()
    assert (prefix / 'share' / NAME / 'package.xml').is_file()
    assert (prefix / 'share' / NAME / 'config/deblur.yaml').is_file()
    # `ros2 run` does no more than this: find the executable under lib/<package>/ and start it.
    executables = sorted(p.name for p in (prefix / 'lib' / NAME).iterdir())
    assert {'deblur_node', 'depth-deblur', 'replay'} <= set(executables)
    started = f'. install/setup.bash && exec {prefix}/lib/{NAME}/replay --help'
    assert 'usage: depth-deblur replay' in run('bash', '-c', started, cwd=workspace)


@pytest.mark.ros
def test_the_node_starts_as_ros2_run_starts_it(clone, colcon, tmp_path, monkeypatch):
    index = pytest.importorskip('ament_index_python')
    import ros_parts

    workspace = clone.parents[1]
    run(colcon, 'build', '--packages-select', NAME, cwd=workspace)
    monkeypatch.setenv('AMENT_PREFIX_PATH', str(workspace / 'install' / NAME))
    prefix = Path(index.get_package_prefix(NAME))
    config = Path(index.get_package_share_directory(NAME)) / 'config'
    assert (config / 'presets/tum_fr1.yaml').is_file()
    ros_parts.private_domain(monkeypatch)
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', str(config / 'fastdds.xml'))
    arguments = f'--ros-args --params-file {config}/deblur.yaml -p lazy:=false'
    line = f'. {workspace}/install/setup.bash && exec {prefix}/lib/{NAME}/deblur_node {arguments}'
    peer, node = ros_parts.Peer(), ros_parts.Process(['bash', '-c', line], tmp_path / 'log')
    try:
        peer.until(lambda: peer.status()[0].startswith('nothing on /rgb/image_rect_color'), 200)
        assert peer.status()[1]['mode'] == 'full'
        assert node.stop() == 0, node.text()
    finally:
        peer.close()
        node.kill()


def test_a_wheel_can_be_made_of_the_sdist(clone, tmp_path):
    make = f"from setuptools import build_meta; build_meta.build_sdist('{tmp_path}')"
    run(sys.executable, '-c', make, cwd=clone)
    (sdist,) = tmp_path.glob('*.tar.gz')
    pip = [sys.executable, '-m', 'pip', '--disable-pip-version-check']
    run(*pip, 'wheel', '--no-deps', '--no-build-isolation', '-w', tmp_path, sdist)
    (wheel,) = tmp_path.glob('*.whl')
    held = {name.partition('/data/')[2] or name for name in ZipFile(wheel).namelist()}
    config = {str(path.relative_to(clone)) for path in (clone / 'config').rglob('*.*')}
    share = f'share/{NAME}'
    assert {f'{share}/package.xml', *(f'{share}/{name}' for name in config)} <= held
    modules = {str(path.relative_to(clone)) for path in (clone / NAME).rglob('*.py')}
    assert {f'{NAME}/py.typed', *modules} <= held


def test_a_wheel_puts_depth_deblur_on_the_path(clone, tmp_path):
    pip = [sys.executable, '-m', 'pip', '--disable-pip-version-check']
    run(*pip, 'wheel', '--no-deps', '--no-build-isolation', '-w', tmp_path, clone)
    (wheel,) = tmp_path.glob('*.whl')
    run(sys.executable, '-m', 'venv', '--without-pip', tmp_path / 'venv')
    python = tmp_path / 'venv/bin/python'
    run(*pip, '--python', python, 'install', '--no-deps', wheel)
    libraries = {**os.environ, 'PYTHONPATH': sysconfig.get_path('purelib')}
    assert 'replay' in run(python.parent / 'depth-deblur', '--help', env=libraries, cwd=tmp_path)
    where = run(
        python, '-c', f'import {NAME}; print({NAME}.__file__)', env=libraries, cwd=tmp_path
    )
    assert Path(where.strip()).is_relative_to(tmp_path)
    assert (Path(where.strip()).parent / 'py.typed').is_file()
    assert (tmp_path / 'venv/share' / NAME / 'config/deblur.yaml').is_file()
