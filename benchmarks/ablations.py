"""How do CoDeTr's switches change return and reward recovery?

    .venv/bin/python benchmarks/ablations.py run readings --workers 2       # twenty minutes
    .venv/bin/python benchmarks/ablations.py table readings
    .venv/bin/python benchmarks/ablations.py run savings --workers 2        # 45 minutes
    .venv/bin/python benchmarks/ablations.py table savings

There are two studies, each on one task. All variants have the same seeds and are cells of `codetr
benchmark run` (resumable like any benchmark). `table` writes the final returns and the recovery of
step rewards at the last evaluation to `benchmarks/results/`:

`readings` (`ablations.csv`, `.md`): which reading of the paper learns better? The paper leaves
open which scalar becomes the step reward, how attention within the sequence is scaled, in which
unit composite rewards are fitted, how far back the causal transformer sees, and whether segments
or windows are labelled. The task is Reacher-v5 with a score every 10 of its 50 steps, which is
their sum or their soft maximum. Its 8000 steps take half a minute, and each has a reward of its
own, so that credit matters and survival means nothing.

`savings` (`savings.csv`, `.md`): what do the switches that save time cost? They label only a part
of the memory again in each phase (`relabel_steps`), or compute products in bfloat16. The task is
HalfCheetah-v5 with sums of 25 steps, for 30 000 steps. The table has for each variant the steps
labelled, and the age of labels at the end: the gradient steps taken since a step was labelled, as
mean over the memory and for the oldest label.
"""

import argparse
import csv
import json
import statistics
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

RESULTS = Path(__file__).parent / 'results'
COLUMNS = ('composite', 'variant', 'seed', 'final_return', 'pearson', 'within')
SAVED = ('steps_labelled', 'label_age_mean', 'label_age_max')
"""`steps_labelled` is summed over phases; the others are those of the last phase."""


@dataclass(frozen=True)
class Study:
    """Variants of one method's settings on one task.

    Args:
        file: name of the results.
        task: the task.
        delay: steps from score to score.
        steps: of each run.
        seeds: of each variant.
        composites: composite rewards.
        config: the settings of all variants.
        variants: the changes of each variant, by name.
        references: methods to compare the variants with.
        saved: whether the table has the costs of labelling.
    """

    file: str
    task: str
    delay: int
    steps: int
    seeds: tuple[int, ...]
    composites: tuple[str, ...]
    config: dict[str, Any]
    variants: dict[str, dict[str, Any]]
    references: tuple[str, ...] = ()
    saved: bool = False

    @property
    def columns(self) -> tuple[str, ...]:
        """Columns of the results."""
        return (*COLUMNS, *(SAVED if self.saved else ()), 'wall_s', 'commit')

    def benchmarks(self) -> dict[str, dict[str, Any]]:
        """Every benchmark's specification by the name of its folder."""
        specifications = {
            _slug(name): self._specification(['codetr'], changes)
            for name, changes in self.variants.items()
        }
        if self.references:
            specifications['references'] = self._specification(list(self.references), {})
        return specifications

    def _specification(self, methods: list[str], changes: dict[str, Any]) -> dict[str, Any]:
        return {
            'methods': methods,
            'tasks': [self.task],
            'composites': list(self.composites),
            'delays': [self.delay],
            'seeds': list(self.seeds),
            'steps': self.steps,
            'config': {**self.config, **changes},
        }


READINGS = Study(
    file='ablations',
    task='Reacher-v5',
    delay=10,
    steps=8000,
    seeds=(0, 1, 2),
    composites=('sum', 'max'),
    config={'base': 'quick', 'evaluate_every': 2000},
    variants={
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
    },
    references=('none', 'uniform', 'true'),
)
SAVINGS = Study(
    file='savings',
    task='HalfCheetah-v5',
    delay=25,
    steps=30_000,
    seeds=tuple(range(10)),
    composites=('sum',),
    config={'base': 'quick', 'warmup_steps': 1000, 'evaluate_every': 5000},
    variants={
        'all labelled again, float32 (quick)': {},
        'relabel_steps 10 000': {'relabel_steps': 10_000},
        'relabel_steps 3000': {'relabel_steps': 3000},
        'relabel_steps 1000': {'relabel_steps': 1000},
        'precision bfloat16': {'codetr.precision': 'bfloat16'},
    },
    saved=True,
)
STUDIES = {'readings': READINGS, 'savings': SAVINGS}


