"""The house style is kept: lint, format and types, as `make lint` checks them."""

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]


@pytest.mark.parametrize(
    'command',
    [
        ['ruff', 'check', '--no-cache', '.'],
        ['ruff', 'format', '--no-cache', '--check', '.'],
        ['mypy'],
    ],
    ids=['lint', 'format', 'types'],
)
def test_the_house_style_is_kept(command: list[str]):
    done = subprocess.run(
        [sys.executable, '-m', *command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
