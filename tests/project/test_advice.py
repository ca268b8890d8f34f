"""Whoever follows the advice of a message finds what it names."""

import re
import subprocess
from pathlib import Path

import pytest

from codetr_ros import cli
from codetr_ros.cli import bag

ROOT = Path(__file__).resolve().parents[2]
SOURCES = [
    *(
        path
        for path in ROOT.glob('*/**/*.py')
        if 'tests' not in path.parts and '.venv' not in path.parts
    ),
    *ROOT.glob('bootstrap*.py'),
]


def advised(pattern: str) -> dict[str, set[str]]:
    """What is named after some words in the texts of the program, and where."""
    found: dict[str, set[str]] = {}
    for path in SOURCES:
        for name in re.findall(pattern, path.read_text()):
            found.setdefault(name, set()).add(path.relative_to(ROOT).as_posix())
    return found


def test_what_make_is_advised_for_it_can_make():
    targets = set(re.findall(r'^(\w+):', (ROOT / 'Makefile').read_text(), re.MULTILINE))
    named = advised(r'`make (\w+)`') | advised(r': make (\w+) PYTHON')
    assert {'setup', 'test'} <= set(named)
    assert set(named) <= targets, {name: named[name] for name in set(named) - targets}
    assert not advised(r'(run `make`)'), 'that only lists what can be made'


def test_commands_that_are_advised_exist():
    named = advised(r'`codetr ([a-z_]+)')
    assert len(named) > 8
    assert set(named) <= set(cli.COMMANDS) | {'COMMAND'}, named
    assert set(advised(r'`codetr bag ([a-z_]+)')) <= set(bag.COMMANDS)


@pytest.mark.parametrize('python', ['no-such-python', '/nowhere/python3'])
def test_a_python_that_is_missing_is_named_in_one_line_without_a_torn_word(python):
    done = subprocess.run(
        ['make', 'setup', f'PYTHON={python}'],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode
    assert f"there is no command '{python}'. Install Python 3.10 to 3.13 (Debian" in done.stderr
    assert 'make test PYTHON=/path/to/python3.12' in done.stderr
