"""The costs of the node graph itself: idle nodes, a phase on its way, overlap, threads.

    .venv/bin/python benchmarks/nodes.py                   # on an idle machine, 15 minutes
    .venv/bin/python benchmarks/nodes.py --parts idle crossing

idle      CPU of each node, in per cent of a core, while it waits: before a learner has announced
          a run, and in a run whose learner is stopped (SIGSTOP), so that no node has work.
crossing  Time of a phase of 1000 steps of Ant (105 observations) from records in one process to
          records in another: made into messages, published, received, checked, copied. Beside it
          the same bytes published and received raw, and copied once within a process.
runs      Whole runs in rounds, timed from the first permission to the last commit: over topics
          and in process, each in lock-step and with overlap (equal lag, so equal learning); over
          topics with two threads per process, and, once, with threads that spin while they wait.

Writes `results/nodes.csv` (every round) and `results/nodes.md`.
"""

import argparse
import csv
import os
import signal
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from started import check

import machine
import throughput
from codetr_ros.bags.definitions import decode, encode
from codetr_ros.config import Settings, load
from codetr_ros.processes import launcher
from codetr_ros.records import Commit, CompositeReward, Record, Transitions
from codetr_ros.runs import folder as run_folder

RESULTS = Path(__file__).parent / 'results'
PARTS = ('idle', 'crossing', 'runs')
COLUMNS = ('part', 'what', 'unit', 'value')
OBSERVATIONS, ACTIONS, PHASE, DELAY = 105, 8, 1000, 25
DEADLINE = 120.0  # [s] for every wait
Row = tuple[str, str, str, float]


# ----------------------------------------------------------------------------------------------
# idle


def per_cent(nodes: Iterable[launcher.Node], seconds: float) -> dict[str, float]:
    """CPU of each node in per cent of a core over some seconds."""
    watched = [node for node in nodes if node.code is None]
    before, began = [machine.cpu_seconds(node.process.pid) for node in watched], time.monotonic()
    time.sleep(seconds)  # the measurement: nodes that have nothing to do
    spent = time.monotonic() - began
    return {
        node.name: 100 * (machine.cpu_seconds(node.process.pid) - then) / spent
        for node, then in zip(watched, before, strict=True)
    }


def idle(settings: Settings, seconds: float) -> Iterator[Row]:
    """CPU of nodes that wait for a run, and of nodes of a run that stands still."""
    from codetr_ros.ros.watch import Watcher

    with tempfile.TemporaryDirectory(prefix='codetr-idle-') as where:
        folder = run_folder.create(Path(where) / 'run')
        run_folder.write_settings(folder, settings)
        run_id = f'idle_{os.getpid()}'
        commands = launcher.commands(settings, run_id, folder)
        learner = [c for c in commands if c.role == 'learner']
        others = [c for c in commands if c.role != 'learner']
        env = launcher.environment(settings)
        committed: list[int] = []

        def note(record: Record) -> None:
            if isinstance(record, Commit):
                committed.append(record.phase)

        with launcher.Processes(print) as processes, Watcher(note, f'/run_{run_id}') as watcher:
            processes.start(others, folder / run_folder.LOGS, env)
            time.sleep(10)  # until imports are done
            for name, value in per_cent(processes.running(), seconds).items():
                yield 'idle', f'{name}, before a run', '% of a core', value
            processes.start(learner, folder / run_folder.LOGS, env)
            end = time.monotonic() + DEADLINE
            while len(committed) < settings.warmup_phases + 1:
                watcher.poll(0.1)
                check(processes)
                if time.monotonic() > end:
                    raise SystemExit(f'{len(committed)} phases in {DEADLINE:g} s: too slow')
            stopped = next(n for n in processes.running() if n.role == 'learner').process
            stopped.send_signal(signal.SIGSTOP)
            try:
                time.sleep(5)  # until the others have finished their work
                used = per_cent(processes.running(), seconds)
            finally:
                stopped.send_signal(signal.SIGCONT)
            for name, value in used.items():
                if name != 'learner':
                    yield 'idle', f'{name}, learner stopped', '% of a core', value


# ----------------------------------------------------------------------------------------------
# crossing


