"""What the docs show in Python works as it stands there."""

import doctest
from pathlib import Path
import re
import subprocess
import sys

import pytest

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / 'docs'


def test_the_python_session_runs_as_it_stands():
    flags = doctest.ELLIPSIS
    done = doctest.testfile(str(DOCS / 'python.md'), module_relative=False, optionflags=flags)
    assert done.attempted > 15
    assert done.failed == 0


@pytest.mark.slow
def test_the_tutorial_goes_from_the_sample_bag_to_a_page(tmp_path):
    command = [sys.executable, str(ROOT / 'scripts/tutorial.py'), str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        'bag',
        'bag.html',
        'during_the_exposure.mp4',
        'motion.json',
        'panels.png',
        'sharp.png',
    ]
    assert 'one frame: solved' in done.stdout
    assert done.stdout.count('camera [') >= 3  # velocities, so signs
    assert float(re.search(r'median: ([\d.]+) m/s', done.stdout)[1]) < 0.1
