"""The rules of the house, as far as a machine can check them."""

import ast
from dataclasses import asdict
from pathlib import Path
import re
import runpy
import subprocess
import sys
import xml.etree.ElementTree as ET

from depth_deblur_ros.core.params import SolverParams
from depth_deblur_ros.settings import NodeParams
import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / 'depth_deblur_ros'
SOURCES = sorted(PACKAGE.rglob('*.py'))
CORE = sorted((PACKAGE / 'core').rglob('*.py'))
ROS = {
    'builtin_interfaces',
    'cv_bridge',
    'diagnostic_msgs',
    'geometry_msgs',
    'message_filters',
    'rcl_interfaces',
    'rclpy',
    'sensor_msgs',
    'std_msgs',
}
NUMERICAL = {'cv2', 'llvmlite', 'numba', 'numpy', 'scipy'}  # llvmlite comes with numba
BODY_LIMIT, FILE_LIMIT, POSITIONAL_LIMIT = 35, 330, 5  # lines, lines, arguments

each_source = pytest.mark.parametrize('path', SOURCES, ids=lambda p: str(p.relative_to(PACKAGE)))


def imports(path):
    tree = ast.parse(path.read_text())
    names = {a.name for n in ast.walk(tree) if isinstance(n, ast.Import) for a in n.names}
    return names | {n.module for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)}


def importers(libraries):
    return {p.name for p in SOURCES if libraries & {m.split('.')[0] for m in imports(p)}}


def functions(path):
    kinds = ast.FunctionDef | ast.AsyncFunctionDef
    return [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, kinds)]


def test_only_the_node_knows_ros():
    assert importers(ROS) == {'node.py'}


def test_only_bag_knows_the_bag_libraries():
    assert importers({'mcap', 'mcap_ros2', 'rosbags'}) == {'bag.py', 'mcap_file.py'}


@pytest.mark.parametrize('path', CORE, ids=lambda p: p.name)
def test_core_imports_core_and_numerical_libraries_alone(path):
    own = {m for m in imports(path) if m.startswith('depth_deblur_ros')}
    assert all(m.startswith('depth_deblur_ros.core') for m in own)
    others = {m.split('.')[0] for m in imports(path) - own}
    assert others <= NUMERICAL | sys.stdlib_module_names
    assert not others & {'io', 'logging', 'os', 'pathlib', 'shutil', 'tempfile'}


@each_source
def test_nothing_but_the_command_line_prints_or_exits(path):
    calls = [n.func for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Call)]
    names = {ast.unparse(call) for call in calls}
    assert path.name == 'cli.py' or 'print' not in names
    assert path.name == '__main__.py' or not names & {'exit', 'quit', 'sys.exit'}
    assert path.name == 'node.py' or 'os._exit' not in names


@each_source
def test_no_file_has_a_name_that_says_nothing(path):
    assert not re.search('util|helper|manager|base|common|misc', path.stem)


@each_source
def test_what_is_public_has_a_docstring(path):
    tree = ast.parse(path.read_text())
    assert path.name == '__init__.py' or ast.get_docstring(tree)
    public = [n for n in tree.body if not getattr(n, 'name', '_').startswith('_')]
    members = [m for n in public if isinstance(n, ast.ClassDef) for m in n.body]
    for found in public + [m for m in members if isinstance(m, ast.FunctionDef)]:
        assert found.name.startswith('_') or ast.get_docstring(found), found.name


@each_source
def test_files_and_bodies_are_short(path):
    assert len(path.read_text().splitlines()) <= FILE_LIMIT
    for function in functions(path):
        first = function.body[1 if ast.get_docstring(function) and function.body[1:] else 0]
        length = function.end_lineno - first.lineno + 1
        assert length <= BODY_LIMIT, f'{function.name} has {length} lines'


@each_source
def test_nobody_takes_more_than_five_positional_arguments(path):
    compiled = re.compile('njit|vectorize')  # these know no records
    for function in functions(path):
        if any(compiled.search(ast.unparse(d)) for d in function.decorator_list):
            continue
        names = [a.arg for a in function.args.args if a.arg not in ('self', 'cls')]
        assert len(names) <= POSITIONAL_LIMIT, function.name


