"""Does a run of hours stay as small and as fast as it was at its beginning?

    .venv/bin/python benchmarks/soak.py --out /tmp/soak --hours 2
    .venv/bin/python benchmarks/soak.py --out /tmp/soak --steps 8000000

`codetr train` over topics with preset `quick`, small networks and a memory that is full after
50 000 steps, so that nothing need grow from then on. Each minute: the resident memory, open files
and threads of each node, files and bytes in `/dev/shm`, and the seconds that a phase took since
the minute before. The run ends after so many hours or steps. The same command goes on with a run
that was ended, or whose machine was (`codetr train --resume`), and with its table.

Writes `results/soak.csv`, and `results/soak.md` with the slope of each column: a line fitted by
least squares to all minutes after the first tenth of each session, and to those of its last fifth.
Until then nodes fill what they remember: a recorder the newest 100 000 records, say.
"""

import argparse
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from kills import CODETR, nodes, phase_of
from rows import Rows

import machine

RESULTS = Path(__file__).parent / 'results'
ROLES = ('sim', 'record', 'reward', 'learner', 'evaluate')
OF_NODES = ('mb', 'files', 'threads')
OF_RUN = ('shm_files', 'shm_mb', 'phase_s')
COLUMNS = (
    'session',
    'seconds',
    'phase',
    *(f'{r}_{what}' for r in ROLES for what in OF_NODES),
    *OF_RUN,
)
FLAGS = (
    '--config', 'quick', '--memory-steps', '50000', '--sac.hidden', '32', '32',
    '--evaluate-every', '20000', '--no-film',
)  # fmt: skip
EVER = 1_000_000_000
SLOWEST_START = 120.0  # [s]


def of_process(pid: int) -> tuple[float, int, int]:
    """Resident memory [MB], open files and threads of a process."""
    status = dict(
        line.split(':', 1) for line in Path(f'/proc/{pid}/status').read_text().splitlines()
    )
    memory = int(status['VmRSS'].split()[0]) / 1000
    return memory, len(os.listdir(f'/proc/{pid}/fd')), int(status['Threads'])


def shared_memory() -> tuple[int, float]:
    """Files in `/dev/shm`, and the megabytes that they take."""
    sizes = []
    for entry in Path('/dev/shm').iterdir():
        try:
            sizes.append(entry.stat().st_blocks * 512)
        except FileNotFoundError:
            continue  # gone meanwhile
    return len(sizes), sum(sizes) / 1e6


def sample(folder: Path) -> list[float]:
    """A row without its first three columns and the last; empty if a node is not there."""
    there = nodes(folder)
    if set(ROLES) - set(there):
        return []
    try:
        values = [value for role in ROLES for value in of_process(there[role])]
    except (OSError, KeyError):  # it has ended meanwhile
        return []
    return [*values, *shared_memory()]


def watch(folder: Path, command: 'subprocess.Popen[bytes]', hours: float, every: float) -> None:
    """Append rows to the table until the run, or its time, is over."""
    rows = Rows(RESULTS / 'soak.csv', COLUMNS, 2)
    session = 1 + max((int(row['session']) for row in rows.read()), default=0)
    began = before = time.monotonic()
    phase = phase_of(folder)
    while command.poll() is None and time.monotonic() - began < hours * 3600:
        try:
            command.wait(every)
        except subprocess.TimeoutExpired:
            now, done = time.monotonic(), phase_of(folder)
            if done > phase and (values := sample(folder)):
                shown = [f'{value:.1f}' for value in values]
                taken = f'{(now - before) / (done - phase):.3f}'
                rows.append([session, f'{now - began:.0f}', done, *shown, taken])
                before, phase = now, done
    if command.poll() is None:
        command.send_signal(signal.SIGINT)
    command.wait()


def slope(times: Sequence[float], values: Sequence[float]) -> float:
    """Of a line through the points, by least squares."""
    return float(np.polyfit(times, values, 1)[0]) if len(set(times)) > 1 else 0.0


def write_table() -> None:
    """Write the slopes of all columns."""
    rows = Rows(RESULTS / 'soak.csv', COLUMNS, 2).read()
    sessions = sorted({int(row['session']) for row in rows})
    lines = ['# A run of hours', '']
    steady: list[dict[str, str]] = []
    late: list[dict[str, str]] = []
    for session in sessions:
        own = [row for row in rows if int(row['session']) == session]
        steady += own[len(own) // 10 :]
        late += own[-(-len(own) * 4 // 5) :]
        lines.append(f'- session {session}: {len(own)} samples in {own[-1]["seconds"]} s')
    lines += [
        '', '| column | first | last | slope per 1000 phases | in the last fifth |',
        '|---|---:|---:|---:|---:|',
    ]  # fmt: skip
    for name in COLUMNS[3:]:
        slopes = [
            1000 * slope([float(row['phase']) for row in some], [float(row[name]) for row in some])
            for some in (steady, late)
        ]
        ends = ' | '.join(f'{float(row[name]):.3g}' for row in (steady[0], steady[-1]))
        lines.append(f'| {name} | {ends} | ' + ' | '.join(f'{x:+.2f}' for x in slopes) + ' |')
    facts = machine.facts(machine.load(), ('numpy', 'torch'))
    lines += ['', *(f'- {name}: {fact}' for name, fact in facts.items())]
    lines.append(f'- run: codetr train {" ".join(FLAGS)}')
    (RESULTS / 'soak.md').write_text('\n'.join(lines) + '\n')


def main() -> int:
    """Run the command line; returns the exit code of the run."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--out', type=Path, required=True, help='folder of the run')
    parser.add_argument('--hours', type=float, default=float(EVER), help='end after so long')
    parser.add_argument('--steps', type=int, default=EVER, help='end after so many steps')
    parser.add_argument('--every', type=float, default=60.0, help='seconds between two rows')
    given = parser.parse_args()
    steps = ['--steps', str(given.steps)]
    goes_on = (given.out / 'config.yaml').is_file()
    how = (
        ['--resume', str(given.out), '--no-film'] if goes_on else ['--out', str(given.out), *FLAGS]
    )
    log = given.out.with_suffix('.log')
    with log.open('ab') as file:
        command = subprocess.Popen(
            [str(CODETR), 'train', *how, *steps], stdout=file, stderr=subprocess.STDOUT
        )
        watch(given.out, command, given.hours, given.every)
    write_table()
    print((RESULTS / 'soak.md').read_text(), f'the run has logged to {log}', sep='\n')
    return command.returncode


if __name__ == '__main__':
    sys.exit(main())
