"""Output that goes into a file or another program is never wrapped."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from helpers.bags import a_run, ours

LONG = '/'.join(f'a_folder_with_a_long_name_{number}' for number in range(12))
ROOT = Path(__file__).resolve().parents[2] / 'codetr_ros' / 'codetr_ros'


def output(*arguments: str) -> str:
    """What a command prints into a pipe, however narrow the terminal is that it was typed in."""
    done = subprocess.run(
        [sys.executable, '-m', 'codetr_ros.cli', *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {'COLUMNS': '30'},
        check=False,
    )
    return done.stdout


@pytest.mark.parametrize(
    'arguments',
    [
        ('fit', '--oout', LONG),  # an error of the parser
        ('train', '--config', LONG),  # one of ours
        ('evaluate', LONG),
    ],
)
def test_a_path_in_an_error_stays_in_one_piece(arguments: tuple[str, ...]) -> None:
    assert LONG in output(*arguments)


def test_help_and_tables_stay_in_one_piece(tmp_path: Path) -> None:
    assert any(
        'the defaults of all other flags (default: quick)' in line
        for line in output('train', '--help').splitlines()
    )
    assert re.search(r'HalfCheetah-v4 .* never terminates; dynamics of v2', output('tasks'))
    bag = ours(tmp_path / LONG / 'bag', a_run())
    assert str(bag) in output('bag', 'info', str(bag))


def test_every_command_prints_and_parses_through_one_module() -> None:
    """Which knows how wide a terminal is. The display of progress never wraps a line."""
    known = {ROOT / 'cli' / 'terminal.py', ROOT / 'runs' / 'display.py'}
    others = {
        path
        for path in ROOT.rglob('*.py')
        if re.search(r'\btyro\.cli\(|\bConsole\(', path.read_text())
    }
    assert others == known
