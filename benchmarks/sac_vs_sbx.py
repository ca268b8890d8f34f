"""Is our SAC as good as another? True-reward SAC on HalfCheetah-v5: ours against SBX.

    .venv/bin/python benchmarks/sac_vs_sbx.py ours --seed 0 1 2
    .venv/bin/python benchmarks/sac_vs_sbx.py ours_lecun --seed 0 1 2

    python3 -m venv /tmp/sbx-venv
    /tmp/sbx-venv/bin/pip install -r benchmarks/requirements-sbx.txt
    /tmp/sbx-venv/bin/python benchmarks/sac_vs_sbx.py sbx --seed 0 1 2

    .venv/bin/python benchmarks/sac_vs_sbx.py plot

A run takes minutes and leaves one JSON file in `benchmarks/results/sac_vs_sbx/`; runs with a file
there are not made again. `plot` draws both learning curves (mean, lowest and highest seed) and
writes every number to a CSV file.

Both sides: jaxrl's settings (256x256 networks, batch 256, learning rates 3e-4, tau 0.005, discount
0.99, initial temperature 1, target entropy -dim/2), 50 000 steps of which the first 10 000 are
uniformly random, bursts of 1000 updates after every 1000 steps from step 10 000 on, everything
kept in memory, time limits bootstrapped, one thread. Evaluation after the burst of every 5000th
step from step 10 000 on: 10 deterministic episodes, each from the same start in every evaluation
of a run.

Intended differences, which are SBX's own behaviour:
  - initial weights: LeCun normal (flax's default); ours orthogonal, as jaxrl
  - log standard deviation clipped to [-20, 2]; ours to [-10, 2], as jaxrl
  - critic loss half of ours (Adam takes the same steps either way, except for its epsilon)
  - temperature loss log(alpha) (entropy - target); ours alpha (entropy - target), as jaxrl (the
    same sign; Adam takes nearly the same steps)
  - step 10 000 itself acts under the initial policy, not at random: `learning_starts` is 9999,
    because otherwise the first burst would come at step 11 000

Which of them makes the difference? `ours_lecun` is ours with flax's initial weights and nothing
else changed.
"""

import argparse
import csv
import json
import os
import time
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

TASK = 'HalfCheetah-v5'
STEPS, WARMUP, PHASE = 50_000, 10_000, 1000
EVALUATE_EVERY, EPISODES = 5000, 10
ACTION_SIZE = 6
RESULTS = Path(__file__).parent / 'results' / 'sac_vs_sbx'
NAMES = {'ours': 'codetr_ros', 'ours_lecun': 'codetr_ros, LeCun weights', 'sbx': 'SBX'}


def run_sbx(seed: int, steps: int = STEPS, warmup: int = WARMUP) -> dict[str, Any]:
    """Do one run of SBX, which needs its packages."""
    flags = '--xla_cpu_multi_thread_eigen=false intra_op_parallelism_threads=1'
    os.environ['XLA_FLAGS'] = f'{os.environ.get("XLA_FLAGS", "")} {flags}'.strip()
    os.environ['JAX_PLATFORMS'] = 'cpu'
    import gymnasium
    import torch
    from sbx import SAC

    torch.set_num_threads(1)
    model = SAC(
        'MlpPolicy',
        gymnasium.make(TASK),
        learning_rate=3e-4,
        buffer_size=steps,
        learning_starts=warmup - 1,
        batch_size=256,
        tau=0.005,
        gamma=0.99,
        train_freq=PHASE,
        gradient_steps=PHASE,
        ent_coef='auto_1.0',
        target_entropy=-ACTION_SIZE / 2,
        policy_kwargs={'net_arch': [256, 256]},
        seed=seed,
    )
    environment = gymnasium.make(TASK)
    evaluations = []
    started = time.monotonic()
    for step in range(PHASE, steps + 1, PHASE):
        model.learn(PHASE, reset_num_timesteps=False)
        if step >= warmup and step % EVALUATE_EVERY == 0:
            returns = []
            for episode in range(EPISODES):
                observation, _ = environment.reset(seed=1_000_000 + 1000 * seed + episode)
                total, done = 0.0, False
                while not done:
                    action, _ = model.predict(observation, deterministic=True)
                    observation, reward, terminated, truncated, _ = environment.step(action)
                    total, done = total + float(reward), terminated or truncated
                returns.append(total)
            evaluations.append(
                {'step': step, 'true_return_mean': sum(returns) / EPISODES, 'returns': returns}
            )
            print(
                f'sbx seed {seed} step {step}: {evaluations[-1]["true_return_mean"]:.1f}',
                flush=True,
            )
    packages = ('sbx-rl', 'jax', 'stable-baselines3', 'gymnasium', 'mujoco')
    return {
        'evaluations': evaluations,
        'wall_s': time.monotonic() - started,
        'updates': model._n_updates,  # noqa: SLF001
        'versions': {name: version(name) for name in packages},
    }