def test_the_config_file_holds_the_defaults():
    text = (ROOT / 'config/deblur.yaml').read_text()
    defaults = asdict(SolverParams()) | asdict(NodeParams())
    assert yaml.safe_load(text) == {'/**': {'ros__parameters': defaults}}


def test_config_and_readme_are_up_to_date():
    written = runpy.run_path(str(ROOT / 'scripts/write_defaults.py'))
    readme = (ROOT / 'README.md').read_text()
    assert (ROOT / 'config/deblur.yaml').read_text() == written['yaml_text']()
    assert readme == written['with_tables'](readme), 'run scripts/write_defaults.py'
    presets = {path.stem: path.read_text() for path in (ROOT / 'config/presets').iterdir()}
    assert presets == {name: written['preset_text'](name) for name in written['PRESETS']}


def test_the_version_stands_in_package_xml_alone():
    version = ET.parse(ROOT / 'package.xml').getroot().findtext('version')
    asked = [sys.executable, 'setup.py', '--version']
    said = subprocess.run(asked, capture_output=True, text=True, cwd=ROOT).stdout
    assert said.split()[-1] == version
    assert version not in (ROOT / 'setup.py').read_text()
    releases = re.findall(r'^(\d+\.\d+\.\d+) \(', (ROOT / 'CHANGELOG.rst').read_text(), re.M)
    assert releases[0] == version


def test_package_xml_and_setup_py_need_the_same():
    """But for the libraries of bags, which rosdep does not know everywhere."""
    same = {'opencv-python-headless': 'opencv', 'PyYAML': 'yaml'}
    bags = {'lz4', 'mcap', 'rosbags', 'zstandard'}
    text = (ROOT / 'setup.py').read_text()
    listed = re.findall(r"'([\w-]+)", re.search(r'install_requires=\[(.*?)\]', text, re.S)[1])
    by_pip = {same.get(name, name) for name in listed} - bags - {'setuptools'}
    root = ET.parse(ROOT / 'package.xml').getroot()
    keys = [found.text for found in root.findall('depend')]
    assert by_pip == {k.removeprefix('python3-') for k in keys if k.startswith('python3-')}
    used = {m.split('.')[0] for m in imports(PACKAGE / 'node.py')} & ROS
    assert {k for k in keys if not k.startswith('python3-')} == used
    readme = (ROOT / 'README.md').read_text()
    for key in [*keys, *(found.text for found in root.findall('test_depend'))]:
        assert f'`{key}`' in readme, f'README.md does not list {key}'


@pytest.mark.parametrize(
    'name', ['README.md', 'CONTRIBUTING.md', *Path(ROOT / 'docs').glob('*.md')]
)
def test_links_lead_somewhere(name):
    page = ROOT / name
    for target in re.findall(r'\]\((?!http)([^)#]+)', page.read_text()):
        assert (page.parent / target).exists(), target


def test_pictures_in_the_docs_are_small():
    for path in (ROOT / 'docs').iterdir():
        assert path.suffix == '.md' or path.stat().st_size < 200_000, path.name


def test_the_core_works_without_ros_and_bag_libraries():
    blocked = sorted(ROS | {'lz4', 'mcap', 'mcap_ros2', 'rosbags', 'zstandard', 'yaml', 'tqdm'})
    code = f"""
import sys
sys.modules.update(dict.fromkeys({blocked}))
from depth_deblur_ros import CameraIntrinsics, deblur, RgbdFrame
import numpy as np
rng = np.random.default_rng(0)
camera = CameraIntrinsics(60.0, 60.0, 31.5, 23.5, 64, 48)
image = rng.random((48, 64, 3), np.float32)
print(deblur(RgbdFrame(image, np.ones((48, 64), np.float32), camera)).outcome.value)
"""
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert done.stdout.strip() in ('sharp', 'solved', 'failed')
