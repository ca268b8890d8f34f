"""The Markovian reward model: r(s, a), learnt from the sums of segments alone."""

from typing import Any

import numpy as np
import pytest
import torch

from codetr_ros.rewards.mlp import Mlp, perceptron
from codetr_ros.seeding import generator
from helpers import builders
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O
from helpers.linear_rewards import DELAY, explained, memory, noise, recovery, trained


def settings(**changes: Any):
    return builders.tiny(**{'method': 'mlp', 'delay': DELAY} | changes)


def test_a_linear_step_reward_is_found_again_from_the_sums_of_segments_on_unseen_episodes():
    config = settings(mlp__batch=32, mlp__learning_rate=1e-2, mlp__hidden=(32,))
    made = trained(Mlp(config, O, A), memory(), 400)
    unseen = memory(lengths=(64, 64), seed=1)
    assert recovery(made, unseen) > 0.97
    assert explained(made, unseen) > 0.97


def test_a_label_depends_on_its_own_step_alone():
    data = memory(lengths=(64,))
    made = trained(Mlp(settings(), O, A), data, 3)
    batch = data.segments.batch(data.segments.ids())
    before = made.label(batch)
    batch.actions[0, 3] += 0.5
    batch.observations[1, 2] += 0.5
    changed = np.argwhere(made.label(batch) != before).tolist()
    assert changed == [[0, 3], [1, 2]]


def test_sixty_four_segments_are_learnt_by_heart():
    data = noise(64)
    config = settings(mlp__batch=64, mlp__learning_rate=1e-2, mlp__hidden=(64, 64))
    assert explained(trained(Mlp(config, O, A), data, 300), data) > 0.97


def test_the_loss_is_the_mean_squared_error_of_the_sums_in_units_of_the_target_scale():
    data = memory((20, 11, 3))  # three segments are short
    made = trained(Mlp(settings(), O, A), data, 3)
    batch = data.segments.sample(generator(0, 'x'), settings().mlp.batch)
    expected = (
        np.mean((made.predict(batch) - batch.values) ** 2) / data.segments.score_scale() ** 2
    )
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
