"""Are the inferred step rewards the true ones? Reward recovery on held-out episodes.

    .venv/bin/python benchmarks/reward_recovery.py --out benchmarks/results/reward_recovery.csv
    .venv/bin/python benchmarks/reward_recovery.py --task Reacher-v5 --steps 8000 --delay 50 ...

The data is the replay of a true-reward run (small networks), by default of 20 000 steps on
HalfCheetah, so that it ranges from random to running. Four fifths of its episodes train each
model, only with composite rewards of segments (25 steps by default); every fifth episode is held
out. For each composite reward and each variant (CoDeTr alone, changed in one setting, or another
method) it gives

    composite_r2       R^2 of the predicted composite reward; nan for methods that predict none
    pearson, spearman  correlation of inferred and true step rewards
    within_pearson     the same with each segment's mean removed from both: is credit right inside
    within_spearman    the segment? nan for methods that give the same to all of its steps
    weights_sd         standard deviation of CoDeTr's attention weights w (1 on average)

over held-out steps. A high R^2 shows little about the steps, hence the other columns. `ircr`,
`uniform` and `random` take no gradient steps, whatever the value in their column. Rows that are in
the file already are not run again. Means over seeds go beside it as Markdown.
"""

import argparse
import csv
import dataclasses
import math
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from rows import Rows

import machine
from codetr_ros.config import Settings, load
from codetr_ros.cores import in_process
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F64, CompositeReward, Record, Transitions, TrueRewards
from codetr_ros.rewards import registry
from codetr_ros.rewards.base import Predictor, segment_steps
from codetr_ros.rewards.codetr import Codetr
from codetr_ros.runs.recovery_metrics import r_squared, step_recovery
from codetr_ros.seeding import generator, seed_torch
from codetr_ros.simulation import tasks
from codetr_ros.simulation.composite import composite

COMPOSITES = ('sum', 'sum_square', 'square_sum', 'max')
VARIANTS: dict[str, dict[str, object]] = {
    'CoDeTr alone': {},  # `as shipped` in tables that were made when `quick` had it so
    'label rhat': {'codetr.label': 'rhat'},
    'weights one': {'codetr.weights': 'one'},
    'head scale 1/sqrt(d)': {'codetr.head_scale': 'inverse_sqrt'},
    'initialisation lecun': {'codetr.initialisation': 'lecun'},
    'head scale one': {'codetr.head_scale': 'one'},
    'pair tokens': {'codetr.tokens': 'pair'},
    'pair tokens, state first': {'codetr.tokens': 'pair'},
    'pair tokens, label rhat': {'codetr.tokens': 'pair', 'codetr.label': 'rhat'},
    'pair tokens, weights one': {'codetr.tokens': 'pair', 'codetr.weights': 'one'},
    'pair tokens, schedule peaked': {
        'codetr.tokens': 'pair',
        'codetr.schedule': 'peaked',
        'codetr.learning_rate': 1e-4,
        'codetr.total_gradient_steps': 400,
    },
    'pair tokens, lecun, head scale one': {
        'codetr.tokens': 'pair',
        'codetr.initialisation': 'lecun',
        'codetr.head_scale': 'one',
    },
    'schedule peaked': {
        'codetr.schedule': 'peaked',
        'codetr.learning_rate': 1e-4,
        'codetr.total_gradient_steps': 400,
    },
    'context window': {'codetr.context': 'window'},
    'base evidence': {'codetr.base': 'evidence'},
    'base evidence, pair tokens': {'codetr.base': 'evidence', 'codetr.tokens': 'pair'},
    'dropout 0.1': {'codetr.dropout': 0.1},
    'learning rate 3e-4': {'codetr.learning_rate': 3e-4},
    'learning rate 5e-5': {'codetr.learning_rate': 5e-5},
    'schedule cosine': {'codetr.schedule': 'cosine'},
    'raw observations': {'codetr.normalise_observations': False},
    'raw targets': {'target_scale': 'none'},
    'context episode': {'codetr.context': 'episode', 'codetr.window': 50},
    'method rbt': {'method': 'rbt'},
    'method rbt, segment scope': {'method': 'rbt', 'rbt.attention_scope': 'segment'},
    'method rrd biased': {'method': 'rrd'},
    'method rrd unbiased': {'method': 'rrd', 'rrd.loss': 'unbiased'},
    'method diaster': {'method': 'diaster'},
    'method lrr': {'method': 'lrr'},
    'method lrr, independent steps': {'method': 'lrr', 'lrr.correlation': 'none'},
    'method mil_lstm': {'method': 'mil_lstm'},
    'method mlp': {'method': 'mlp'},
    'method aggregate': {'method': 'aggregate'},
    'method ircr': {'method': 'ircr'},
    'method evidence': {'method': 'evidence'},
    'method evidence, link chosen': {'method': 'evidence', 'evidence.link': 'choose'},
    'method uniform': {'method': 'uniform'},
    'method random': {'method': 'random'},
}
COLUMNS = (
    'composite',
    'variant',
    'seed',
    'gradient_steps',
    'composite_r2',
    'pearson',
    'spearman',
    'within_pearson',
    'within_spearman',
    'weights_sd',
    'seconds',
    'commit',
)


