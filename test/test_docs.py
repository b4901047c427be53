"""What the docs show in Python works as it stands there."""

import doctest
from pathlib import Path

DOCS = Path(__file__).resolve().parents[1] / 'docs'


def test_the_python_session_runs_as_it_stands():
    flags = doctest.ELLIPSIS
    done = doctest.testfile(str(DOCS / 'python.md'), module_relative=False, optionflags=flags)
    assert done.attempted > 15
    assert done.failed == 0
