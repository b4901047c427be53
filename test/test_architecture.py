"""The pictures of docs/architecture.md against the files and their imports."""

import ast
from pathlib import Path
import re

import pytest

ROOT = Path(__file__).resolve().parents[1]
NAME = 'depth_deblur_ros'
PACKAGE = ROOT / NAME
PAGE = (ROOT / 'docs/architecture.md').read_text()
FRONT = {'__init__', '__main__'}


def rows():
    """Give the rows of the picture, as names of modules under the package."""
    picture = next(b for b in re.findall(r'```\n(.*?)```', PAGE, re.S) if 'entrances' in b)
    outer, inner = re.split(r'-{5,}.*\n', picture)
    split = [[re.split(' {2,}', line)[1:] for line in p.splitlines()] for p in (outer, inner)]
    return split[0] + [[f'core.{name}' for name in row] for row in split[1]]


PLACE = {name: (r, c) for r, row in enumerate(rows()) for c, name in enumerate(row)}
FILES = {
    '.'.join(path.relative_to(PACKAGE).with_suffix('').parts): path
    for path in sorted(PACKAGE.rglob('*.py'))
    if path.stem not in FRONT
}


def imported(path):
    """Give the modules of the package that a file imports."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or '').startswith(NAME):
            module = node.module.removeprefix(NAME).removeprefix('.')
            found |= {module} if module in FILES else {a.name for a in node.names}
    return found


def test_no_module_is_drawn_twice():
    assert len(PLACE) == sum(map(len, rows()))


@pytest.mark.parametrize('name', FILES)
def test_each_file_is_drawn_and_imports_only_what_is_below_or_to_its_right(name):
    assert name in PLACE, f'{name} is missing from the picture in docs/architecture.md'
    for other in imported(FILES[name]):
        assert PLACE[other] > PLACE[name], f'{name} imports {other}'


@pytest.mark.parametrize('name', [n for n in FILES if '.' not in n])
def test_each_file_has_its_line_in_the_table(name):
    assert re.search(rf'^\| .*`{name}\.py`.* \|', PAGE, re.M)
