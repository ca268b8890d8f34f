"""Does a run whose nodes are killed end as if nothing had happened?

    .venv/bin/python benchmarks/kills.py [--kills N] [--installed]

Small runs over topics, in lock-step and with overlap, by three methods. In each, nodes are killed
one after the other by what its seed draws: which, how many at once, how many phases after those
before, how long after the beginning of a phase, and now and then again while they start or go on.
`codetr train` itself is one of them, and goes on with `--resume`. The digests of policy and reward
model are compared with those of the same run undisturbed.

A row for each run, with what each killed node was doing; one that is in the file is not made
again. So a thousand kills can be made in several sessions: the script ends when the file has N.
Nodes are forked from a process that has imported everything; with `--installed` they start as
users start them, which takes five times as long.
"""

import argparse
import json
import os
import random
import re
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

from rows import Rows

sys.path.insert(0, str(Path(__file__).parent.parent / 'tests'))
from codetr_ros.config import Settings
from helpers import forked
from helpers.builders import tiny
from helpers.runs import CODETR, Command, write

OUT = Path(__file__).parent / 'results' / 'kills.csv'
COLUMNS = (
    'method', 'overlap', 'seed', 'kills', 'schedule', 'exit_code', 'seconds', 'same', 'states',
)  # fmt: skip
KINDS = [(method, overlap) for method in ('codetr', 'rrd', 'none') for overlap in (False, True)]
STEPS, PHASES = 4000, 20
LONGEST = 900.0  # [s] for a run
TO_END = 60.0  # [s] for nodes whose `codetr train` was killed
FLAGS = ('--no-film', '--restarts', '1000000', '--peer-deadline', '300')
TRAIN = 'train'
AT_THE_END = 3
"""So often is killed once all phases are recorded, or the run would never end."""

Kill = tuple[int, float, list[str]]
"""After how many more phases, and how many seconds later, which roles are killed."""


def nodes(folder: Path) -> dict[str, int]:
    """Ids of the processes of a run, by role."""
    found = {}
    for place in Path('/proc').glob('[0-9]*'):
        try:
            words = (place / 'cmdline').read_bytes().decode(errors='replace').split('\0')
            output = Path(os.readlink(place / 'fd' / '1'))
        except OSError:
            continue
        if any('fork_server.py' in word for word in words):
            if output.parent == folder / 'logs':
                found[output.stem] = int(place.name)
        elif any(str(folder) in word for word in words):
            for word in words:
                if match := re.search(r'/lib/\w+/(sim|evaluate|reward|learner|record)$', word):
                    found[match[1]] = int(place.name)
    return found


def phase_of(folder: Path) -> int:
    """Phases that are recorded so far, by the recorder's log; -1 before it began."""
    said = log_of(folder, 'record')
    done = re.findall(r'phase (\d+) of', said)
    return int(done[-1]) if done else 0 if 'everybody is there' in said else -1


def log_of(folder: Path, role: str) -> str:
    """What a node has logged."""
    log = folder / 'logs' / f'{role}.log'
    return log.read_text() if log.is_file() else ''


def state_of(folder: Path, role: str) -> str:
    """What a node does, by what it has logged since it was started."""
    since = log_of(folder, role).rpartition('\n$ ')[2]
    if 'everybody is there' not in since:
        return 'starts'
    if re.search(r'phase \d+ of', since) is None:
        return 'goes on' if 'goes on' in since else 'begins'
    return 'ends' if phase_of(folder) >= PHASES else 'works'


def schedule(seed: int, roles: Sequence[str]) -> Iterator[Kill]:
    """What is killed, for as long as the run takes."""
    rng = random.Random(seed)
    while True:
        some = rng.sample(roles, rng.choice((1, 1, 1, 2, len(roles))))
        yield rng.choice((1, 1, 2)), rng.uniform(0, 1.5), some
        if rng.random() < 0.3:  # twice in a row: while they start, or go on
            yield 0, rng.uniform(0, 4), some


