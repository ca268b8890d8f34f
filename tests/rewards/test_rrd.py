"""Randomized return decomposition: its losses in expectation, and what it draws."""

import itertools
from typing import Any

import numpy as np
import pytest
import torch

from codetr_ros.rewards.rrd import Rrd, decomposition_loss, draw_by_length, subsequences
from codetr_ros.seeding import generator
from helpers import builders
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O
from helpers.linear_rewards import DELAY, explained, memory, noise, recovery, trained


def settings(**changes: Any):
    return builders.tiny(**{'method': 'rrd', 'delay': DELAY} | changes)


def expected_loss(rewards: torch.Tensor, goal: float, size: int, unbiased: bool) -> torch.Tensor:
    """The mean loss over all draws of `size` of the segment's steps: exact, nothing sampled."""
    m = len(rewards)
    steps = list(
        itertools.combinations(range(m), size)
        if size <= m
        else itertools.product(range(m), repeat=size)
    )
    drawn = rewards[torch.tensor(steps)]
    lengths = torch.full((len(steps),), m)
    return decomposition_loss(
        drawn, torch.full((len(steps),), goal, dtype=rewards.dtype), lengths, unbiased
    )


@pytest.mark.parametrize(('m', 'size'), [(6, 2), (6, 4), (5, 5), (3, 4), (2, 6), (1, 3)])
def test_the_unbiased_loss_and_its_gradient_are_in_expectation_those_of_the_whole_segment(m, size):
    rewards = torch.randn(m, generator=torch.manual_seed(m), dtype=torch.float64)
    rewards.requires_grad_()
    goal = 0.7
    whole = (goal - rewards.mean()) ** 2
    found = expected_loss(rewards, goal, size, unbiased=True)
    torch.testing.assert_close(found, whole)
    torch.testing.assert_close(
        torch.autograd.grad(found, rewards), torch.autograd.grad(whole, rewards)
    )


@pytest.mark.parametrize(('m', 'size'), [(6, 2), (6, 4), (5, 5), (3, 4), (2, 6)])
def test_the_biased_loss_is_larger_by_the_variance_of_the_mean_over_the_steps_drawn(m, size):
    rewards = torch.randn(m, generator=torch.manual_seed(m), dtype=torch.float64)
    whole = (0.7 - rewards.mean()) ** 2
    if size <= m:  # sampling theory: of a mean without replacement, and with
        variance = rewards.var() / size * (1 - size / m)
    else:
        variance = rewards.var(correction=0) / size
    found = expected_loss(rewards, 0.7, size, unbiased=False)
    torch.testing.assert_close(found, whole + variance)
    assert (variance > 1e-3) == (size != m)


def test_the_loss_of_a_batch_is_the_mean_over_segments_of_different_lengths():
    rewards = torch.randn(3, 4, generator=torch.manual_seed(0))
    goals, lengths = torch.tensor([0.1, -2.0, 3.0]), torch.tensor([9, 4, 2])
    for unbiased in (False, True):
        each = [
            decomposition_loss(rewards[i : i + 1], goals[i : i + 1], lengths[i : i + 1], unbiased)
            for i in range(3)
        ]
        together = decomposition_loss(rewards, goals, lengths, unbiased)
        torch.testing.assert_close(together, torch.stack(each).mean())


def test_no_step_is_drawn_twice_unless_there_are_too_few():
    lengths = np.array([3, 5, 6, 20])
    counts = [np.zeros(m) for m in lengths]
    for draw in range(300):
        steps = subsequences(generator(0, draw), lengths, 5)
        assert steps.shape == (4, 5)
        for row, m in enumerate(lengths.tolist()):
            assert steps[row].min() >= 0 and steps[row].max() < m
            if m >= 5:
                assert len(set(steps[row].tolist())) == 5
            counts[row] += np.bincount(steps[row], minlength=m)
    for m, count in zip(lengths, counts, strict=True):  # 4 standard deviations at the most
        np.testing.assert_allclose(count, 1500 / m, atol=4 * np.sqrt(1500 / m))


def test_segments_are_drawn_in_proportion_to_their_lengths():
    data = memory((24, 14, 3), 7)
    ids = data.segments.ids()
    assert set(data.segments.lengths(ids).tolist()) == {3, 7}
    drawn = draw_by_length(data, generator(0), 20_000)
    found = np.array([(drawn == i).sum() for i in ids])
    expected = 20_000 * data.segments.lengths(ids) / data.segments.lengths(ids).sum()
    np.testing.assert_allclose(found, expected, atol=4 * np.sqrt(expected.max()))


def test_a_label_depends_on_its_own_step_and_on_where_that_led():
    data = memory(lengths=(64,))
    made = trained(Rrd(settings(), O, A), data, 3)
    batch = data.segments.batch(data.segments.ids())
    before = made.label(batch)
    batch.actions[0, 3] += 0.5
    batch.observations[1, 2] += 0.5
    batch.observations[2, DELAY] += 0.5  # what followed the last step
    changed = np.argwhere(made.label(batch) != before).tolist()
    assert changed == [[0, 3], [1, 1], [1, 2], [2, DELAY - 1]]


def test_the_loss_is_that_of_the_subsequences_drawn_in_units_of_the_target_scale():
    """All steps of each segment are drawn here, so that the loss is that of whole segments."""
    data = memory()
    made = trained(Rrd(settings(rrd__subsequence_steps=DELAY), O, A), data, 3)
    drawn = draw_by_length(data, generator(0, 'x'), 4)
    batch = data.segments.batch(drawn)
    error = (made.predict(batch) - batch.values) / DELAY / data.segments.score_scale()
    said = made.gradient_step(data, generator(0, 'x'))
    assert said['reward_loss'] == pytest.approx(np.mean(error**2), rel=1e-4)


@pytest.mark.slow
def test_a_linear_step_reward_is_found_again_on_unseen_episodes_the_biased_loss_flattening_it():
    data, unseen = memory(), memory(lengths=(64, 64), seed=1)
    spread, found = {}, {}
    for loss in ('biased', 'unbiased'):
        config = settings(
            rrd__loss=loss, rrd__subsequences=32, rrd__learning_rate=1e-2, rrd__hidden=(32,)
        )
        made = trained(Rrd(config, O, A), data, 400)
        spread[loss] = made.label(data.segments.batch(data.segments.ids())).std(1).mean()
        found[loss] = recovery(made, unseen)
    assert found['unbiased'] > 0.95 and found['biased'] > 0.5
    assert spread['biased'] < 0.8 * spread['unbiased']


def test_sixty_four_segments_are_learnt_by_heart():
    data = noise(64)
    config = settings(
        rrd__subsequences=64,
        rrd__subsequence_steps=DELAY,
        rrd__learning_rate=1e-2,
        rrd__hidden=(64, 64),
    )
    assert explained(trained(Rrd(config, O, A), data, 300), data) > 0.97