def replay(
    cache: Path, steps: int = 20_000, task: str = 'HalfCheetah-v5'
) -> dict[str, np.ndarray]:
    """The true-reward run's steps, made once and kept in `cache`."""
    if not cache.is_file():
        settings = load('quick').changed(
            {
                'task': task,
                'method': 'true',
                'steps': steps,
                'warmup_steps': 1000,
                'evaluate_every': 5000,
            }
        )
        seen: list[Record] = []
        in_process.run(settings, 'replay', observe=seen.append)
        chunks = [r for r in seen if isinstance(r, Transitions)]
        true = [r for r in seen if isinstance(r, TrueRewards)]
        cache.parent.mkdir(parents=True, exist_ok=True)
        np.savez(
            cache,
            observations=np.concatenate([c.observations[:-1] for c in chunks]),
            finals=np.array([c.observations[-1] for c in chunks if c.truncated or c.terminated]),
            actions=np.concatenate([c.actions for c in chunks]),
            rewards=np.concatenate([t.rewards for t in true]),
            episodes=np.concatenate([np.full(c.steps, c.episode) for c in chunks]),
        )
    with np.load(cache) as data:
        return dict(data)


def memories(
    data: dict[str, np.ndarray],
    settings: Settings,
    disturb: Callable[[F64], F64] | None = None,
    most: int | None = None,
) -> tuple[Trajectories, Trajectories]:
    """Training and held-out episodes as memories D, scored with the settings' composite reward.

    Args:
        data: of `replay`.
        settings: their composite reward, delay and seed count.
        disturb: what a scorer makes of the exact scores (S,) of the training episodes.
        most: scores of the training episodes, drawn at random; all if not given.
    """
    sizes, delay = (data['observations'].shape[1], data['actions'].shape[1]), settings.delay
    made = [
        Trajectories(*sizes, delay, len(data['rewards']), 1000, true_rewards=True)
        for _ in range(2)
    ]
    counts = [0, 0]
    scores: list[list[CompositeReward]] = [[], []]
    for episode, final in enumerate(data['finals']):
        rows = np.flatnonzero(data['episodes'] == episode)
        side = int(episode % 5 == 4)
        fell = len(rows) < tasks.find(settings.task).horizon
        steps, true = _recorded(data, rows, final, counts[side], fell)
        counts[side] += 1
        made[side].append(steps)
        made[side].append_true_rewards(true)
        scores[side] += _scored(settings, true)
    values = np.array([score.value for score in scores[0]])
    if disturb is not None:
        values = disturb(values)
    order = generator(settings.seed, 'recovery', 'scores').permutation(len(values))
    for place in np.sort(order[:most]).tolist():
        made[0].score(dataclasses.replace(scores[0][place], value=float(values[place])))
    for score in scores[1]:
        made[1].score(score)
    return made[0], made[1]


def _recorded(
    data: dict[str, np.ndarray], rows: np.ndarray, final: np.ndarray, number: int, fell: bool
) -> tuple[Transitions, TrueRewards]:
    """An episode: its steps, and their true rewards."""
    steps = Transitions(
        run_id='',
        source='s',
        sequence=number,
        phase=0,
        episode=number,
        first_step=0,
        steps=len(rows),
        observations=np.concatenate([data['observations'][rows], final[None]]),
        actions=data['actions'][rows],
        terminated=fell,
        truncated=not fell,
        phase_end=False,
        scores_due=0,
    )
    true = TrueRewards(
        run_id='',
        source='s',
        sequence=number,
        phase=0,
        episode=number,
        first_step=0,
        rewards=data['rewards'][rows],
    )
    return steps, true


