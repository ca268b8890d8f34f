"""The worked example of docs/your-task.md: an environment that somebody wrote, learnt from."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
EXAMPLE = ROOT / 'examples/own_task/cart.py'


@pytest.mark.slow
def test_an_environment_of_ones_own_is_learnt_from(tmp_path: Path):
    folder = tmp_path / 'run'
    flags = ['--steps', '2000', '--evaluate-episodes', '2', '--out', str(folder)]
    done = subprocess.run(
        [sys.executable, str(EXAMPLE), *flags], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr
    summary = json.loads((folder / 'summary.json').read_text())
    assert (summary['task'], summary['steps'], summary['delay']) == ('Cart-v0', 2000, 20)
    assert summary['evaluations'][-1]['length_mean'] <= 200
    assert summary['updates'] == 2000


def test_the_page_quotes_the_example_as_it_is():
    page = (ROOT / 'docs/your-task.md').read_text()
    (quoted,) = re.findall(r'```python\n(.*?)```', page, re.DOTALL)
    assert quoted in EXAMPLE.read_text()
