"""Whole runs, started as a user starts them: the command `codetr train`, its processes, its
folder.
"""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml
from codetr_ros.config import Settings

CODETR = Path(sys.prefix) / 'bin' / 'codetr'
DEADLINE = 300  # [s] far beyond what any of these runs takes


def train(
    settings: Settings, folder: Path, *flags: str, code: int = 0
) -> tuple[dict[str, Any], str]:
    """Run `codetr train` to its end; its summary and what it printed."""
    config = folder.with_suffix('.yaml')
    config.write_text(yaml.safe_dump(settings.model_dump(mode='json')))
    done = start(config, folder, *flags)
    try:
        said, _ = done.communicate(timeout=DEADLINE)
    except subprocess.TimeoutExpired:
        done.kill()
        said, _ = done.communicate()
        raise AssertionError(
            f'codetr train took more than {DEADLINE} s:\n{said}\n{logs(folder)}'
        ) from None
    assert done.returncode == code, f'{said}\n{logs(folder)}'
    return json.loads((folder / 'summary.json').read_text()), said


def start(config: Path, folder: Path, *flags: str) -> 'subprocess.Popen[str]':
    """Start `codetr train` as a process of its own session."""
    return subprocess.Popen(
        [str(CODETR), 'train', '--config', str(config), '--out', str(folder), *flags],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        stdin=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
        env=os.environ | {'COLUMNS': '160'},
    )


def logs(folder: Path) -> str:
    """The ends of all nodes' logs, for a failing test."""
    found = sorted((folder / 'logs').glob('*.log')) if folder.exists() else []
    return '\n'.join(f'--- {path.name}\n{path.read_text()[-2000:]}' for path in found)
