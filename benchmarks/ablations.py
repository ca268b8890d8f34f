"""Which reading of the paper learns better? CoDeTr's open switches, by return and by recovery.

    .venv/bin/python benchmarks/ablations.py run --out runs/ablations --workers 2
    .venv/bin/python benchmarks/ablations.py table --out runs/ablations

The paper leaves open which scalar becomes the step reward, how attention within the sequence is
scaled, in which unit composite rewards are fitted, how far back the causal transformer sees, and
whether segments or windows are labelled. `run` trains on one task under each reading, three seeds
each, as cells of `codetr benchmark run` (resumable like any benchmark); `table` writes the final
returns and how well step rewards were recovered at the last evaluation to
`benchmarks/results/ablations.csv` and `.md`.

Reacher-v5 with a score every 10 of its 50 steps, which is their sum or their soft maximum: 8000
steps of it take half a minute, and every step of it has a reward of its own, so that credit
matters and survival means nothing.
"""

import argparse
import csv
import json
import statistics
import subprocess
import sys
from pathlib import Path
from typing import Any

import yaml

TASK, DELAY, STEPS, SEEDS = 'Reacher-v5', 10, 8000, (0, 1, 2)
COMPOSITES = ('sum', 'max')
RESULTS = Path(__file__).parent / 'results'
READINGS: dict[str, dict[str, Any]] = {
    'as shipped (quick)': {},
    'label rhat': {'codetr.label': 'rhat'},
    'weights one': {'codetr.weights': 'one'},
    'head scale 1/sqrt(d)': {'codetr.head_scale': 'inverse_sqrt'},
    'head scale one': {'codetr.head_scale': 'one'},
    'initialisation lecun': {'codetr.initialisation': 'lecun'},
    'target scale none': {'target_scale': 'none'},
    'context episode': {'codetr.context': 'episode', 'codetr.window': 50},
    'label windows': {'codetr.labelling': 'window', 'codetr.window': 50},
    'label windows, rhat': {
        'codetr.labelling': 'window',
        'codetr.window': 50,
        'codetr.label': 'rhat',
    },
    'pair tokens': {'codetr.tokens': 'pair'},
}
REFERENCES = ('none', 'uniform', 'true')
"""Methods beside which the readings are put."""
COLUMNS = ('composite', 'reading', 'seed', 'final_return', 'pearson', 'within', 'wall_s', 'commit')


def spec(methods: list[str], changes: dict[str, Any]) -> dict[str, Any]:
    """A benchmark's specification."""
    return {
        'methods': methods,
        'tasks': [TASK],
        'composites': list(COMPOSITES),
        'delays': [DELAY],
        'seeds': list(SEEDS),
        'steps': STEPS,
        'config': {'base': 'quick', 'evaluate_every': 2000, **changes},
    }


def benchmarks() -> dict[str, dict[str, Any]]:
    """Every benchmark by the name of its folder."""
    found = {_slug(name): spec(['codetr'], changes) for name, changes in READINGS.items()}
    return found | {'references': spec(list(REFERENCES), {})}


def _slug(name: str) -> str:
    return ''.join(c if c.isalnum() else '_' for c in name)


def run(out: Path, workers: int) -> int:
    """Run what has not been run."""
    out.mkdir(parents=True, exist_ok=True)
    code = 0
    for name, data in benchmarks().items():
        path = out / f'{name}.yaml'
        path.write_text(yaml.safe_dump(data, sort_keys=False))
        command = [sys.executable, '-m', 'codetr_ros.cli', 'benchmark', 'run', str(path)]
        command += ['--out', str(out / name), '--workers', str(workers)]
        code |= subprocess.run(command, check=False).returncode
    return code


def rows(out: Path) -> list[dict[str, Any]]:
    """What the finished runs have shown."""
    names = {_slug(name): name for name in READINGS} | {'references': ''}
    found = []
    for slug, name in names.items():
        for path in sorted((out / slug).glob('*/summary.json')):
            summary = json.loads(path.read_text())
            recovered = (summary.get('reward_recovery') or [{}])[-1]
            ending = json.loads((out / slug / 'cells' / f'{path.parent.name}.json').read_text())
            found.append(
                {
                    'composite': summary['composite'],
                    'reading': name or f'method {summary["method"]}',
                    'seed': summary['seed'],
                    'final_return': summary['evaluations'][-1]['true_return_mean'],
                    'pearson': recovered.get('pearson'),
                    'within': recovered.get('within'),
                    'wall_s': summary['wall_s'],
                    'commit': ending.get('commit'),
                }
            )
    return sorted(found, key=lambda row: COMPOSITES.index(row['composite']))


def table(out: Path) -> None:
    """Write every run as CSV and the means over seeds as Markdown."""
    found = rows(out)
    with (RESULTS / 'ablations.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, COLUMNS)
        writer.writeheader()
        writer.writerows(found)
    lines = [
        f'{TASK}, delay {DELAY}, {STEPS} steps, preset quick: return of the last evaluation '
        '(10 episodes), by seed, and correlation of inferred and true step rewards then.',
        '',
        '| composite | reading | seeds | final return | by seed | Pearson | within segments |',
        '|---|---|---:|---:|---|---:|---:|',
    ]
    for composite, reading in dict.fromkeys((row['composite'], row['reading']) for row in found):
        mine = [row for row in found if (row['composite'], row['reading']) == (composite, reading)]
        returns = [row['final_return'] for row in mine]
        cells = [composite, reading, str(len(mine)), f'{statistics.mean(returns):.2f}']
        cells.append(', '.join(f'{value:.2f}' for value in returns))
        for column in ('pearson', 'within'):
            values = [row[column] for row in mine if row[column] is not None]
            cells.append(f'{statistics.mean(values):.2f}' if values else '')
        lines.append(f'| {" | ".join(cells)} |')
    (RESULTS / 'ablations.md').write_text('\n'.join(lines) + '\n')
    print('\n'.join(lines))


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('what', choices=['run', 'table'])
    parser.add_argument('--out', type=Path, default=Path('runs/ablations'))
    parser.add_argument('--workers', type=int, default=1)
    arguments = parser.parse_args()
    if arguments.what == 'run':
        return run(arguments.out, arguments.workers)
    table(arguments.out)
    return 0


if __name__ == '__main__':
    sys.exit(main())
