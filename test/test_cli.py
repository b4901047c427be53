"""The command line: its exit codes, and one clear line for whatever cannot work."""

import json
from pathlib import Path
import subprocess
import sys

import cv2
from depth_deblur_ros import cli, compiling, flags
from depth_deblur_ros.core.params import knobs, SolverParams
import numpy as np
import pytest

CAMERA = {
    'fx': 60.0,
    'fy': 60.0,
    'cx': 31.5,
    'cy': 23.5,
    'width': 64,
    'height': 48,
    'depth_scale': 1000,
    'exposure': 0.02,
    'transfer': 'srgb',
}


@pytest.fixture
def files(tmp_path):
    """Give a folder with a sharp-less little case: rgb.png, depth.png, camera.json."""
    rng = np.random.default_rng(0)
    cv2.imwrite(str(tmp_path / 'rgb.png'), rng.integers(0, 256, (48, 64, 3), np.uint8))
    cv2.imwrite(str(tmp_path / 'depth.png'), np.full((48, 64), 2000, np.uint16))
    (tmp_path / 'camera.json').write_text(json.dumps(CAMERA))
    return tmp_path


def image_command(files, *more):
    names = [str(files / name) for name in ('rgb.png', 'depth.png')]
    camera = ['--camera', str(files / 'camera.json'), '-o', str(files / 'out')]
    return ['image', *names, *camera, *more]


def refusal(argv, capsys):
    """Run a command that must be refused; give its one line."""
    assert cli.main(argv) == cli.BAD_INPUT
    shown = capsys.readouterr()
    assert shown.out == ''
    assert shown.err.startswith('depth-deblur: ')
    assert shown.err.count('\n') == 1 and shown.err.endswith('\n')
    return shown.err


def change_camera(files, **changes):
    (files / 'camera.json').write_text(json.dumps({**CAMERA, **changes}))


