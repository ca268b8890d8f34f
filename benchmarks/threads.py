"""When does a second thread pay, and how should threads wait?

    .venv/bin/python benchmarks/threads.py            # on an idle machine of two cores, 15 minutes
    .venv/bin/python benchmarks/threads.py --parts lock-step quick

Parts:
  - sizes: SAC updates in a process of its own, with one thread and with two, for several widths
    and batches; 256 wide also for each way in which threads can wait
  - quick: whole runs of preset `quick`, over topics
  - lock-step, in-process, overlap, simulators: whole runs of preset `cpu` (256 wide), shortened
  - side-by-side: two runs in process at a time
Of each run there is the way before (one thread, OpenMP told not to spin) and two threads. The
ways take turns.

`others` is what everything else on the machine used meanwhile, in cores: a row with more than 0.1
was disturbed. Rows are added to `results/threads.csv`, and `results/threads.md` is made anew from
all of it: remove the CSV file to begin anew.
"""

import argparse
import csv
import os
import resource
import statistics
import sys
import time
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import sac_updates

import machine
import throughput

RESULTS = Path(__file__).parent / 'results' / 'threads.csv'
PACKAGES = ('numpy', 'torch')
COLUMNS = ('part', 'what', 'way', 'round', 'unit', 'value', 'update_s', 'others', 'commit')
BEFORE = '1 thread'
WAITS = {
    'sleep at once': '0',
    'spin 200': '200',
    'spin 2000': '2000',
    'spin 20000': '20000',
    "OpenMP's own (300000)": '300000',
}
SHORT = ['--config', 'cpu', '--steps', '3000', '--warmup-steps', '1000']
SIZES = ((256, 256), (128, 128))
"""Width and batch."""


@dataclass(frozen=True)
class Runs:
    """Whole runs that are compared.

    Attributes:
        flags: of `codetr train`.
        in_process: without nodes.
        at_a_time: how many of them at the same time.
    """

    flags: list[str]
    in_process: bool = False
    at_a_time: int = 1


RUNS = {
    'quick': Runs(['--config', 'quick']),
    'lock-step': Runs(SHORT),
    'in-process': Runs(SHORT, in_process=True),
    'overlap': Runs([*SHORT, '--overlap']),
    'simulators': Runs([*SHORT, '--simulators', '2']),
    'side-by-side': Runs(SHORT, in_process=True, at_a_time=2),
}


class Busy:
    """How much of the machine others use meanwhile."""

    def __init__(self) -> None:
        self._before = self._now()

    def _now(self) -> tuple[float, float, float]:
        ticks = [
            int(word) for word in Path('/proc/stat').read_text().split('\n', 1)[0].split()[1:]
        ]
        busy = sum(ticks[:3]) + sum(ticks[5:7])  # user, nice, system; interrupts
        mine = sum(
            getattr(resource.getrusage(who), clock)
            for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)
            for clock in ('ru_utime', 'ru_stime')
        )
        return time.monotonic(), busy / os.sysconf('SC_CLK_TCK'), mine

    def others(self, mine: float | None = None) -> float:
        """The cores that other processes have used since the start.

        Args:
            mine: CPU seconds of ours; None: those of children that have ended.
        """
        began, busy, used = self._before
        now, busy_now, used_now = self._now()
        spent = used_now - used if mine is None else mine
        return max(0.0, (busy_now - busy - spent) / (now - began))


def sizes(rounds: int) -> Iterator[dict[str, object]]:
    """Updates a second."""
    for width, batch in SIZES:
        for form in ('compiled', 'eager'):
            ways = {'1 thread, sleep at once': (1, '0'), '2 threads, spin 2000': (2, '2000')}
            if (width, batch, form) == (256, 256, 'compiled'):
                ways |= {f'2 threads, {name}': (2, spins) for name, spins in WAITS.items()}
            workers = {}
            for way, (threads, spins) in ways.items():
                size = sac_updates.Size('HalfCheetah', 17, 6, width, batch, threads)
                wait = {'OMP_WAIT_POLICY': 'PASSIVE', 'GOMP_SPINCOUNT': spins}
                workers[way] = sac_updates.Worker(form, size, sys.executable, wait)
                workers[way].round(sac_updates.BURST)  # not counted
            updates = sac_updates.BURST * max(1, round(2 * 256**3 / (batch * width**2)))
            for n in range(rounds):
                for way, worker in workers.items():
                    busy = Busy()
                    times = worker.round(updates)
                    rate = updates / times['wall']
                    what = f'{width} wide, batch {batch}, {form}'
                    facts = {'what': what, 'way': way, 'round': n, 'unit': 'updates/s'}
                    yield facts | {'value': rate, 'others': busy.others(times['cpu'])}
            for worker in workers.values():
                worker.end()


