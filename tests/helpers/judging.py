"""`codetr train` with pages or services for those who score, and a person at a page."""

import json
import os
import re
import signal
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from kills import nodes

PATIENCE = 240.0
CODETR = (sys.executable, '-m', 'codetr_ros.cli')


class Command:
    """A command that runs beside the test, whose lines are read while it does. A context manager.

    Args:
        words: the command.
        variables: of its environment, beside those of this process when it is entered.
    """

    def __init__(self, words: Sequence[str], variables: Mapping[str, str] | None = None) -> None:
        self._words = words
        self._variables = dict(variables or {})
        self.lines: list[str] = []
        self._more = threading.Condition()

    def __enter__(self) -> 'Command':
        self.process = subprocess.Popen(
            self._words,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            env={**os.environ, 'PYTHONUNBUFFERED': '1', **self._variables},
        )
        self._reader = threading.Thread(target=self._read)
        self._reader.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        self._reader.join()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            with self._more:
                self.lines.append(line)
                self._more.notify_all()
        with self._more:
            self._more.notify_all()

    @property
    def text(self) -> str:
        """All that it has printed."""
        return ''.join(self.lines)

    def until(self, pattern: str) -> re.Match[str]:
        """Wait for a line; the match in what is printed."""

        def found() -> re.Match[str] | None:
            return re.search(pattern, self.text)

        with self._more:
            self._more.wait_for(lambda: found() or self.process.poll() is not None, PATIENCE)
        match = found()
        assert match is not None, f'no {pattern!r} in:\n{self.text}'
        return match

    def end(self) -> int:
        """Wait until it ends; its exit code."""
        code = self.process.wait(PATIENCE)
        self._reader.join()
        return code


@contextmanager
def held(train: Command, out: Path, node: str = 'reward') -> Iterator[None]:
    """Hold a node of a run that has begun, so that the run cannot end meanwhile. Who joins a run
    waits for its learner, recorder and simulators, and for no reward node.

    Args:
        train: the command that has started the nodes.
        out: the folder of the run.
        node: the role of the node.
    """
    log, end = out / 'logs' / f'{node}.log', time.monotonic() + PATIENCE
    while not (log.exists() and 'everybody is there' in log.read_text()):
        assert time.monotonic() < end and train.process.poll() is None, train.text
        time.sleep(0.01)
    pid = nodes(out)[node]
    os.kill(pid, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(pid, signal.SIGCONT)


def desk_of(url: str) -> dict[str, Any]:
    """What the page of a scorer shows now."""
    with urllib.request.urlopen(url + 'events', timeout=60) as stream:
        for line in stream:
            if line.startswith(b'data: {"scorer"'):
                return json.loads(line[6:])  # type: ignore[no-any-return]
    raise AssertionError('the page publishes no desk')


def asked(url: str, **sent: Any) -> dict[str, Any]:
    """The answer of a page to what its browser sends."""
    data = json.dumps(sent).encode()
    request = urllib.request.Request(url, data, {'Content-Type': 'application/json'})
    with urllib.request.urlopen(request, timeout=60) as answer:
        return json.loads(answer.read())  # type: ignore[no-any-return]


def judge(url: str, segment: Sequence[Any], value: float) -> dict[str, Any]:
    """Score a segment on the page of a scorer."""
    return asked(url + 'judge', segment=segment, value=value)


def pictures(url: str, segment: Sequence[Any]) -> dict[str, Any]:
    """The pictures of a segment on the page of a scorer, and what it states of them."""
    return asked(url + 'segment', segment=segment, frames=True)


def first_waiting(url: str) -> list[Any]:
    """The segment that comes first on the page of a scorer, once one waits."""
    end = time.monotonic() + PATIENCE
    while not (waiting := desk_of(url)['waiting']):
        assert time.monotonic() < end
    return waiting[0]  # type: ignore[no-any-return]


def judge_until_taken(url: str) -> set[int]:
    """Score what waits on a page until a commit has taken something; the phases that have."""
    taken: set[int] = set()
    end = time.monotonic() + PATIENCE
    while not taken and time.monotonic() < end:
        desk = desk_of(url)
        for segment in desk['waiting'][:4]:
            judge(url, segment, 1 + min(4, segment[3] // 2))
        taken = {row['phase'] for row in desk['given'] if row['phase'] is not None}
    return taken


def summary_of(folder: Path) -> dict[str, Any]:
    """The summary of a run."""
    return json.loads((folder / 'summary.json').read_text())  # type: ignore[no-any-return]
