"""Trivial anchors: the scores of a random policy and of one that does nothing at all.

On Ant, standing still beats several published baselines, so every score needs it for comparison.
"""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from codetr_ros.benchmark.folder import read_json
from codetr_ros.benchmark.results import Result
from codetr_ros.config import Lengths
from codetr_ros.policy.acting import uniform_actions
from codetr_ros.records import F32, F64
from codetr_ros.seeding import generator, seed_global
from codetr_ros.simulation import tasks
from codetr_ros.simulation.composite import composite, perfect_score
from codetr_ros.simulation.environments import Environment
from codetr_ros.system.files import atomic_write

FILE = 'anchors.json'
SEED = 0
"""Seed of the start states and the random actions: those of the evaluations of seed 0."""
_NUMBERS = ('score_mean', 'score_std', 'true_return_mean', 'true_return_std', 'length_mean')

Anchors = dict[tuple[str, str, int | str], dict[str, dict[str, float]]]
"""The numbers of 'random' and 'zero', by task, composite reward and delay."""


def anchors(results: Sequence[Result], path: Path) -> Anchors:
    """The anchors of every task, composite reward and delay; simulated once and kept in `path`.

    Raises:
        TaskError: a task cannot be made.
    """
    kept = read_json(path) or {}
    rewards: dict[tuple[str, int], dict[str, list[F64]]] = {}
    known: Anchors = {}
    for result in results:
        key = (result.task, result.composite, result.delay)
        if key in known:
            continue
        name = f'{result.task} {result.composite} {result.delay}'
        parameters = {
            'beta': result.settings['beta'],
            'r_max': result.settings['r_max'] or tasks.find(result.task).r_max,
            'episodes': result.settings['evaluate_episodes'],
            'seed': SEED,
        }
        row = kept.get(name)
        if row is None or row['parameters'] != parameters:
            which = (result.task, parameters['episodes'])
            if which not in rewards:
                rewards[which] = simulate(*which)
            horizon = tasks.find(result.task).horizon
            row = kept[name] = {'parameters': parameters} | {
                policy: _numbers(episodes, result.composite, result.delay, horizon, parameters)
                for policy, episodes in rewards[which].items()
            }
        known[key] = {policy: row[policy] for policy in ('random', 'zero')}
    if rewards:
        atomic_write(path, json.dumps(kept, indent=1) + '\n')
    return known


def simulate(task: str, episodes: int) -> dict[str, list[F64]]:
    """True rewards of each episode of the random policy and of the zero action."""
    seed_global(SEED, 'environment')
    environment = tasks.make(task)
    shape = environment.horizon, environment.action_size
    try:
        return {
            'random': _episodes(
                environment,
                episodes,
                lambda i: uniform_actions(generator(SEED, 'evaluate', 'random', i), *shape),
            ),
            'zero': _episodes(environment, episodes, lambda i: np.zeros(shape, np.float32)),
        }
    finally:
        environment.close()


def _episodes(environment: Environment, episodes: int, actions: Callable[[int], F32]) -> list[F64]:
    earned = []
    for number in range(episodes):
        seed_global(SEED, 'environment', 'evaluate', number)
        environment.reset(int(generator(SEED, 'evaluate', number).integers(2**31)))
        rewards = []
        for action in actions(number):
            _, reward, terminated = environment.step(action)
            rewards.append(reward)
            if terminated or environment.truncated:
                break
        earned.append(np.array(rewards, np.float64))
    return earned


def _numbers(
    episodes: Sequence[F64],
    name: str,
    delay: int | str,
    horizon: int,
    parameters: dict[str, Any],
) -> dict[str, float]:
    """The numbers of an evaluation, whose segments cover an episode; the last may be shorter."""
    beta, cut = parameters['beta'], Lengths.of(delay)
    longest = cut.most or horizon
    shortest = cut.least if cut.drawn else longest
    perfect = perfect_score(name, beta, longest, horizon, parameters['r_max'], shortest)
    scores = []
    for number, rewards in enumerate(episodes):
        ends = cut.ends(SEED, 'evaluate', number, len(rewards) - 1)  # a last step is left over
        segments = np.split(rewards, ends)
        scores.append(sum(composite(name, part, beta, longest) for part in segments) / perfect)
    returns = [float(rewards.sum()) for rewards in episodes]
    values = np.mean(scores), np.std(scores), np.mean(returns), np.std(returns)
    lengths = np.mean([len(rewards) for rewards in episodes])
    return dict(zip(_NUMBERS, map(float, (*values, lengths)), strict=True))