def run_ours(
    seed: int, lecun: bool = False, steps: int = STEPS, warmup: int = WARMUP
) -> dict[str, Any]:
    """Do one in-process run of ours, with its own initial weights or with flax's."""
    from codetr_ros import config
    from codetr_ros.cores import in_process
    from codetr_ros.learners import from_labels
    from codetr_ros.runs.summary import Summary

    if lecun:
        from_labels.FlatSAC = _with_lecun_weights(from_labels.FlatSAC)
    given = {
        'task': TASK,
        'method': 'true',
        'steps': steps,
        'seed': seed,
        'phase_steps': PHASE,
        'warmup_steps': warmup,
        'memory_steps': steps,
        'evaluate_every': EVALUATE_EVERY,
        'evaluate_episodes': EPISODES,
        'target_scale': 'none',
        'reward_unit': 'raw',
        'threads': 1,
    }  # the rest: the defaults, which are jaxrl's
    settings = config.parse(given, 'benchmark')
    started = time.monotonic()
    summary = Summary(settings, 'benchmark', True)
    reports = in_process.run(settings, 'benchmark', observe=summary.receive)
    evaluations = summary.build(reports, None, False, None).evaluations
    packages = ('torch', 'gymnasium', 'mujoco')
    return {
        'evaluations': [e.model_dump(mode='json') for e in evaluations if e.step >= warmup],
        'wall_s': time.monotonic() - started,
        'versions': {name: version(name) for name in packages},
    }


def _with_lecun_weights(sac: type) -> type:
    """Our SAC with flax's default initial weights: normal of variance 1/inputs, cut off at two
    standard deviations.
    """
    import torch

    from codetr_ros.policy.actor import linear_layers

    def draw(weight: Any, inputs: int) -> None:
        std = inputs**-0.5 / 0.87962566103423978  # the cut shrinks the deviation by this factor
        torch.nn.init.trunc_normal_(weight, 0.0, std, -2 * std, 2 * std)

    class LecunSAC(sac):
        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            for layer in linear_layers(self.actor):
                draw(layer.weight, layer.in_features)
            for weight in self.critic_values[::2]:  # (2, in, out); biases stand between them
                for one in weight:
                    draw(one, weight.shape[1])
            torch._foreach_copy_(self.target, self.critic_values)

    return LecunSAC


def run(implementation: str, seeds: Sequence[int]) -> None:
    """Make the runs that are still missing, one after the other."""
    RESULTS.mkdir(parents=True, exist_ok=True)
    for seed in seeds:
        path = RESULTS / f'{implementation}-{seed}.json'
        if path.exists():
            print(f'{path} is there already')
            continue
        result = (
            run_sbx(seed)
            if implementation == 'sbx'
            else run_ours(seed, lecun=implementation == 'ours_lecun')
        )
        result = {
            'implementation': implementation,
            'seed': seed,
            'task': TASK,
            'steps': STEPS,
            **result,
        }
        partial = path.with_suffix('.partial')
        partial.write_text(json.dumps(result, indent=1) + '\n')
        partial.replace(path)
        print(f'{path}: {result["wall_s"]:.0f} s', flush=True)


def plot() -> None:
    """Draw the curves of all runs there, and write their numbers to a CSV file."""
    import matplotlib

    matplotlib.use('Agg')
    import matplotlib.pyplot as plt

    rows: list[tuple[str, int, int, float]] = []
    figure, axes = plt.subplots(figsize=(7, 4.5), layout='constrained')
    for implementation, name in NAMES.items():
        runs = [
            json.loads(path.read_text())
            for path in sorted(RESULTS.glob(f'{implementation}-*.json'))
        ]
        at: dict[int, list[float]] = {}
        for r in runs:
            for evaluation in r['evaluations']:
                at.setdefault(evaluation['step'], []).append(evaluation['true_return_mean'])
                rows.append(
                    (implementation, r['seed'], evaluation['step'], evaluation['true_return_mean'])
                )
        steps = sorted(at)
        (line,) = axes.plot(
            steps, [sum(at[s]) / len(at[s]) for s in steps], label=f'{name} ({len(runs)} seeds)'
        )
        lowest, highest = [min(at[s]) for s in steps], [max(at[s]) for s in steps]
        axes.fill_between(steps, lowest, highest, color=line.get_color(), alpha=0.2)
        if steps:
            last = at[steps[-1]]
            mean = sum(last) / len(last)
            print(f'{name}: {mean:.0f} at step {steps[-1]}, seeds {[round(x) for x in last]}')
    axes.set(xlabel='environment steps', ylabel=f'true return, {EPISODES} deterministic episodes')
    axes.set_title(f'SAC with the true reward on {TASK}:\nmean, lowest and highest seed')
    axes.legend()
    axes.grid(alpha=0.3)
    figure.savefig(RESULTS / 'learning_curves.png', dpi=120)
    with (RESULTS / 'learning_curves.csv').open('w', newline='') as file:
        writer = csv.writer(file)
        writer.writerow(['implementation', 'seed', 'step', 'true_return_mean'])
        writer.writerows(rows)


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('what', choices=[*NAMES, 'plot'])
    parser.add_argument('--seed', type=int, nargs='+', default=[0, 1, 2])
    arguments = parser.parse_args()
    if arguments.what == 'plot':
        plot()
    else:
        run(arguments.what, arguments.seed)


if __name__ == '__main__':
    main()
