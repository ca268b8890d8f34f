"""How many scores does credit take, and how much noise does it bear? Method `evidence`.

    .venv/bin/python benchmarks/scores.py --out benchmarks/results/scores.csv

The steps are those of `reward_recovery.py`, of a true-reward run of 20 000 steps on HalfCheetah.
Of four fifths of its episodes so many segments, drawn at random, have a score, and each score is

    exact             as it is
    noise 0.1, 0.3    with normal noise of so many deviations of the scores
    5 levels          the fifth of the scores in which it is, 1 to 5: verdicts of one to five stars
    2 levels          whether it is above the median: thumbs up or down
    5 ordinal, ...    the same, fitted as an ordinal scale (`evidence.score_scale: ordinal`)

`within` is the correlation of labels with the true step rewards in the other episodes, where these
have exact scores, each segment's mean taken off both. Rows that are in the file already are not
run again. Means over seeds go beside it as Markdown, and as a picture.
"""

import argparse
import csv
import time
from itertools import product
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from rows import Rows

import machine
import reward_recovery
from codetr_ros.config import load
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.rewards import registry
from codetr_ros.rewards.base import segment_steps
from codetr_ros.runs.recovery_metrics import step_recovery
from codetr_ros.seeding import generator

COMPOSITES = ('sum', 'max')
DELAYS = (25, 100)
NUMBERS = (10, 20, 40, 80, 160, 640)
KINDS = ('exact', 'noise 0.1', 'noise 0.3', '5 levels', '5 ordinal', '2 levels', '2 ordinal')
COLUMNS = ('composite', 'delay', 'scores', 'kind', 'seed', 'within', 'seconds', 'commit')
Floats = NDArray[np.float64]


def disturbed(values: Floats, kind: str, seed: int) -> Floats:
    """What a scorer of this kind makes of exact scores (S,)."""
    how, _, amount = kind.partition(' ')
    if how == 'noise':
        noise = generator(seed, 'scores', 'noise').normal(size=len(values))
        return values + float(amount) * values.std() * noise
    if how.isdigit():
        edges = np.quantile(values, np.arange(1, int(how)) / int(how))
        return 1.0 + np.searchsorted(edges, values)
    return values


def measure(train: Trajectories, held_out: Trajectories, changes: dict[str, object]) -> float:
    """Fit to what `train` has, label what `held_out` has."""
    settings = load('quick').changed({'method': 'evidence', **changes})
    method = registry.make(settings, train.observation_size, train.action_size)
    method.prepare(train)
    batch = held_out.segments.batch(held_out.segments.ids(), method.context)
    assert batch.true_rewards is not None
    labels = method.label(batch)
    return step_recovery(labels, batch.true_rewards, segment_steps(batch))['within_pearson']


def write_table(path: Path) -> None:
    """Means over seeds: a line for each kind, a column for each number of scores."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    numbers = sorted({int(row['scores']) for row in rows})
    lines = [
        f'| composite | steps a score | scores are | {" | ".join(map(str, numbers))} |',
        '|---|---:|---|' + '---:|' * len(numbers),
    ]
    keys = dict.fromkeys((row['composite'], row['delay'], row['kind']) for row in rows)
    for key in keys:
        cells = []
        for number in numbers:
            values = [
                float(row['within'])
                for row in rows
                if (row['composite'], row['delay'], row['kind']) == key
                and int(row['scores']) == number
            ]
            cells.append(f'{np.mean(values):.2f}' if values else '')
        lines.append(f'| {" | ".join(key)} | {" | ".join(cells)} |')
    path.with_suffix('.md').write_text('\n'.join(lines) + '\n')
    _draw(path.with_suffix('.svg'), rows)


def _draw(path: Path, rows: list[dict[str, str]]) -> None:
    import matplotlib as mpl

    mpl.use('Agg')
    mpl.rcParams.update({'svg.hashsalt': 'codetr', 'svg.fonttype': 'none'})
    import matplotlib.pyplot as plt

    panels = [(c, d) for c in COMPOSITES for d in DELAYS]
    figure, axes = plt.subplots(1, len(panels), figsize=(13, 3.4), sharey=True)
    for axis, (composite, delay) in zip(axes, panels, strict=True):
        for kind in KINDS:
            points: dict[int, list[float]] = {}
            for row in rows:
                if (row['composite'], row['delay'], row['kind']) == (composite, str(delay), kind):
                    points.setdefault(int(row['scores']), []).append(float(row['within']))
            at = sorted(points)
            axis.plot(at, [np.mean(points[n]) for n in at], marker='o', ms=3, label=kind)
        axis.set(xscale='log', title=f'{composite}, {delay} steps a score', xlabel='scores')
        axis.set_xticks(NUMBERS, [str(n) for n in NUMBERS])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    axes[0].set(ylabel='credit within segments', ylim=(-0.1, 1.02))
    axes[-1].legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(path, metadata={'Date': None})
    plt.close(figure)
    path.write_text('\n'.join(line.rstrip() for line in path.read_text().splitlines()) + '\n')


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--out', type=Path, default=Path('benchmarks/results/scores.csv'))
    parser.add_argument(
        '--cache', type=Path, default=Path('.venv/cache/reward_recovery_replay.npz')
    )
    parser.add_argument('--kinds', nargs='+', default=list(KINDS), choices=KINDS)
    parser.add_argument('--seeds', nargs='+', type=int, default=[0, 1, 2])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    commit = machine.commit()
    data = reward_recovery.replay(arguments.cache)
    rows = Rows(arguments.out, COLUMNS, keys=5)
    for name, delay, seed, kind in product(COMPOSITES, DELAYS, arguments.seeds, arguments.kinds):
        changes: dict[str, object] = {'composite': name, 'delay': delay, 'seed': seed}
        if kind.endswith('ordinal'):
            changes['evidence.score_scale'] = 'ordinal'
        for number in NUMBERS:
            key = (name, str(delay), str(number), kind, str(seed))
            if key in rows:
                continue
            settings = load('quick').changed(changes)
            train, held_out = reward_recovery.memories(
                data, settings, lambda v, k=kind, s=seed: disturbed(v, k, s), number
            )
            if len(train.segments.ids()) < number:
                continue
            began = time.perf_counter()
            within = measure(train, held_out, changes)
            seconds = time.perf_counter() - began
            rows.append([*key, f'{within:.3f}', f'{seconds:.2f}', commit])
    write_table(arguments.out)


if __name__ == '__main__':
    main()
