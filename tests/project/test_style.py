"""The house style is kept: lint, format and types, as `make lint` checks them."""

import ast
import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.parametrize(
    'command',
    [
        ['ruff', 'check', '--no-cache', '.'],
        ['ruff', 'format', '--no-cache', '--check', '.'],
        pytest.param(['mypy'], marks=pytest.mark.slow),
    ],
    ids=['lint', 'format', 'types'],
)
def test_the_house_style_is_kept(command: list[str]):
    done = subprocess.run(
        [sys.executable, '-m', *command], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.parametrize(
    'script', sorted((ROOT / 'benchmarks').glob('*.py')), ids=lambda p: p.stem
)
def test_benchmarks_find_what_they_take_from_the_library(script: Path):
    taken = [
        (node.module, name.name)
        for node in ast.walk(ast.parse(script.read_text()))
        if isinstance(node, ast.ImportFrom) and (node.module or '').startswith('codetr_ros')
        for name in node.names
    ]
    for module, name in taken:
        if module.startswith('codetr_ros.ros'):
            pytest.importorskip('rclpy', reason='needs ROS')
        found = importlib.import_module(module)
        assert hasattr(found, name) or importlib.util.find_spec(f'{module}.{name}'), (module, name)