def _slug(name: str) -> str:
    return ''.join(c if c.isalnum() else '_' for c in name)


def run(study: Study, out: Path, workers: int) -> int:
    """Run what has not been run yet; returns the exit code."""
    out.mkdir(parents=True, exist_ok=True)
    code = 0
    for name, data in study.benchmarks().items():
        path = out / f'{name}.yaml'
        path.write_text(yaml.safe_dump(data, sort_keys=False))
        command = [sys.executable, '-m', 'codetr_ros.cli', 'benchmark', 'run', str(path)]
        command += ['--out', str(out / name), '--workers', str(workers)]
        code |= subprocess.run(command, check=False).returncode
    return code


def rows(study: Study, out: Path) -> list[dict[str, Any]]:
    """The results of the finished runs."""
    names = {_slug(name): name for name in study.variants} | {'references': ''}
    results = []
    for slug, name in names.items():
        for path in sorted((out / slug).glob('*/summary.json')):
            summary = json.loads(path.read_text())
            recovered = (summary.get('reward_recovery') or [{}])[-1]
            ending = json.loads((out / slug / 'cells' / f'{path.parent.name}.json').read_text())
            row = {
                'composite': summary['composite'],
                'variant': name or f'method {summary["method"]}',
                'seed': summary['seed'],
                'final_return': summary['evaluations'][-1]['true_return_mean'],
                'pearson': recovered.get('pearson'),
                'within': recovered.get('within'),
                'wall_s': summary['wall_s'],
                'commit': ending.get('commit'),
            }
            results.append(row | (labelling(path.with_name('metrics.csv')) if study.saved else {}))
    return sorted(results, key=lambda row: study.composites.index(row['composite']))


def labelling(metrics: Path) -> dict[str, float]:
    """The costs of labelling in a run, by the metrics of the reward node."""
    with metrics.open() as file:
        phases = list(csv.DictReader(file))
    costs: dict[str, float] = {}
    for name in SAVED:
        values = [float(cell) for row in phases if (cell := row.get(f'reward.{name}'))]
        costs[name] = sum(values) if name == 'steps_labelled' else values[-1]
    return costs


def table(study: Study, out: Path) -> None:
    """Write every run as CSV and the means over seeds as Markdown."""
    results = rows(study, out)
    with (RESULTS / f'{study.file}.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, study.columns)
        writer.writeheader()
        writer.writerows(results)
    means = ('pearson', 'within', *(SAVED if study.saved else ()))
    lines = [
        f'{study.task}, delay {study.delay}, {study.steps} steps, preset quick: return of the '
        'last evaluation (10 episodes), by seed, and correlation of inferred and true step '
        'rewards then.',
        '',
        '| composite | variant | seeds | final return | spread | by seed | '
        f'{" | ".join(means).replace("_", " ")} |',
        f'|---|---|---:|---:|---:|---|{"---:|" * len(means)}',
    ]
    for composite, variant in dict.fromkeys((row['composite'], row['variant']) for row in results):
        mine = [
            row for row in results if (row['composite'], row['variant']) == (composite, variant)
        ]
        returns = [row['final_return'] for row in mine]
        cells = [composite, variant, str(len(mine)), f'{statistics.mean(returns):.2f}']
        cells.append(f'{statistics.stdev(returns):.2f}' if len(mine) > 1 else '')
        cells.append(', '.join(f'{value:.2f}' for value in returns))
        for column in means:
            values = [row[column] for row in mine if row[column] is not None]
            digits = 0 if column in SAVED else 2
            cells.append(f'{statistics.mean(values):.{digits}f}' if values else '')
        lines.append(f'| {" | ".join(cells)} |')
    (RESULTS / f'{study.file}.md').write_text('\n'.join(lines) + '\n')
    print('\n'.join(lines))


def main() -> int:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('what', choices=['run', 'table'])
    parser.add_argument('study', choices=list(STUDIES))
    parser.add_argument('--out', type=Path, default=Path('runs'), help='folder of the studies')
    parser.add_argument('--workers', type=int, default=1)
    arguments = parser.parse_args()
    study, out = STUDIES[arguments.study], arguments.out / STUDIES[arguments.study].file
    if arguments.what == 'run':
        return run(study, out, arguments.workers)
    table(study, out)
    return 0


if __name__ == '__main__':
    sys.exit(main())
