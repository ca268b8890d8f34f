"""Whole runs: the command `codetr train`, its processes, its folder.

They are forked (see `forked`), unless a test is about how a user starts them.
"""

import json
import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import yaml

from codetr_ros.config import Settings
from helpers.forked import Forked, codetr

CODETR = Path(sys.prefix) / 'bin' / 'codetr'
DEADLINE = 300  # [s] far beyond what any of these runs takes


Command = Forked | subprocess.Popen[str]


def train(
    settings: Settings, folder: Path, *flags: str, installed: bool = False
) -> tuple[dict[str, Any], str]:
    """Run `codetr train` to its end; its summary and what it printed."""
    begin = start_installed if installed else start
    return finish(begin(write(settings, folder), folder, *flags), folder)


def write(settings: Settings, folder: Path) -> Path:
    """Write settings to a file beside a run's folder."""
    config = folder.with_suffix('.yaml')
    config.write_text(yaml.safe_dump(settings.model_dump(mode='json')))
    return config


def finish(started: Command, folder: Path, code: int = 0) -> tuple[dict[str, Any], str]:
    """Wait until `codetr train` has ended; its summary and what it printed."""
    try:
        said, _ = started.communicate(timeout=DEADLINE)
    except subprocess.TimeoutExpired:
        started.kill()
        said, _ = started.communicate()
        raise AssertionError(
            f'codetr train took more than {DEADLINE} s:\n{said}\n{logs(folder)}'
        ) from None
    assert started.returncode == code, f'{said}\n{logs(folder)}'
    return json.loads((folder / 'summary.json').read_text()), said


def start(config: Path, folder: Path, *flags: str) -> Forked:
    """Fork `codetr train`, in a session of its own; its nodes are forked too. The robot is not
    drawn: that takes longer than many of these runs.
    """
    arguments = ('train', '--config', str(config), '--out', str(folder), '--no-film', *flags)
    return codetr(*arguments, environment=os.environ | {'COLUMNS': '160'})


def start_installed(config: Path, folder: Path, *flags: str) -> 'subprocess.Popen[str]':
    """Start the installed command `codetr train`, in a session of its own."""
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


def asked_again(folder: Path) -> list[str]:
    """What the nodes of a run have logged of messages that they sent again on request. Nobody asks
    for any in an undisturbed run; a node that the machine lets stand still does, and counts as
    duplicated what it had.
    """
    found = (folder / 'logs').glob('*.log')
    lines = (line for path in found for line in path.read_text().splitlines())
    return [line for line in lines if 'sending it again' in line]


def until(found: Callable[[], Any], command: Command, folder: Path) -> Any:
    """Wait until `found()` is true, as long as a command runs; what it returns."""
    end = time.monotonic() + DEADLINE
    while not (result := found()):
        try:
            code = command.wait(0.1)
        except subprocess.TimeoutExpired:
            assert time.monotonic() < end, f'not within {DEADLINE} s\n{logs(folder)}'
        else:
            raise AssertionError(f'ended with {code}:\n{command.stdout.read()}\n{logs(folder)}')
    return result


def node_of(folder: Path, name: str) -> int:
    """The number of the process that writes the log of a node."""
    log = folder / 'logs' / f'{name}.log'
    for entry in Path('/proc').glob('[0-9]*'):
        try:
            if (entry / 'fd' / '1').resolve() == log:
                return int(entry.name)
        except OSError:
            continue  # it has ended meanwhile, or is of somebody else
    raise AssertionError(f'no process writes {log}')


def processes_of(folder: Path) -> list[tuple[int, str]]:
    """Number and command line of each process that has something to do with a run's folder."""
    found = []
    for entry in Path('/proc').iterdir():
        if entry.name.isdigit() and int(entry.name) != os.getpid():
            try:
                words = (entry / 'cmdline').read_bytes().replace(b'\0', b' ').decode()
            except OSError:
                continue  # it has ended meanwhile
            if str(folder) in words:
                found.append((int(entry.name), words))
    return found
