"""Where within segments does CoDeTr put credit: its weights w, rewards rhat and their product?

    .venv/bin/python benchmarks/credit.py runs/halfcheetah/*_codetr_*

Takes the reward models of finished runs of HalfCheetah (score every 25 steps, method codetr). Each
labels the same held-out episodes, those of `reward_recovery.py`, which none of them was trained
on. For each model:

    composite_r2          R^2 of the predicted composite reward
    weights_sd            standard deviation of w (1 on average)
    top_share             share of a segment's credit |w rhat| on the step with most of it;
                          an even spread gives 1/25 = 0.04
    stored                the step reward of the run, `codetr.label`: w rhat or rhat
    label, rhat           Pearson correlation of w rhat, and of rhat alone, with the true reward
    within_label, ...     the same with each segment's mean removed from both

Writes `results/credit.csv` and `results/credit.md`.
"""

import argparse
import csv
from pathlib import Path

import numpy as np
import torch

import machine
import reward_recovery
from codetr_ros.rewards import saved
from codetr_ros.rewards.codetr import Codetr

RESULTS = Path(__file__).parent / 'results'
NAMES = ('composite_r2', 'weights_sd', 'top_share', 'label', 'rhat', 'within_label', 'within_rhat')


def measure(run: Path, data: dict[str, np.ndarray]) -> dict[str, object]:
    """One model's credit."""
    model = saved.read(run)
    method = saved.restore(model, model.settings, *model.sizes)
    assert isinstance(method, Codetr), f'{run} is a run of method {model.settings.method}'
    _, held_out = reward_recovery.memories(data, model.settings)
    batch = held_out.segments.batch(held_out.segments.ids(), method.context)
    assert batch.true_rewards is not None
    weights, rewards = method.components(batch)
    labels, true = weights * rewards, batch.true_rewards
    share = np.abs(labels) / np.abs(labels).sum(1, keepdims=True)
    return {
        'composite': model.settings.composite,
        'stored': model.settings.codetr.label,
        'seed': model.settings.seed,
        **dict(
            zip(
                NAMES,
                (
                    reward_recovery.r_squared(method.predict(batch), batch.values),
                    float(weights.std()),
                    float(share.max(1).mean()),
                    pearson(labels, true),
                    pearson(rewards, true),
                    pearson(centred(labels), centred(true)),
                    pearson(centred(rewards), centred(true)),
                ),
                strict=True,
            )
        ),
    }


def centred(values: np.ndarray) -> np.ndarray:
    """The values less each segment's mean."""
    return values - values.mean(1, keepdims=True)


def pearson(a: np.ndarray, b: np.ndarray) -> float:
    """Correlation over all steps."""
    return float(np.corrcoef(a.ravel(), b.ravel())[0, 1])


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('runs', type=Path, nargs='+', help='folders of runs')
    parser.add_argument('--out', type=Path, default=RESULTS)
    parser.add_argument(
        '--cache', type=Path, default=Path('.venv/cache/reward_recovery_replay.npz')
    )
    given = parser.parse_args()
    torch.set_num_threads(1)
    data = reward_recovery.replay(given.cache)
    rows = [measure(run, data) for run in given.runs]
    given.out.mkdir(parents=True, exist_ok=True)
    with (given.out / 'credit.csv').open('w', newline='') as file:
        writer = csv.DictWriter(file, ('composite', 'stored', 'seed', *NAMES), lineterminator='\n')
        writer.writeheader()
        writer.writerows(rows)
    lines = [
        '# Where CoDeTr puts credit',
        '',
        f'| composite | stored | seed | {" | ".join(NAMES)} |',
        '|---|---|---:|' + '---:|' * len(NAMES),
    ]
    for row in rows:
        cells = [f'{row[name]:.2f}' for name in NAMES]
        lines.append(
            f'| {row["composite"]} | {row["stored"]} | {row["seed"]} | {" | ".join(cells)} |'
        )
    lines += ['', f'What the columns are: `benchmarks/credit.py`, commit {machine.commit()}.']
    text = '\n'.join(lines) + '\n'
    (given.out / 'credit.md').write_text(text)
    print(text, end='')


if __name__ == '__main__':
    main()
