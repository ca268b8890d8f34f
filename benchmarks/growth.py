"""Does a run keep its speed, and its memory per step, when it gets long?

    .venv/bin/python benchmarks/growth.py                    # on an idle machine, 10 to 20 minutes

Makes runs over topics of 10 000, 100 000 and 1 000 000 steps that keep every step in memory. They
learn nearly nothing (method uniform, one update of a tiny network in a hundred steps), so that a
million steps take minutes. The rest is the cost of a run around the learning, and only that can
grow with its length. The time that reward models spend on labelling all of D again grows with D by
design; `codetr_speed.py` measures it.

For each run: seconds until the first permission; steps per second from there to the last commit,
of the whole loop and of its last tenth; peak memory of each process; bytes of the bag. Memory and
bag per step are differences between two lengths, without the part that does not grow.

Writes `results/growth.csv` and `results/growth.md`.
"""

import argparse
import csv
import json
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import machine
import throughput

RESULTS = Path(__file__).parent / 'results'
TASK = 'HalfCheetah-v5'
FLAGS = {
    'config': 'quick',
    'task': TASK,
    'method': 'uniform',
    'evaluate-every': 0,
    'sac.hidden': '16 16',
    'sac.batch': 16,
    'sac.updates-per-step': 0.01,
}
COLUMNS = ('steps', 'what', 'unit', 'value')


def one_run(steps: int) -> dict[str, Any]:
    """Make a run; returns its measurements."""
    with tempfile.TemporaryDirectory(prefix='codetr-growth-') as where:
        out = Path(where) / 'run'
        command = [sys.executable, '-m', 'codetr_ros.cli', 'train', '--out', str(out)]
        command += ['--no-film']
        command += ['--steps', str(steps), '--memory-steps', str(max(steps, 1000))]
        for name, value in FLAGS.items():
            command += [f'--{name}', *str(value).split()]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f'{" ".join(command)} failed:\n{(done.stdout + done.stderr)[-4000:]}')
        summary = json.loads((out / 'summary.json').read_text())
        start = (out / 'config.yaml').stat().st_mtime_ns
        first, commits = throughput.marks_of_bag(out / 'bag')
        size = sum(path.stat().st_size for path in (out / 'bag').iterdir())
    tenth = max(1, len(commits) // 10)
    phase = steps / len(commits)
    return {
        'start': (first - start) / 1e9,
        'rate': steps / (commits[-1] - first) * 1e9,
        'last rate': tenth * phase / (commits[-1] - commits[-1 - tenth]) * 1e9,
        'lost': summary['lost'],
        'bag': size,
        'memory': {
            process['role']: 1e6 * process['peak_rss_mb'] * 1.048576
            for process in summary['processes'].values()
        },
    }


def rows_of(lengths: Sequence[int], runs: Sequence[dict[str, Any]]) -> list[tuple[Any, ...]]:
    """The measurements, one number a row."""
    rows: list[tuple[Any, ...]] = []
    for i, (steps, run) in enumerate(zip(lengths, runs, strict=True)):
        rows += [
            (steps, 'start, to the first permission', 's', run['start']),
            (steps, 'steps, first permission to last commit', '1/s', run['rate']),
            (steps, 'steps, last tenth', '1/s', run['last rate']),
            (steps, 'messages lost', '', run['lost']),
            (steps, 'bag', 'MB', run['bag'] / 1e6),
        ]
        rows += [
            (steps, f'memory at its peak, {role}', 'MB', size / 1e6)
            for role, size in run['memory'].items()
        ]
        if not i:
            continue
        more, before = steps - lengths[i - 1], runs[i - 1]
        rows.append((steps, 'bag, each further step', 'B', (run['bag'] - before['bag']) / more))
        for role, size in run['memory'].items():
            each = (size - before['memory'][role]) / more
            rows.append((steps, f'memory, each further step, {role}', 'B', each))
    return rows


def table(lengths: Sequence[int], rows: list[tuple[Any, ...]], facts: dict[str, str]) -> str:
    """One column for each length."""
    by_row: dict[tuple[str, str], dict[int, float]] = {}
    for steps, what, unit, value in rows:
        by_row.setdefault((what, unit), {})[steps] = value
    lines = [
        '# Growth',
        '',
        f'| | | {" | ".join(f"{n:,} steps".replace(",", " ") for n in lengths)} |',
        '|---|---|' + '---:|' * len(lengths),
    ]
    for (what, unit), values in by_row.items():
        cells = [f'{values[n]:.4g}' if n in values else '' for n in lengths]
        lines.append(f'| {what} | {unit} | {" | ".join(cells)} |')
    return '\n'.join([*lines, '', *(f'- {name}: {fact}' for name, fact in facts.items())]) + '\n'


def main() -> int:
    """Run the command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--steps', type=int, nargs='+', default=[10_000, 100_000, 1_000_000])
    parser.add_argument('--out', type=Path, default=RESULTS)
    given = parser.parse_args()
    facts = machine.facts(machine.load(), ('numpy', 'torch', 'mujoco'))
    facts['run'] = ' '.join(f'--{name} {value}' for name, value in FLAGS.items())
    runs = []
    for steps in given.steps:
        runs.append(one_run(steps))
        print(steps, {k: v for k, v in runs[-1].items() if k != 'memory'}, flush=True)
    rows = rows_of(given.steps, runs)
    given.out.mkdir(parents=True, exist_ok=True)
    with (given.out / 'growth.csv').open('w', newline='') as file:
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(COLUMNS)
        writer.writerows((*row[:3], f'{row[3]:.6g}') for row in rows)
    text = table(given.steps, rows, facts)
    (given.out / 'growth.md').write_text(text)
    print(text, end='')
    return 0


if __name__ == '__main__':
    sys.exit(main())
