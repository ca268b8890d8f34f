"""The Markovian reward model: r(s, a), learnt from the sums of segments alone."""

from typing import Any

import builders
import numpy as np
import pytest
import torch
from builders import ACTION as A
from builders import OBSERVATION as O

from codetr_ros.records import F64, CompositeReward
from codetr_ros.rewards.learned import Learned
from codetr_ros.rewards.method import segment_steps
from codetr_ros.rewards.mlp import Mlp, perceptron
from codetr_ros.seeding import generator, seed_torch
from codetr_ros.trajectories import Trajectories

DELAY = 8


def linear(observations: F64, actions: F64) -> F64:
    """The reward that is to be found again."""
    return 0.5 * observations[..., 0] - observations[..., 1] + 2 * actions[..., 0] + 1


def memory(episodes: int = 8, steps: int = 64, seed: int = 0) -> Trajectories:
    """Episodes of which only the sums of linear step rewards over segments are told."""
    rng = np.random.default_rng(seed)
    found = Trajectories(O, A, DELAY, 10_000, 1000)
    for episode in range(episodes):
        chunk = builders.transitions(
            steps=steps,
            sequence=episode,
            episode=episode,
            observations=rng.normal(2.0, 3.0, (steps + 1, O)).astype(np.float32),
            actions=rng.uniform(-1, 1, (steps, A)).astype(np.float32),
            truncated=True,
        )
        found.append(chunk)
        rewards = linear(
            chunk.observations[:-1].astype(np.float64), chunk.actions.astype(np.float64)
        )
        for first in range(0, steps, DELAY):
            part = rewards[first : first + DELAY]
            found.score(
                CompositeReward(
                    'run', 'sim', 'sim', first, episode, first, len(part), float(part.sum())
                )
            )
    return found


def settings(**changes: Any):
    return builders.tiny(**{'method': 'mlp', 'delay': DELAY} | changes)


def trained(method: Learned, data: Trajectories, steps: int) -> Learned:
    method.prepare(data)
    for step in range(steps):
        seed_torch(0, step)
        method.gradient_step(data, generator(0, step))
    return method


def recovery(method: Learned, data: Trajectories) -> float:
    """Correlation of inferred and true rewards with each segment's mean removed."""
    batch = data.segment_batch(data.segment_ids())
    inside = segment_steps(batch)
    true = linear(batch.observations[:, :-1].astype(np.float64), batch.actions.astype(np.float64))
    labels = method.label(batch).astype(np.float64)
    n = inside.sum(1, keepdims=True)
    centred = [(x - (x * inside).sum(1, keepdims=True) / n)[inside] for x in (labels, true)]
    return float(np.corrcoef(*centred)[0, 1])


def test_a_linear_step_reward_is_found_again_from_the_sums_of_segments_on_unseen_episodes():
    config = settings(mlp__batch=32, mlp__learning_rate=1e-2, mlp__hidden=(32,))
    made = trained(Mlp(config, O, A), memory(), 400)
    unseen = memory(episodes=2, seed=1)
    assert recovery(made, unseen) > 0.97
    batch = unseen.segment_batch(unseen.segment_ids())
    explained = 1 - np.mean((made.predict(batch) - batch.values) ** 2) / np.var(batch.values)
    assert explained > 0.97


def test_a_label_depends_on_its_own_step_alone():
    data = memory(episodes=1)
    made = trained(Mlp(settings(), O, A), data, 3)
    batch = data.segment_batch(data.segment_ids())
    before = made.label(batch)
    batch.actions[0, 3] += 0.5
    batch.observations[1, 2] += 0.5
    changed = np.argwhere(made.label(batch) != before).tolist()
    assert changed == [[0, 3], [1, 2]]


def test_sixty_four_segments_are_learnt_by_heart():
    data = memory()
    assert len(data.segment_ids()) == 64
    scores = np.random.default_rng(0)
    for source in data._sources.values():  # scores that have nothing to do with the steps
        source.segment_values[:64] = scores.normal(size=64)
    config = settings(mlp__batch=64, mlp__learning_rate=1e-2, mlp__hidden=(64, 64))
    made = trained(Mlp(config, O, A), data, 300)
    batch = data.segment_batch(data.segment_ids())
    explained = 1 - np.mean((made.predict(batch) - batch.values) ** 2) / np.var(batch.values)
    assert explained > 0.97


def test_the_loss_is_the_mean_squared_error_of_the_sums_in_units_of_the_target_scale():
    data = memory()
    made = trained(Mlp(settings(), O, A), data, 3)
    batch = data.sample_segments(generator(0, 'x'), settings().mlp.batch)
    expected = np.mean((made.predict(batch) - batch.values) ** 2) / data.score_scale() ** 2
    assert made.gradient_step(data, generator(0, 'x'))['reward_loss'] == pytest.approx(
        expected, rel=1e-4
    )


def test_the_perceptron_is_relu_between_linear_layers():
    torch.manual_seed(0)
    network = perceptron(3, (5, 4))
    first, second, last = (m for m in network if isinstance(m, torch.nn.Linear))
    x = torch.randn(7, 3)
    hidden = (x @ first.weight.T + first.bias).clamp(min=0)
    hidden = (hidden @ second.weight.T + second.bias).clamp(min=0)
    torch.testing.assert_close(network(x), hidden @ last.weight.T + last.bias)
    assert last.weight.shape == (1, 4) and not last.bias.any()
