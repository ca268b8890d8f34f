"""What does recording cost? The same run with a bag and without one, pair by pair.

    .venv/bin/python benchmarks/recording_overhead.py

Every run has all of its nodes as processes, as `codetr train` starts them. A: the recorder writes
a bag, synced to the disk before each commit. B: it has no folder, so it keeps the last phases in
memory and commits from there. The order alternates (A B, B A, ...), so that what drifts hits both.
For each run are given

  - loop: seconds from the first commit to the learner's last word, as a watcher hears them; what
    starting and ending take is left out
  - cpu: CPU seconds of all processes together, which other load on the machine disturbs less
  - sync: what the recorder says it spent in syncing before commits (A only); as a part of the
    loop it is the cost of recording that no other core can take over

and the ratios A / B, lowest, median and highest pair. On a machine that is not idle, read the
ratio of cpu and the part that is sync, and repeat the rest on a quiet one.
"""

import argparse
import json
import os
import resource
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import machine
from codetr_ros import launcher, run_folder
from codetr_ros.config import Settings, load
from codetr_ros.records import Commit, Metrics, Record
from codetr_ros.ros.watch import Watcher

RESULTS = Path(__file__).parent / 'results' / 'recording_overhead.md'
DEADLINE = 1800.0  # [s] for one run


class Run(NamedTuple):
    """One run's times [s], and the size of its bag."""

    loop: float
    cpu: float
    sync: float
    megabytes: float


class Clock:
    """When the first commit and the learner's last metrics were heard."""

    def __init__(self, phases: int) -> None:
        self._last = 'learner', phases - 1
        self.first: float | None = None
        self.last: float | None = None

    def hear(self, record: Record) -> None:
        """Take note of a record."""
        if isinstance(record, Commit) and self.first is None:
            self.first = time.perf_counter()
        elif isinstance(record, Metrics) and (record.role, record.phase) == self._last:
            self.last = time.perf_counter()


def without_folder(command: launcher.Command) -> launcher.Command:
    """The same command, without the parameter that makes a recorder write a bag."""
    words = list(command.arguments)
    at = next(i for i, word in enumerate(words) if word.startswith('folder:='))
    return launcher.Command(command.name, command.role, (*words[: at - 1], *words[at + 1 :]))


def one_run(settings: Settings, bag: bool, number: int) -> Run:
    """Make a run and measure it."""
    clock = Clock(settings.phases)
    run_id = f'overhead_{os.getpid()}_{number}'
    began = cpu_of_children()
    with tempfile.TemporaryDirectory(prefix='codetr-overhead-') as where:
        folder = run_folder.create(Path(where) / 'run')
        run_folder.write_settings(folder, settings)
        commands = launcher.commands(settings, run_id, folder)
        if not bag:
            commands = [without_folder(c) if c.role == 'record' else c for c in commands]
        with (
            launcher.Processes(print) as processes,
            Watcher(clock.hear, f'/run_{run_id}') as watcher,
        ):
            processes.start(commands, folder / run_folder.LOGS, launcher.environment(settings))
            end = time.monotonic() + DEADLINE
            while processes.running() and not processes.failed():
                watcher.poll(0.1)
                if time.monotonic() > end:
                    raise SystemExit(f'a run took more than {DEADLINE:g} s')
        if failed := processes.failed():
            raise SystemExit(f'{failed.how_it_ended()}\n{launcher.end_of_log(failed.log)}')
        if clock.first is None or clock.last is None:
            raise SystemExit('the first commit or the last metrics were not heard')
        sync, size = 0.0, 0.0
        if bag:
            path = run_folder.report_path(folder, 'record', 'record')
            report = json.loads(path.read_text())
            sync, size = report['flush_seconds'], report['bag_bytes'] / 1e6
    return Run(clock.last - clock.first, cpu_of_children() - began, sync, size)


def cpu_of_children() -> float:
    """CPU seconds of all processes that have been started and have ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def table(pairs: list[tuple[Run, Run]], facts: dict[str, str]) -> str:
    """All pairs, and what they come to."""
    lines = [
        '# What recording costs',
        '',
        '| pair | loop with bag [s] | without [s] | ratio | cpu with bag [s] | without [s] '
        '| ratio | sync [s] | of the loop |',
        '|---' * 9 + '|',
    ]
    for i, (a, b) in enumerate(pairs, 1):
        lines.append(
            f'| {i} | {a.loop:.2f} | {b.loop:.2f} | {a.loop / b.loop:.3f} | {a.cpu:.2f} '
            f'| {b.cpu:.2f} | {a.cpu / b.cpu:.3f} | {a.sync:.3f} | {a.sync / a.loop:.2%} |'
        )
    for what in ('loop', 'cpu'):
        ratios = [getattr(a, what) / getattr(b, what) for a, b in pairs]
        facts[f'{what}, with bag / without'] = (
            f'median {statistics.median(ratios):.3f}, {min(ratios):.3f} to {max(ratios):.3f}'
        )
    facts['bag'] = f'{statistics.median(a.megabytes for a, _ in pairs):.1f} MB'
    return '\n'.join([*lines, '', *(f'- {name}: {fact}' for name, fact in facts.items())]) + '\n'


def main() -> int:
    """The command line; the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--config', default='quick', help='preset or YAML file')
    parser.add_argument('--steps', type=int, help='of a run; as the config says if not given')
    parser.add_argument('--pairs', type=int, default=5)
    parser.add_argument('--out', type=Path, default=RESULTS)
    given = parser.parse_args()
    settings = load(given.config)
    if given.steps:
        settings = settings.changed({'steps': given.steps}, 'command line')
    load_at_start = machine.load()
    print(f'load average at the start: {load_at_start}', flush=True)
    os.environ.update(launcher.environment(settings))
    pairs = []
    for i in range(given.pairs):
        runs = {bag: one_run(settings, bag, 2 * i + bag) for bag in (i % 2 == 0, i % 2 == 1)}
        pairs.append((runs[True], runs[False]))
        print(f'pair {i + 1}: {runs[True].loop:.2f} s with a bag, {runs[False].loop:.2f} without',
              flush=True)  # fmt: skip
    text = table(
        pairs,
        {
            'run': f'{given.config}, {settings.task}, {settings.steps} steps',
            **machine.facts(load_at_start, ('numpy', 'torch', 'mcap')),
        },
    )
    print(text, end='')
    given.out.parent.mkdir(parents=True, exist_ok=True)
    given.out.write_text(text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
