"""How much does recording cost? The same run with a bag and without one, pair by pair.

    .venv/bin/python benchmarks/recording_overhead.py

Every run has all of its nodes as processes, as `codetr train` starts them. A: the recorder writes
a bag, synced to the disk before each commit. B: it has no folder, so it keeps the last phases in
memory and commits from there. The order alternates (A B, B A, ...), so that drift affects both.
The numbers of each run are

  - loop: seconds from the first commit to the learner's last metrics, as a watcher receives them,
    without start and end
  - rest: the loop less the times that the nodes report for simulating, fitting, labelling and
    learning. In lock-step one of them works at a time, so the rest is transport and the recorder,
    with all costs of recording to the others. The speed of learning differs by chance, by several
    per cent from process to process, and does not disturb the rest
  - recorder: CPU seconds of the recorder's process
  - sync: seconds that the recorder reports for syncing before commits (with a bag only)

Recording costs (rest with a bag - rest without) / loop in time, and the same of `recorder` in
CPU. The ratio of the loops themselves is also given, with its range.
"""

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

from started import check, first_failure

import machine
from codetr_ros.config import Settings, load
from codetr_ros.processes import launcher
from codetr_ros.records import Commit, Metrics, Record
from codetr_ros.ros.watch import Watcher
from codetr_ros.runs import folder as run_folder

RESULTS = Path(__file__).parent / 'results' / 'recording_overhead.md'
DEADLINE = 1800.0  # [s] for one run
WORK = ('simulate_seconds', 'fit_seconds', 'label_seconds', 'update_seconds')
"""The metrics of the nodes' work; evaluation is left out, because it delays no node."""


class Run(NamedTuple):
    """One run's times [s], and the size of its bag."""

    loop: float
    rest: float
    recorder: float
    sync: float
    megabytes: float


class Clock:
    """The times of the first commit and of the learner's last metrics, and the work between."""

    def __init__(self, phases: int) -> None:
        self._last = 'learner', phases - 1
        self.first: float | None = None
        self.last: float | None = None
        self.work = 0.0

    def receive(self, record: Record) -> None:
        """Note the time and work of a record."""
        if isinstance(record, Commit) and self.first is None:
            self.first = time.perf_counter()
        if not isinstance(record, Metrics):
            return
        if (record.role, record.phase) == self._last:
            self.last = time.perf_counter()
        if (record.role, record.phase) != ('sim', 0):  # ended before the first commit
            metrics = dict(zip(record.names, record.values.tolist(), strict=True))
            self.work += sum(metrics.get(name, 0.0) for name in WORK)


def without_folder(command: launcher.Command) -> launcher.Command:
    """The same command, without the parameter that makes a recorder write a bag."""
    words = list(command.arguments)
    at = next(i for i, word in enumerate(words) if word.startswith('folder:='))
    return launcher.Command(command.name, command.role, (*words[: at - 1], *words[at + 1 :]))


def one_run(settings: Settings, bag: bool, number: int) -> Run:
    """Make a run and measure it."""
    clock = Clock(settings.phases)
    run_id = f'overhead_{os.getpid()}_{number}'
    recorder = 0.0
    with tempfile.TemporaryDirectory(prefix='codetr-overhead-') as where:
        folder = run_folder.create(Path(where) / 'run')
        run_folder.write_settings(folder, settings)
        commands = launcher.commands(settings, run_id, folder)
        if not bag:
            commands = [without_folder(c) if c.role == 'record' else c for c in commands]
        with (
            launcher.Processes(print) as processes,
            Watcher(clock.receive, f'/run_{run_id}') as watcher,
        ):
            processes.start(commands, folder / run_folder.LOGS, launcher.environment(settings))
            end = time.monotonic() + DEADLINE
            while processes.running() and not first_failure(processes):
                watcher.poll(0.1)
                recorder = max([recorder, *map(cpu_of, processes.running())])
                if time.monotonic() > end:
                    raise SystemExit(f'a run took more than {DEADLINE:g} s')
        check(processes)
        if clock.first is None or clock.last is None:
            raise SystemExit('the first commit or the last metrics did not arrive')
        sync, size = 0.0, 0.0
        if bag:
            path = run_folder.report_path(folder, 'record', 'record')
            report = json.loads(path.read_text())
            sync, size = report['flush_seconds'], report['bag_bytes'] / 1e6
    loop = clock.last - clock.first
    return Run(loop, loop - clock.work, recorder, sync, size)


def cpu_of(node: launcher.Node) -> float:
    """CPU seconds of a recorder's process so far; 0 for other nodes and ended ones."""
    if node.role != 'record':
        return 0.0
    try:
        return machine.cpu_seconds(node.process.pid)
    except (FileNotFoundError, ProcessLookupError):
        return 0.0


def table(pairs: list[tuple[Run, Run]], facts: dict[str, str]) -> str:
    """All pairs, and their summary."""
    names = ('loop', 'rest', 'recorder')
    head = [f'{name} {how} [s]' for name in names for how in ('with', 'without')]
    lines = [
        '# What recording costs',
        '',
        f'| pair | {" | ".join(head)} | sync [s] |',
        '|---|' + '---:|' * (len(head) + 1),
    ]
    for i, (a, b) in enumerate(pairs, 1):
        cells = [f'{getattr(run, name):.2f}' for name in names for run in (a, b)]
        lines.append(f'| {i} | {" | ".join(cells)} | {a.sync:.3f} |')
    costs = {
        f'{name}: (with - without) / loop': [
            (getattr(a, name) - getattr(b, name)) / b.loop for a, b in pairs
        ]
        for name in ('rest', 'recorder')
    }
    costs['sync / loop'] = [a.sync / a.loop for a, _ in pairs]
    for name, of in costs.items():
        facts[name] = f'median {statistics.median(of):.2%}, {min(of):.2%} to {max(of):.2%}'
    ratios = [a.loop / b.loop for a, b in pairs]
    facts['loop with / without'] = (
        f'median {statistics.median(ratios):.3f}, {min(ratios):.3f} to {max(ratios):.3f}'
    )
    facts['bag'] = f'{statistics.median(a.megabytes for a, _ in pairs):.1f} MB'
    return '\n'.join([*lines, '', *(f'- {name}: {fact}' for name, fact in facts.items())]) + '\n'


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--config', default='quick', help='preset or YAML file')
    parser.add_argument('--steps', type=int, help='of a run; by default as in the config')
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
