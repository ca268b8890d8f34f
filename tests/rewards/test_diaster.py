"""Diaster: what parts of segments are worth, where they are cut, and the differences."""

from typing import Any

import numpy as np
import pytest
import torch

from codetr_ros.rewards.base import segment_steps
from codetr_ros.rewards.diaster import Diaster, differences
from codetr_ros.rewards.rrd import draw_by_length
from codetr_ros.seeding import generator
from helpers import builders
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O
from helpers.linear_rewards import DELAY, explained, memory, recovery, trained


def settings(**changes: Any):
    return builders.tiny(**{'method': 'diaster', 'delay': DELAY} | changes)


def worth(made: Diaster, steps: np.ndarray) -> list[float]:
    """S of the first 1, 2, ... steps (L, D): the equations of a GRU, step by step in numpy."""
    weights = {n: p.detach().double().numpy() for n, p in made.network.named_parameters()}
    names = ('weight_ih', 'weight_hh', 'bias_ih', 'bias_hh')
    into, back, ahead, over = (weights[f'recurrent.{name}_l0'] for name in names)

    def sigmoid(x: np.ndarray) -> np.ndarray:
        return 1 / (1 + np.exp(-x))

    state, found = np.zeros(back.shape[1]), []
    for step in steps:
        new, old = np.split(into @ step + ahead, 3), np.split(back @ state + over, 3)
        reset, update = sigmoid(new[0] + old[0]), sigmoid(new[1] + old[1])
        state = (1 - update) * np.tanh(new[2] + reset * old[2]) + update * state
        found.append(float((weights['worth.weight'] @ state + weights['worth.bias'])[0]))
    return found


def drawn(data, config, seed: int):
    """The segments and the cut that a gradient step with this seed draws."""
    rng = generator(0, seed)
    batch = data.segments.batch(draw_by_length(data, rng, config.diaster.batch))
    return batch, int(rng.integers(1, batch.actions.shape[1] + 1))


def test_both_losses_are_those_of_their_formulas_step_by_step():
    data = memory((20, 11, 3))  # three segments are short
    made = trained(Diaster(settings(), O, A), data, 3)
    unit, cuts = data.segments.score_scale(), set()
    for seed in range(4):
        batch, cut = drawn(data, settings(), seed)
        steps, rewards = made._step_inputs(batch).double().numpy(), made._step_rewards(batch)
        scores, apart = [], []
        for i, (m, value) in enumerate(zip(batch.lengths.tolist(), batch.values, strict=True)):
            parts = [part for part in np.split(steps[i, :m], [cut]) if len(part)]
            cuts.add((cut, m, len(parts)))
            scores.append(sum(worth(made, part)[-1] for part in parts) - value / unit)
            before = [0.0, *worth(made, steps[i, :m])[:-1], value / unit]
            apart += (rewards[i, :m].detach().numpy() - np.diff(before)).tolist()
        (terms,) = made._terms(data, generator(0, seed))
        found = [float(terms[name].detach()) for name in ('reward_loss', 'step_loss')]
        expected = [np.mean(np.square(errors)) for errors in (scores, apart)]
        assert found == pytest.approx(expected, rel=1e-4)
    kinds = {(cut == DELAY, m < DELAY, parts) for cut, m, parts in cuts}
    assert kinds >= {(False, False, 2), (False, True, 1)}  # cut, and too short to be cut


def test_a_segment_is_cut_at_every_place_alike_or_not_at_all():
    data = memory((24,))
    config = settings(diaster__batch=1)
    cuts = [drawn(data, config, seed)[1] for seed in range(800)]
    counts = np.bincount(cuts, minlength=DELAY + 1)
    assert counts[0] == 0 and len(counts) == DELAY + 1
    np.testing.assert_allclose(counts[1:], 800 / DELAY, atol=4 * np.sqrt(800 / DELAY))


def test_the_targets_of_a_segment_sum_to_its_score_whatever_its_parts_are_worth():
    worths = torch.randn(3, 6, generator=torch.manual_seed(0), dtype=torch.float64)
    lengths, returns = torch.tensor([6, 4, 1]), torch.tensor([1.0, -20.0, 3.0]).double()
    found = differences(worths, lengths, returns)
    for i, m in enumerate(lengths.tolist()):
        assert found[i, :m].sum() == pytest.approx(float(returns[i]))
    assert found[1, 2] == worths[1, 2] - worths[1, 1]


def test_neither_loss_reaches_the_network_of_the_other():
    data = memory()
    made = trained(Diaster(settings(), O, A), data, 1)
    (terms,) = made._terms(data, generator(0))
    for name, learns in (('reward_loss', {'recurrent', 'worth'}), ('step_loss', {'step'})):
        made.network.zero_grad()
        terms[name].backward(retain_graph=True)
        reached = {n for n, p in made.network.named_parameters() if p.grad is not None}
        assert {n.partition('.')[0] for n in reached} == learns


def test_a_gradient_step_states_both_losses():
    data = memory()
    stated = trained(Diaster(settings(), O, A), data, 1).gradient_step(data, generator(0))
    assert stated.keys() == {'reward_loss', 'step_loss', 'learning_rate'}


def test_a_label_depends_on_its_own_step_alone():
    data = memory(lengths=(64,))
    made = trained(Diaster(settings(), O, A), data, 3)
    batch = data.segments.batch(data.segments.ids())
    before = made.label(batch)
    batch.actions[0, 3] += 0.5
    batch.observations[1, 2] += 0.5
    assert np.argwhere(made.label(batch) != before).tolist() == [[0, 3], [1, 2]]
    assert segment_steps(batch).all()


@pytest.mark.slow
def test_a_linear_step_reward_is_found_again_on_unseen_episodes():
    config = settings(
        diaster__batch=32,
        diaster__learning_rate=1e-2,
        diaster__hidden=(32,),
        diaster__width=32,
    )
    made = trained(Diaster(config, O, A), memory(), 800)
    unseen = memory(lengths=(64, 64), seed=1)
    assert recovery(made, unseen) > 0.97
    assert explained(made, unseen) > 0.97
