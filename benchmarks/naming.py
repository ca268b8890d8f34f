"""Does method `evidence` name the kind of score that nobody states? Blind trials.

    .venv/bin/python benchmarks/naming.py --trials 200 --out benchmarks/results/naming.csv
    .venv/bin/python benchmarks/naming.py --trials 158 --tasks Hopper-v5 --terminal-feature \
        --out benchmarks/results/naming_ends.csv

Each trial draws a task, a kind of score (sum, sum_square, square_sum, max, minimum), an inverse
temperature between 1 and 6 in units of one by the deviation of step rewards, a delay and a number
of scores, and lets `evidence.link: choose` infer the kind from the scores of segments of a
true-reward run (`reward_recovery.py`). `--terminal-feature` repeats trials with the setting
`evidence.terminal_feature`. `square_sum` and the like are named from the scores alone.

    named, probability, margin   what it takes it for, how likely, and by how many nats it leads
    beta_ratio                   inferred inverse temperature by the true one, of max and minimum
    within                       credit within held-out segments, as in `reward_recovery.py`

Trials that are in the file already are not run again. A table by kind goes beside it as Markdown.
"""

import argparse
import csv
import math
import time
from pathlib import Path

import numpy as np
import torch
from rows import Rows

import machine
import reward_recovery
from codetr_ros.config import Settings, load
from codetr_ros.rewards import registry
from codetr_ros.rewards.base import segment_steps
from codetr_ros.rewards.evidence.method import Evidence
from codetr_ros.runs.recovery_metrics import step_recovery
from codetr_ros.seeding import generator

KINDS = ('sum', 'sum_square', 'square_sum', 'max', 'minimum')
TASKS = ('HalfCheetah-v5', 'Hopper-v5', 'Pusher-v5')
DELAYS = (10, 25, 50)
NUMBERS = (80, 160, 320)
COLUMNS = (
    'trial',
    'task',
    'kind',
    'beta',
    'delay',
    'scores',
    'named',
    'probability',
    'margin',
    'beta_ratio',
    'within',
    'seconds',
    'commit',
)


def drawn(number: int, data: dict[str, dict[str, np.ndarray]]) -> tuple[Settings, int]:
    """The settings of a trial, and how many scores it has."""
    rng = generator(0, 'naming', number)
    task = str(rng.choice(TASKS))
    kind = str(rng.choice(KINDS))
    beta = float(np.exp(rng.uniform(0, math.log(6)))) / float(data[task]['rewards'].std())
    delay, scores = int(rng.choice(DELAYS)), int(rng.choice(NUMBERS))
    changes = {'composite': kind, 'beta': beta, 'delay': delay, 'seed': number}
    settings = load('quick').changed(
        {**changes, 'method': 'evidence', 'evidence.link': 'choose', 'task': task}
    )
    return settings, scores


def trial(
    number: int, settings: Settings, scores: int, data: dict[str, dict[str, np.ndarray]]
) -> list[object]:
    """A row of the table."""
    task, kind, beta, delay = settings.task, settings.composite, settings.beta, settings.delay
    steps = data[task]
    train, held_out = reward_recovery.memories(steps, settings, None, scores)
    began = time.perf_counter()
    made = registry.make(settings, train.observation_size, train.action_size)
    assert isinstance(made, Evidence)
    made.prepare(train)
    seconds = time.perf_counter() - began
    metrics, named = made.metrics(), made.link.name
    soft = named == kind and kind in {'max', 'minimum'}
    ratio = metrics['beta'] / beta if soft else math.nan
    batch = held_out.segments.batch(held_out.segments.ids(), made.context)
    assert batch.true_rewards is not None
    within = step_recovery(made.label(batch), batch.true_rewards, segment_steps(batch))
    return [
        number,
        task,
        kind,
        f'{beta:.3g}',
        delay,
        len(train.segments.ids()),
        named,
        f'{metrics["link_probability"]:.4f}',
        f'{metrics["link_margin"]:.1f}',
        f'{ratio:.3f}',
        f'{within["within_pearson"]:.3f}',
        f'{seconds:.1f}',
    ]


def write_table(path: Path) -> None:
    """Shares by kind of score, as Markdown beside the CSV."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    lines = [
        '| score | trials | named right | surer than .95 | of these right | beta within 10 % |'
        ' credit within, median |',
        '|---|---:|---:|---:|---:|---:|---:|',
    ]
    for kind in (*KINDS, 'all'):
        own = [row for row in rows if kind in {'all', row['kind']}]
        if not own:
            continue
        sure = [row for row in own if float(row['probability']) > 0.95]
        ratios = [float(row['beta_ratio']) for row in own]
        soft = [r for r in ratios if not math.isnan(r)]
        near = sum(abs(r - 1) <= 0.1 for r in soft)
        within = np.nanmedian([float(row['within']) for row in own])
        lines.append(
            f'| {kind} | {len(own)} | {sum(r["named"] == r["kind"] for r in own)} | {len(sure)} '
            f'| {sum(r["named"] == r["kind"] for r in sure)} '
            f'| {f"{near} of {len(soft)}" if soft else ""} | {within:.2f} |'
        )
    path.with_suffix('.md').write_text('\n'.join(lines) + '\n')


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--out', type=Path, default=Path('benchmarks/results/naming.csv'))
    parser.add_argument('--cache', type=Path, default=Path('.venv/cache'))
    parser.add_argument('--trials', type=int, default=200)
    parser.add_argument('--tasks', nargs='+', choices=TASKS, default=TASKS)
    parser.add_argument('--terminal-feature', action='store_true')
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    commit = machine.commit()
    data = {
        task: reward_recovery.replay(arguments.cache / f'replay_{task}.npz', 15_000, task)
        for task in TASKS
    }
    rows = Rows(arguments.out, COLUMNS, keys=1)
    for number in range(arguments.trials):
        settings, scores = drawn(number, data)
        if (number,) not in rows and settings.task in arguments.tasks:
            ends = {'evidence.terminal_feature': arguments.terminal_feature}
            rows.append([*trial(number, settings.changed(ends), scores, data), commit])
    write_table(arguments.out)


if __name__ == '__main__':
    main()
