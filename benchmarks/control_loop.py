"""How late are control steps of a robot, beside the learner that learns from it? One command.

    .venv/bin/python benchmarks/control_loop.py --minutes 60

The stand-in arm of examples/robot_arm, the robot node at 50 Hz, learner, reward node, recorder
and inspection run in real time, as `codetr demo robot` starts them, so long. The arm is never
reset, so that every period has a control step. For each step the robot node notes how long after
its deadline the step began. A deadline is missed where a step began a whole period late, so that
no command left in that period.

With --strangers, nodes of others come, go, are killed and held in the same ROS domain meanwhile
(strangers.py). Else it is as quiet as ROS_DOMAIN_ID makes it. The load of the machine is looked at
every ten seconds.

A line for each call goes to results/control_loop.csv, the table to results/control_loop.md. A run
that is stopped (Ctrl-C) still has a line, of what was measured until its last phase.
"""

import argparse
import csv
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any

import yaml
from rows import Rows

import machine
from codetr_ros.bags.reader import Bag
from codetr_ros.processes import middleware
from codetr_ros.records import Metrics

HERE = Path(__file__).parent
EXAMPLE = HERE.parent / 'examples' / 'robot_arm'
RESULTS = HERE / 'results' / 'control_loop.csv'
MEASURED = (
    *('control_steps', 'deadlines_missed', 'late_ms_p50', 'late_ms_p99', 'late_ms_p99.9'),
    'late_ms_max',
)
SHOWN = {
    'late_ms_p50': 'median',
    'late_ms_p99': '99 %',
    'late_ms_p99.9': '99.9 %',
    'late_ms_max': 'most',
}
LOOK_EVERY = 10.0  # [s] at the load
STARTING = 20.0  # [s] until a run has its first phase


def example(folder: Path, rate: float, minutes: float) -> int:
    """Copy the example, at another rate and never reset; returns the number of control steps."""
    shutil.copytree(EXAMPLE, folder, ignore=shutil.ignore_patterns('__pycache__'))
    mapping = yaml.safe_load((folder / 'live.yaml').read_text())
    mapping['live'] |= {'rate': rate, 'episode_steps': 100, 'reset': {'by': 'nobody'}}
    mapping['sampling'] |= {'rate': rate}
    (folder / 'live.yaml').write_text(yaml.safe_dump(mapping))
    settings = yaml.safe_load((folder / 'settings.yaml').read_text())
    steps = round(60 * minutes * rate)
    phase = max(100, min(1000, steps // 10))
    settings |= {'steps': steps, 'phase_steps': phase, 'warmup_steps': 2 * phase, 'delay': 50}
    (folder / 'settings.yaml').write_text(yaml.safe_dump(settings))
    return steps


def measured(bag: Path) -> dict[str, float]:
    """The robot's newest metrics in a bag."""
    newest: dict[str, float] = {}
    for entry in Bag(bag).entries((Metrics,)):
        record: Any = entry.record
        if record.role == 'sim':
            newest = dict(zip(record.names, record.values.tolist(), strict=True))
    return newest


class Load:
    """Looks at the load of the machine every so often, in a thread of its own.

    Attributes:
        seen: the averages of the last minute.
    """

    def __init__(self) -> None:
        self.seen: list[float] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)

    def _look(self) -> None:
        while not self._over.wait(LOOK_EVERY):
            self.seen.append(os.getloadavg()[0])

    def __enter__(self) -> 'Load':
        self._thread.start()
        return self

    def __exit__(self, *_error: object) -> None:
        self._over.set()
        self._thread.join()

    def __str__(self) -> str:
        if not self.seen:
            return 'unknown'
        return f'{sum(self.seen) / len(self.seen):.1f} (most {max(self.seen):.1f})'


@contextmanager
def strangers(seconds: float) -> Iterator[None]:
    """Nodes of others come and go meanwhile, from some seconds after the begin on."""
    lasting = str(max(0.0, seconds - STARTING))
    command = [sys.executable, str(HERE / 'strangers.py'), lasting, str(STARTING)]
    environment = middleware.DEFAULTS | os.environ
    process = subprocess.Popen(command, env=environment)
    try:
        yield
    finally:
        process.terminate()
        process.wait()


def main() -> int:
    """Measure, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--minutes', type=float, default=60.0)
    parser.add_argument('--rate', type=float, default=50.0, help='control steps a second')
    parser.add_argument('--seed', type=int, default=0)
    parser.add_argument('--strangers', action='store_true', help='others come and go meanwhile')
    parser.add_argument('--keep', type=Path, help='keep the folder of the run here')
    parser.add_argument('--dry', action='store_true', help='write no results')
    given = parser.parse_args()
    load, began = machine.load(), time.monotonic()
    with tempfile.TemporaryDirectory() as temporary:
        copy, out = Path(temporary) / 'robot_arm', given.keep or Path(temporary) / 'run'
        steps = example(copy, given.rate, given.minutes)
        command = [sys.executable, '-m', 'codetr_ros.cli', 'demo', 'robot', '--out', str(out)]
        command += ['--seed', str(given.seed), '--example', str(copy)]
        beside = strangers(60 * given.minutes) if given.strangers else nullcontext()
        with Load() as during, beside:
            code = subprocess.run(command, check=False).returncode
        found = measured(out / 'bag')
    row = {
        'commit': machine.commit(),
        'processor': machine.processor(),
        'cores': os.cpu_count(),
        'load before': load,
        'load meanwhile': str(during),
        'strangers': 'come and go' if given.strangers else 'none started',
        'rate': given.rate,
        'steps asked for': steps,
        'minutes': round((time.monotonic() - began) / 60, 1),
        'exit code': code,
    } | {name: round(found.get(name, float('nan')), 3) for name in MEASURED}
    if given.dry:
        print(row)
        return code
    Rows(RESULTS, list(row), 1).append(list(row.values()))
    with RESULTS.open() as file:
        RESULTS.with_suffix('.md').write_text(table(list(csv.DictReader(file))))
    return code


def table(everything: list[dict[str, str]]) -> str:
    """The results as a page."""
    head = ['rate [Hz]', 'control steps', 'missed', *SHOWN.values(), 'cores', 'load']
    head += ['other nodes', 'commit']
    lines = [
        '# Lateness of control steps [ms], beside the learner',
        '',
        'Made by `benchmarks/control_loop.py`. The load is the average of the last minute, looked '
        'at every ten seconds; the nodes themselves are in it. Other nodes: those that the '
        'benchmark let come, go, be killed and held in the same ROS domain (`--strangers`).',
        '',
        f'| {" | ".join(head)} |',
        f'|{"---:|" * len(head)}',
    ]
    for row in everything:
        cells = [row['rate'], *(row[n].removesuffix('.0') for n in MEASURED[:2])]
        cells += [row[name] for name in SHOWN]
        cells += [row['cores'], row['load meanwhile'], row['strangers'], row['commit']]
        lines.append(f'| {" | ".join(cells)} |')
    return '\n'.join(lines) + '\n'


if __name__ == '__main__':
    sys.exit(main())