class Run:
    """A run that is killed again and again.

    Args:
        folder: of the run.
        settings: its settings.
        installed: whether its processes are started as users start them.
    """

    def __init__(self, folder: Path, settings: Settings, installed: bool) -> None:
        self.folder = folder
        self._installed = installed
        self.states: Counter[str] = Counter()
        self.done: list[str] = []
        self.command = self._start('--config', str(write(settings, folder)), '--out', str(folder))

    def _start(self, *arguments: str) -> Command:
        words = ('train', *arguments, *FLAGS)
        if not self._installed:
            with self.folder.with_suffix('.log').open('ab') as log:
                return forked.codetr(*words, environment=os.environ, output=log)
        with self.folder.with_suffix('.log').open('ab') as log:
            return subprocess.Popen(
                [str(CODETR), *words], stdout=log, stderr=subprocess.STDOUT, text=True
            )

    def _until(self, phase: int, end: float) -> bool:
        """Wait until so many phases are recorded; false if the run has ended."""
        while phase_of(self.folder) < phase:
            if self.command.poll() is not None or time.monotonic() > end:
                return False
            time.sleep(0.02)
        return self.command.poll() is None

    def kill(self, roles: Sequence[str]) -> None:
        """Kill those of these roles that are there."""
        there = nodes(self.folder)
        for role in (role for role in roles if role in there):
            self.states[state_of(self.folder, role)] += 1
            try:
                os.kill(there[role], signal.SIGKILL)
            except ProcessLookupError:
                self.states[state_of(self.folder, role)] -= 1
        if TRAIN in roles:
            self.states[TRAIN] += 1
            self.command.kill()
            self.command.wait()
            self._all_ended()
            if not self.over:
                self.command = self._start('--resume', str(self.folder))

    def _all_ended(self) -> None:
        """Wait for the nodes, which the kernel has asked to end.

        Raises:
            RuntimeError: some do not: this is a fault of theirs.
        """
        end = time.monotonic() + TO_END
        while left := nodes(self.folder):
            if time.monotonic() > end:
                raise RuntimeError(f'{sorted(left)} did not end within {TO_END:g} s')
            time.sleep(0.05)

    @property
    def over(self) -> bool:
        """Whether the run is in its summary: a run that is killed behind that has finished."""
        path = self.folder / 'summary.json'
        if not path.is_file():
            return False
        made = json.loads(path.read_text())
        return not (made['interrupted'] or made['failure'])

    def follow(self, planned: Iterator[Kill]) -> None:
        """Kill by a schedule until the run has ended."""
        end, ending = time.monotonic() + LONGEST, 0
        for phases, after, roles in planned:
            ending += phase_of(self.folder) >= PHASES
            if ending > AT_THE_END:
                break
            if not self._until(min(phase_of(self.folder) + phases, PHASES), end):
                break
            time.sleep(after)
            if self.command.poll() is not None:
                break
            self.done.append(f'{phase_of(self.folder)}+{after:.1f}:{"+".join(roles)}')
            self.kill(roles)
        while self.command.poll() is None and time.monotonic() < end:
            time.sleep(0.1)
        if self.command.poll() is None:
            self.command.send_signal(signal.SIGINT)
        self.command.wait()

    @property
    def kills(self) -> int:
        """How many processes were killed."""
        return self.states.total()

    def digests(self) -> tuple[str | None, str | None]:
        """Those of policy and reward model."""
        path = self.folder / 'summary.json'
        made = json.loads(path.read_text()) if path.is_file() else {}
        return made.get('policy_sha256'), made.get('reward_model_sha256')


def undisturbed(place: Path, settings: Settings, installed: bool) -> tuple[str | None, str | None]:
    """The digests of a run in which nothing is killed."""
    run = Run(place / 'undisturbed', settings, installed)
    run.command.wait()
    return run.digests()


def main() -> None:
    """Make rows until the file has so many kills."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--kills', type=int, default=1000, help='kills in all rows together')
    parser.add_argument('--installed', action='store_true', help='start nodes as users do')
    given = parser.parse_args()
    rows = Rows(OUT, COLUMNS, 3)
    expected: dict[tuple[str, bool], tuple[str | None, str | None]] = {}
    number, kills = 0, sum(int(row['kills']) for row in rows.read())
    try:
        while kills < given.kills:
            method, overlap = kind = KINDS[number % len(KINDS)]
            seed, number = number, number + 1
            if (*kind, seed) in rows:
                continue
            settings = tiny(method=method, overlap=overlap, steps=STEPS)
            with tempfile.TemporaryDirectory(prefix='codetr-kills-') as place:
                if kind not in expected:
                    expected[kind] = undisturbed(Path(place), settings, given.installed)
                began = time.monotonic()
                roles = [*settings.roles, TRAIN]
                run = Run(Path(place) / 'run', settings, given.installed)
                run.follow(schedule(seed, roles))
                code = run.command.wait()
                ended = code == 0 or (code == -signal.SIGKILL and run.over)
                same = ended and run.digests() == expected[kind]
                if not same:
                    print((Path(place) / 'run.log').read_text()[-3000:], file=sys.stderr)
            seconds = f'{time.monotonic() - began:.0f}'
            states = ' '.join(f'{name}={n}' for name, n in sorted(run.states.items()))
            done = ' '.join(run.done)
            rows.append((*kind, seed, run.kills, done, code, seconds, same, states))
            kills += run.kills
    finally:
        forked.end_server()


if __name__ == '__main__':
    main()