@pytest.mark.parametrize('command', ['', 'image', 'bench', 'import-tum', 'replay'])
def test_help_is_there_and_loads_nothing_heavy(command):
    code = f"""
import sys
from depth_deblur_ros import cli
try:
    cli.main({command.split()} + ['--help'])
except SystemExit as stop:
    assert not stop.code
assert not {{'numba', 'scipy', 'rosbags', 'cv2'}} & set(sys.modules)
"""
    done = subprocess.run([sys.executable, '-c', code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith('usage: depth-deblur')
    assert done.stdout.splitlines()[0].endswith(' [options]')


def test_the_module_runs_as_a_program():
    command = [sys.executable, '-m', 'depth_deblur_ros', 'image', 'a.png', 'b.png']
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 2
    assert 'arguments are required: --camera' in done.stderr
    assert done.stderr.count('\n') == 1


def test_the_version_is_that_of_package_xml(capsys):
    with pytest.raises(SystemExit) as stop:
        cli.main(['--version'])
    package = Path(__file__).resolve().parents[1] / 'package.xml'
    assert stop.value.code == 0
    assert f'<version>{capsys.readouterr().out.strip()}</version>' in package.read_text()


def test_what_solves_says_when_it_compiles(files, monkeypatch, capsys):
    monkeypatch.setattr(compiling, 'tell_of_compiling', lambda say: say('compiling'))
    (files / 'rgb.png').unlink()
    cli.main(image_command(files))
    assert capsys.readouterr().err.startswith('depth-deblur: compiling')


def test_a_flag_for_every_parameter():
    for knob in knobs():
        flag = '--' + knob.name.replace('_', '-')
        args = cli._parser().parse_args(['bench', 'cases', '-o', 'out', flag, str(knob.default)])
        assert getattr(args, knob.name) == knob.default
        assert flags.solver_params(args) == SolverParams()


def test_a_flag_counts_more_than_the_file(tmp_path):
    (tmp_path / 'p.yaml').write_text('/**:\n  ros__parameters:\n    threads: 3\n    mode: fast\n')
    argv = ['bench', 'cases', '-o', 'out', '--params', str(tmp_path / 'p.yaml'), '--threads', '5']
    assert flags.solver_params(cli._parser().parse_args(argv)) == SolverParams(
        threads=5, mode='fast'
    )


def test_what_the_node_is_told_of_its_images_counts_for_bags_too(tmp_path):
    (tmp_path / 'p.yaml').write_text(
        '/**:\n  ros__parameters:\n    rectified: false\n    stamp_at: end\n'
    )
    argv = ['replay', 'a', 'b', '--params', str(tmp_path / 'p.yaml')]
    assert not flags.solver_params(cli._parser().parse_args(argv)).rectified
    told = flags.solver_params(cli._parser().parse_args([*argv, '--rectified', 'true']))
    assert (told.rectified, told.stamp_at) == (True, 'end')


def test_a_switch_is_true_or_false(capsys):
    assert 'neither true nor false' in refusal(['replay', 'a', 'b', '--rectified', 'no'], capsys)


def test_the_shipped_config_is_a_parameter_file():
    path = Path(__file__).parents[1] / 'config/deblur.yaml'
    args = cli._parser().parse_args(['bench', 'cases', '-o', 'out', '--params', str(path)])
    assert flags.solver_params(args) == SolverParams()


@pytest.mark.parametrize('text', ['1e-05', '1.0e-05', '0.00001'])
def test_yaml_numbers_are_read_as_ros_reads_them(tmp_path, text):
    (tmp_path / 'p.yaml').write_text(f'/**:\n  ros__parameters:\n    x: {text}\n')
    assert flags.read_params(tmp_path / 'p.yaml') == {'x': 1e-05}


@pytest.mark.parametrize(
    'text, complaint',
    [
        ('', 'must hold /**: ros__parameters:'),
        ('[1, 2]', 'must hold /**: ros__parameters:'),
        ('threads: 2', 'must hold /**: ros__parameters:'),
        ('/**: {ros__parameters: 3}', 'must hold /**: ros__parameters:'),
        ('/**: {ros__parameters: {sharpness: 3}}', "unknown parameter 'sharpness'"),
        ('/**: {ros__parameters: {threads: 0}}', 'threads must lie in [1, 256], got 0'),
        ('/**: {ros__parameters: {threads: two}}', "threads must be of type int, got 'two'"),
        ('/**: {ros__parameters: {threads: .nan}}', 'threads must lie in [1, 256], got nan'),
        ('/**: {ros__parameters: {mode: best}}', "got 'best'"),
        ('a: [', 'is not YAML'),
        ('\x00', 'is not YAML'),
    ],
)
def test_a_bad_parameter_file_is_refused(files, capsys, text, complaint):
    (files / 'p.yaml').write_text(text)
    assert complaint in refusal(image_command(files, '--params', str(files / 'p.yaml')), capsys)


@pytest.mark.parametrize(
    'flags, complaint',
    [
        (['--threads', '0'], 'threads must lie in [1, 256], got 0'),
        (['--threads', 'two'], "invalid int value: 'two'"),
        (['--mode', 'best'], "got 'best'"),
        (['--params', 'nowhere.yaml'], 'cannot read nowhere.yaml: No such file'),
        (['--sharpness', '3'], 'unrecognized arguments: --sharpness 3'),
    ],
)
def test_a_bad_flag_is_refused(files, capsys, flags, complaint):
    assert complaint in refusal(image_command(files, *flags), capsys)
    assert not (files / 'out').exists()


@pytest.mark.parametrize(
    'changes, complaint',
    [
        ({'fx': 0.0}, 'fx must lie in'),
        ({'fy': 1e9}, 'fy must lie in'),
        ({'cx': float('nan')}, 'cx'),
        ({'width': 65}, '65x48'),
        ({'exposure': 0.0}, 'exposure must lie in (0, 60] s, got 0'),
        ({'exposure': -1}, 'exposure must lie in (0, 60] s, got -1'),
        ({'transfer': 'log'}, "transfer must be one of ('srgb', 'linear'), got 'log'"),
        ({'depth_scale': 0}, 'depth_scale'),
        ({'fx': None}, 'fx'),
    ],
)
def test_an_absurd_camera_is_refused(files, capsys, changes, complaint):
    change_camera(files, **changes)
    assert complaint in refusal(image_command(files), capsys)


def test_colour_and_depth_of_different_sizes_are_refused(files, capsys):
    cv2.imwrite(str(files / 'depth.png'), np.full((40, 64), 2000, np.uint16))
    line = refusal(image_command(files), capsys)
    assert '64x40' in line and '64x48' in line


def test_a_frame_without_any_depth_is_refused(files, capsys):
    cv2.imwrite(str(files / 'depth.png'), np.zeros((48, 64), np.uint16))
    assert 'depth' in refusal(image_command(files), capsys)


@pytest.mark.parametrize('name', ['rgb.png', 'depth.png', 'camera.json'])
@pytest.mark.parametrize('harm', ['missing', 'empty', 'cut', 'folder'])
def test_a_damaged_file_is_refused_by_name(files, capsys, name, harm):
    path = files / name
    content = path.read_bytes()
    path.unlink()
    if harm == 'folder':
        path.mkdir()
    elif harm != 'missing':
        path.write_bytes(b'' if harm == 'empty' else content[: len(content) // 2])
    assert name in refusal(image_command(files), capsys)
    assert not (files / 'out').exists()


@pytest.mark.parametrize('dtype', [np.uint8, np.float32])
def test_depth_of_the_wrong_kind_is_refused(files, capsys, dtype):
    path = files / 'depth.tiff'
    cv2.imwrite(str(path), np.full((48, 64), 20, dtype))
    path.rename(files / 'depth.png')
    line = refusal(image_command(files), capsys)
    assert '16-bit' in line and np.dtype(dtype).name in line


def test_an_output_that_cannot_be_written_is_refused(files, capsys):
    (files / 'out').write_text('a file stands where the folder should be')
    assert 'out' in refusal(image_command(files), capsys)


def test_an_image_is_solved(files, capsys):
    assert cli.main(image_command(files)) in (cli.DONE, cli.SOME_FAILED)
    record = json.loads((files / 'out/motion.json').read_text())
    assert {'theta', 'v', 'covariance', 'outcome', 'quality', 'sign_resolved'} <= set(record)
    assert record['outcome'] in capsys.readouterr().out
    assert cv2.imread(str(files / 'out/deblurred.png')).shape == (48, 64, 3)
    assert sorted(p.name for p in (files / 'out').iterdir()) == ['deblurred.png', 'motion.json']


@pytest.mark.parametrize('command', ['replay', 'import-tum'])
def test_an_input_that_is_not_there_is_refused(tmp_path, capsys, command):
    assert 'nowhere' in refusal([command, str(tmp_path / 'nowhere'), str(tmp_path / 'o')], capsys)
    assert list(tmp_path.iterdir()) == []


def test_a_topic_needs_a_name(capsys):
    argv = ['replay', 'bag', 'out', '--topics', '/camera/rgb']
    assert "'/camera/rgb' is not of the form NAME=TOPIC" in refusal(argv, capsys)


def test_an_interrupt_is_no_traceback(monkeypatch, capsys):
    def interrupted(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, '_image', interrupted)
    assert cli.main(['image', 'a', 'b', '--camera', 'c', '-o', 'd']) == cli.INTERRUPTED
    assert capsys.readouterr().err == 'depth-deblur: interrupted\n'


def test_the_energy_is_drawn_for_the_method_that_has_one(files, capsys):
    chart = files / 'out/energy.svg'
    assert 'method paper' in refusal(image_command(files, '--energy', str(chart)), capsys)
    quick = ['--method', 'paper', '--levels', '1', '--kernel-size', '5', '--alternations', '1']
    assert cli.main(image_command(files, *quick, '--energy', str(chart))) in (0, 1)
    assert chart.read_text().startswith('<svg')