def a_phase(phase: int) -> list[Record]:
    """1000 steps of Ant and their scores, in the chunks of a simulator."""
    from codetr_ros.simulation.chunks import chunk_steps

    rng = np.random.default_rng(phase)
    most, records = chunk_steps(OBSERVATIONS, ACTIONS), list[Record]()
    for sequence, first in enumerate(range(0, PHASE, most)):
        steps = min(most, PHASE - first)
        last = first + steps == PHASE
        seen = rng.standard_normal((steps + 1, OBSERVATIONS), dtype=np.float32)
        actions = rng.random((steps, ACTIONS), dtype=np.float32)
        due = PHASE // DELAY if last else 0
        records.append(
            Transitions(
                run_id='run',
                source='sim',
                sequence=sequence,
                phase=phase,
                episode=phase,
                first_step=first,
                steps=steps,
                observations=seen,
                actions=actions,
                terminated=False,
                truncated=last,
                phase_end=last,
                scores_due=due,
            )
        )
    for i in range(PHASE // DELAY):
        records.append(
            CompositeReward(
                run_id='run',
                source='sim',
                scorer='sim',
                sequence=i,
                episode=phase,
                first_step=DELAY * i,
                length=DELAY,
                value=1.0,
            )
        )
    return records


class End:
    """One of the two processes: publishes phases and receives them."""

    def __init__(self, name: str, receives: str, publishes: str) -> None:
        import rclpy
        from codetr_msgs.msg import CompositeReward as ScoreMessage
        from codetr_msgs.msg import Transitions as StepsMessage
        from rclpy.experimental import EventsExecutor
        from std_msgs.msg import Float64, UInt8MultiArray

        from codetr_ros.ros import qos

        self.bytes_message, self.number = UInt8MultiArray, Float64
        rclpy.init()
        self.node = rclpy.create_node(name)
        self.executor = EventsExecutor()
        self.executor.add_node(self.node)
        profile = qos.profile('transitions', load('paper'))
        self.kinds = {Transitions: StepsMessage, CompositeReward: ScoreMessage}
        self.to = {
            kind: self.node.create_publisher(message, f'{publishes}_{kind.__name__}', profile)
            for kind, message in self.kinds.items()
        }
        self.inbox: list[tuple[type, bytes]] = []
        for kind, message in self.kinds.items():
            self.node.create_subscription(
                message, f'{receives}_{kind.__name__}', self._storing(kind), profile, raw=True
            )
        self.raw_inbox: list[bytes] = []
        for kind, message in self.kinds.items():
            self.to[kind, 'raw'] = self.node.create_publisher(
                message, f'{publishes}_raw_{kind.__name__}', profile
            )
            self.node.create_subscription(
                message,
                f'{receives}_raw_{kind.__name__}',
                self.raw_inbox.append,
                profile,
                raw=True,
            )

    def _storing(self, kind: type) -> Callable[[bytes], None]:
        return lambda data: self.inbox.append((kind, data))

    def matched(self) -> bool:
        """Whether the other end is there."""
        return all(publisher.get_subscription_count() for publisher in self.to.values())

    def publish(self, records: list[Record]) -> None:
        """Publish records, as a node does."""
        for record in records:
            self.to[type(record)].publish(encode(record, self.node.get_clock().now().nanoseconds))

    def receive(self, count: int) -> list[Record]:
        """Receive records, as a node does, with their own copies of the arrays."""
        self._wait(self.inbox, count)
        arrived, self.inbox[:] = list(self.inbox), []
        return [decode(kind, data) for kind, data in arrived]

    def receive_raw(self, count: int) -> list[bytes]:
        """Receive messages as raw bytes."""
        self._wait(self.raw_inbox, count)
        arrived, self.raw_inbox[:] = list(self.raw_inbox), []
        return arrived

    def _wait(self, inbox: list[Any], count: int) -> None:
        end = time.monotonic() + DEADLINE
        while len(inbox) < count:
            self.executor.spin_once(timeout_sec=1.0)
            if time.monotonic() > end:
                raise SystemExit(f'{len(inbox)} of {count} messages arrived within {DEADLINE:g} s')


def echo() -> None:
    """The other process: prints when everything has arrived, by the clock that both share."""
    end = End('echo', 'there', 'back')
    for line in sys.stdin:
        what, count = line.split()
        if what == 'ready':
            while not end.matched():
                end.executor.spin_once(timeout_sec=0.05)
        elif what == 'records':
            end.receive(int(count))
        else:
            end.receive_raw(int(count))
        print(time.monotonic(), flush=True)


def crossing(phases: int) -> Iterator[Row]:
    """Milliseconds of each phase."""
    other = subprocess.Popen(
        [sys.executable, __file__, '--echo'],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **launcher.environment(load('quick'))},
    )
    assert other.stdin
    assert other.stdout

    def ask(what: str, count: int) -> None:
        other.stdin.write(f'{what} {count}\n')
        other.stdin.flush()

    end = End('crossing', 'back', 'there')
    ask('ready', 0)
    while not end.matched():
        end.executor.spin_once(timeout_sec=0.05)
    other.stdout.readline()
    try:
        for number in range(phases + 5):
            records = a_phase(number)
            ask('records', len(records))
            time.sleep(0.02)  # until it waits: a busy node is slower
            began = time.monotonic()
            end.publish(records)
            took = float(other.stdout.readline()) - began
            raw = [
                (end.to[type(r), 'raw'], encode(r, end.node.get_clock().now().nanoseconds))
                for r in records
            ]
            ask('raw', len(records))
            time.sleep(0.02)
            began = time.monotonic()
            for publisher, data in raw:
                publisher.publish(data)
            took_raw = float(other.stdout.readline()) - began
            whole = bytearray(b''.join(data for _, data in raw))
            began = time.monotonic()
            bytes(whole)
            copied = time.monotonic() - began
            if number >= 5:  # the first ones warm up caches
                yield 'crossing', 'a phase, records to records', 'ms', 1e3 * took
                yield 'crossing', 'a phase, raw bytes', 'ms', 1e3 * took_raw
                yield 'crossing', 'a phase, copied in memory', 'ms', 1e3 * copied
    finally:
        other.stdin.close()
        other.wait(DEADLINE)