def runs(some: Runs, rounds: int) -> Iterator[dict[str, object]]:
    """Seconds of whole runs."""
    two = [*some.flags, '--threads', '2']
    ways: dict[str, tuple[list[str], dict[str, str]]] = {
        BEFORE: ([*some.flags, '--threads', '1'], {'GOMP_SPINCOUNT': '0'}),
        '2 threads, spin 20000': (two, {'GOMP_SPINCOUNT': '20000'}),
        '2 threads, spin 2000': (two, {'GOMP_SPINCOUNT': '2000'}),
    }
    what = f'codetr train {" ".join(some.flags)}' + ' --in-process' * some.in_process
    what += f', {some.at_a_time} at a time' * (some.at_a_time > 1)
    for n in range(rounds):
        for way, (flags, wait) in ways.items():
            busy = Busy()
            times = side_by_side(some, flags, wait)
            facts = {'what': what, 'way': way, 'round': n, 'unit': 's'}
            yield facts | {
                'value': max(one['wall'] for one in times),
                'update_s': max(one['update_seconds'] for one in times),
                'others': busy.others(),
            }


def side_by_side(some: Runs, flags: list[str], wait: Mapping[str, str]) -> list[dict[str, float]]:
    """The times of runs that begin together."""
    environment = {name: v for name, v in os.environ.items() if name != 'OMP_NUM_THREADS'}
    environment |= wait
    with ThreadPoolExecutor(some.at_a_time) as pool:
        begun = [
            pool.submit(throughput.whole_run, flags, some.in_process, environment)
            for _ in range(some.at_a_time)
        ]
        return [one.result() for one in begun]


def table(rows: Iterable[dict[str, str]], facts: Mapping[str, str]) -> str:
    """Medians, and how much faster each way is than the first, round by round."""
    by_what: dict[tuple[str, str], dict[str, list[dict[str, str]]]] = {}
    for row in rows:
        ways = by_what.setdefault((row['part'], row['what']), {})
        ways.setdefault(row['way'], []).append(row)
    lines = [
        '# When a second thread pays',
        '',
        'What is measured: `benchmarks/threads.py`. Median round [lowest, highest]; as fast as',
        'the first way of its block, round by round. `others`: cores that everything else used.',
        '',
        '| part | what | way | | SAC updates [s] | times as fast | others, at most |',
        '|---|---|---|---:|---:|---:|---:|',
    ]
    for (part, what), ways in by_what.items():
        first = {row['round']: float(row['value']) for row in next(iter(ways.values()))}
        for way, some in ways.items():
            values = [float(row['value']) for row in some]
            unit = some[0]['unit']
            pairs = [(first[r['round']], float(r['value'])) for r in some if r['round'] in first]
            ratios = [a / b if unit == 's' else b / a for a, b in pairs]
            updates = [float(row['update_s']) for row in some if row['update_s']]
            cells = [part, what, way, f'{machine.spread(values, ".1f")} {unit}']
            cells.append(f'{statistics.median(updates):.1f}' if updates else '')
            cells.append(machine.spread(ratios, '.2f') if ratios else '')
            cells.append(f'{max(float(row["others"]) for row in some):.2f}')
            lines.append(f'| {" | ".join(cells)} |')
    lines += ['', *(f'- {name}: {fact}' for name, fact in facts.items())]
    return '\n'.join(lines) + '\n'


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--parts', nargs='*', choices=('sizes', *RUNS), default=['sizes', *RUNS])
    parser.add_argument('--rounds', type=int, default=2, help='rounds of all ways')
    parser.add_argument('--out', type=Path, default=RESULTS, help='CSV file')
    arguments = parser.parse_args()
    facts = machine.facts(machine.load(), PACKAGES)
    if not arguments.out.is_file():
        arguments.out.write_text(','.join(COLUMNS) + '\n')
    for part in arguments.parts:
        measured = (
            sizes(arguments.rounds) if part == 'sizes' else runs(RUNS[part], arguments.rounds)
        )
        for row in measured:
            numbers = {k: f'{v:.2f}' for k, v in row.items() if isinstance(v, float)}
            full = {'part': part, 'commit': facts['commit']} | row | numbers
            print(*full.values(), flush=True)
            with arguments.out.open('a', newline='') as file:
                csv.DictWriter(file, COLUMNS, lineterminator='\n').writerow(full)
    with arguments.out.open(newline='') as file:
        text = table(csv.DictReader(file), facts)
    arguments.out.with_suffix('.md').write_text(text)
    print(text)
    return 0


if __name__ == '__main__':
    sys.exit(main())