def _scored(settings: Settings, true: TrueRewards) -> list[CompositeReward]:
    """Exact scores of an episode."""
    n, scores = settings.longest, []
    for first in range(0, len(true.rewards), n):
        part = true.rewards[first : first + n].astype(np.float64)
        value = composite(settings.composite, part, settings.beta, n)
        scores.append(
            CompositeReward(
                run_id='',
                source='s',
                scorer='s',
                sequence=0,
                episode=true.episode,
                first_step=first,
                length=len(part),
                value=value,
            )
        )
    return scores


def measure(
    data: dict[str, np.ndarray], settings: Settings, gradient_steps: int, state_first: bool = False
) -> dict[str, float]:
    """Fit on the training episodes, compare on the held-out ones."""
    train, held_out = memories(data, settings)
    method = registry.make(settings, train.observation_size, train.action_size)
    if state_first:  # the order of tokens that models of old checkpoints have
        assert isinstance(method, Codetr)
        method.network.causal.action_first = False
    method.prepare(train)
    for i in range(gradient_steps):
        seed_torch(settings.seed, 'recovery', i)
        method.gradient_step(train, generator(settings.seed, 'recovery', i))
    batch = held_out.segments.batch(held_out.segments.ids(), method.context)
    assert batch.true_rewards is not None
    inside = segment_steps(batch)
    predicts, attends = isinstance(method, Predictor), isinstance(method, Codetr)
    return {
        'composite_r2': r_squared(method.predict(batch), batch.values) if predicts else math.nan,
        **step_recovery(method.label(batch), batch.true_rewards, inside),
        'weights_sd': float(method.components(batch)[0][inside].std()) if attends else math.nan,
    }


def write_table(path: Path) -> None:
    """Means over seeds, as Markdown beside the CSV."""
    with path.open() as file:
        rows = list(csv.DictReader(file))
    shown = COLUMNS[4:10]
    lines = [
        f'| composite | variant | steps | seeds | {" | ".join(shown)} | within_pearson, by seed |',
        '|---|---|---:|---:|' + '---:|' * len(shown) + '---|',
    ]
    groups: dict[tuple[str, str, str], list[dict[str, str]]] = {}
    for row in rows:
        groups.setdefault((row['composite'], row['variant'], row['gradient_steps']), []).append(
            row
        )
    for (name, variant, steps), group in groups.items():
        means = [f'{sum(float(row[c]) for row in group) / len(group):.2f}' for c in shown]
        each = ', '.join(f'{float(row["within_pearson"]):.2f}' for row in group)
        lines.append(
            f'| {name} | {variant} | {steps} | {len(group)} | {" | ".join(means)} | {each} |'
        )
    path.with_suffix('.md').write_text('\n'.join(lines) + '\n')


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--out', type=Path, default=Path('benchmarks/results/reward_recovery.csv'))
    parser.add_argument('--task', default='HalfCheetah-v5')
    parser.add_argument('--steps', type=int, default=20_000, help='of the run that is recorded')
    parser.add_argument('--delay', type=int, default=25, help='steps of a segment')
    parser.add_argument(
        '--cache', type=Path, help='the recording; default: one for each task, in .venv/cache'
    )
    parser.add_argument('--composites', nargs='+', default=list(COMPOSITES), choices=COMPOSITES)
    parser.add_argument('--variants', nargs='+', default=list(VARIANTS), choices=list(VARIANTS))
    parser.add_argument('--seeds', nargs='+', type=int, default=[0, 1, 2])
    parser.add_argument('--gradient-steps', nargs='+', type=int, default=[400])
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    commit = machine.commit()
    task, cache = arguments.task, arguments.cache
    if cache is None:
        of = '' if task == 'HalfCheetah-v5' else f'_{task}_{arguments.steps}'
        cache = Path(f'.venv/cache/reward_recovery_replay{of}.npz')
    data = replay(cache, arguments.steps, task)
    rows = Rows(arguments.out, COLUMNS, keys=4)
    for steps in arguments.gradient_steps:
        for seed in arguments.seeds:
            for name in arguments.composites:
                for variant in arguments.variants:
                    key = (name, variant, str(seed), str(steps))
                    if key in rows:
                        continue
                    began = time.perf_counter()
                    scored = {'composite': name, 'delay': arguments.delay, 'seed': seed}
                    changes = {'task': task, 'codetr.base': 'none', **VARIANTS[variant]}
                    first = variant.endswith('state first')
                    row = measure(data, load('quick').changed(changes | scored), steps, first)
                    numbers = [f'{value:.3f}' for value in row.values()]
                    seconds = time.perf_counter() - began
                    rows.append([*key, *numbers, f'{seconds:.1f}', commit])
    write_table(arguments.out)


if __name__ == '__main__':
    main()