# ----------------------------------------------------------------------------------------------
# runs


def runs(steps: int, rounds: int) -> Iterator[Row]:
    """Seconds from the first permission to the last commit, in rounds of all ways."""
    flags = ['--config', 'quick', '--steps', str(steps)]
    overlap = [*flags, '--overlap']
    two = [*overlap, '--threads', '2']
    # threads wait like this without the environment of `codetr train`
    spin = {'GOMP_SPINCOUNT': 'infinity'}
    ways: dict[str, tuple[list[str], bool, dict[str, str]]] = {
        'in process, lock-step': (flags, True, {}),
        'over topics, lock-step': (flags, False, {}),
        'in process, overlap': (overlap, True, {}),
        'over topics, overlap': (overlap, False, {}),
        'over topics, overlap, 2 threads each': (two, False, {}),
        'over topics, overlap, 2 threads each that spin': (two, False, spin),
    }
    for number in range(rounds):
        for way, (given, in_process, environ) in ways.items():
            if environ and number:
                continue  # takes minutes, and the difference is large
            os.environ.update(environ)
            times = throughput.whole_run(given, in_process)
            for name in environ:
                del os.environ[name]
            yield 'runs', way, 's', times['loop']


# ----------------------------------------------------------------------------------------------


def table(rows: list[Row], facts: dict[str, str]) -> str:
    """Median, lowest and highest of everything."""
    by_row: dict[tuple[str, str, str], list[float]] = {}
    for part, what, unit, value in rows:
        by_row.setdefault((part, what, unit), []).append(value)
    lines = [
        '# What the node graph costs',
        '',
        '| part | what | unit | rounds | median | lowest | highest |',
        '|---|---|---|---:|---:|---:|---:|',
    ]
    for (part, what, unit), values in by_row.items():
        numbers = statistics.median(values), min(values), max(values)
        cells = ' | '.join(f'{number:.4g}' for number in numbers)
        lines.append(f'| {part} | {what} | {unit} | {len(values)} | {cells} |')
    return '\n'.join([*lines, '', *(f'- {name}: {fact}' for name, fact in facts.items())]) + '\n'


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--parts', nargs='+', choices=PARTS, default=list(PARTS))
    parser.add_argument('--seconds', type=float, default=10.0, help='idle: how long to measure')
    parser.add_argument('--phases', type=int, default=100, help='crossing: number of phases')
    parser.add_argument('--steps', type=int, default=6000, help='runs: steps of each')
    parser.add_argument('--rounds', type=int, default=3, help='runs: number of rounds')
    parser.add_argument('--out', type=Path, default=RESULTS)
    parser.add_argument('--echo', action='store_true', help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.echo:
        echo()
        return 0
    facts = machine.facts(machine.load(), ('numpy', 'torch'))
    settings = load('quick')
    os.environ.update(launcher.environment(settings))
    makers = {
        'idle': lambda: idle(settings, given.seconds),
        'crossing': lambda: crossing(given.phases),
        'runs': lambda: runs(given.steps, given.rounds),
    }
    rows: list[Row] = []
    for part in given.parts:
        for row in makers[part]():
            rows.append(row)
            if part != 'crossing':
                print(*row, flush=True)
    given.out.mkdir(parents=True, exist_ok=True)
    with (given.out / 'nodes.csv').open('w', newline='') as file:
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(COLUMNS)
        writer.writerows((*row[:3], f'{row[3]:.6g}') for row in rows)
    text = table(rows, facts)
    (given.out / 'nodes.md').write_text(text)
    print(text, end='')
    return 0


if __name__ == '__main__':
    sys.exit(main())
