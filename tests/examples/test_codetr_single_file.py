"""The file to be read beside the paper: short, on its own, and the computation of the library."""

import ast
import json
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

FILE = Path(__file__).resolve().parents[2] / 'examples' / 'codetr_single_file.py'
TIMEOUT = 280  # seconds


def command() -> list[str]:
    """The arguments of `codetr` that the file itself says give the same weights."""
    lines = ast.get_docstring(ast.parse(FILE.read_text())).replace('\\\n', ' ').splitlines()
    (line,) = (line for line in lines if line.strip().startswith('codetr '))
    return shlex.split(line)[1:]


def test_it_has_at_most_three_hundred_lines():
    assert len(FILE.read_text().splitlines()) <= 300


def test_it_imports_nothing_but_torch_numpy_gymnasium_and_the_standard_library():
    modules = set()
    for node in ast.walk(ast.parse(FILE.read_text())):
        if isinstance(node, ast.Import):
            modules |= {name.name for name in node.names}
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0
            modules.add(node.module)
        elif isinstance(node, ast.Name):
            assert node.id not in ('__import__', 'exec', 'eval')
    packages = {module.partition('.')[0] for module in modules}
    assert 'importlib' not in packages
    assert packages - sys.stdlib_module_names == {'torch', 'numpy', 'gymnasium'}


def test_the_run_that_it_names_is_one_of_codetr_in_process():
    arguments = command()
    assert arguments[0] == 'train' and '--in-process' in arguments


@pytest.mark.slow
def test_it_ends_with_the_weights_of_the_run_that_it_names(tmp_path):
    run = [sys.executable, '-m', 'codetr_ros.cli', *command(), '--out', str(tmp_path / 'run')]
    started = [
        subprocess.Popen(
            arguments,
            cwd=tmp_path,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
        )
        for arguments in ([sys.executable, str(FILE)], run)
    ]
    try:
        printed, shown = (process.communicate(timeout=TIMEOUT)[0] for process in started)
    finally:
        for process in started:
            process.kill()
            process.wait()
    assert [process.returncode for process in started] == [0, 0], printed + shown

    summary = json.loads((tmp_path / 'run' / 'summary.json').read_text())
    digests = dict(line.split() for line in printed.splitlines() if '_sha256 ' in line)
    assert digests.keys() == {'policy_sha256', 'reward_model_sha256'}
    assert digests == {name: summary[name] for name in digests}
    # what the settings promise has happened: fits of both kinds, and a policy that has acted
    assert summary['phases'] > 2 and summary['updates'] == summary['steps']
