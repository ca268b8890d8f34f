"""The reward transformer: what it learns from segments, and the labels that it gives."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.rewards.base import RewardModelError
from codetr_ros.rewards.codetr import Codetr
from codetr_ros.rewards.learned import STD_FLOOR
from codetr_ros.rewards.sequence import learning_rate
from codetr_ros.seeding import generator
from helpers import builders
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O
from helpers.codetr_models import (
    DELAY,
    TOKENS,
    memory,
    model,
    settings,
    whole,
)

pytestmark = pytest.mark.usefixtures('one_thread')


# ---------------------------------------------------------------------------------------- training


@pytest.mark.slow
@pytest.mark.parametrize('kind', ['sum', 'sum_square', 'square_sum', 'max'])
def test_sixty_four_segments_of_each_composite_type_are_learnt_by_heart(kind):
    data = memory(lengths=(128,) * 4, delay=8, kind=kind)
    assert len(data.segments.ids()) == 64
    config = settings(
        delay=8,
        initialisation='gpt2',  # as shipped
        learning_rate=1e-2,
        warmup_gradient_steps=20,
        batch=64,
        schedule='cosine',
        total_gradient_steps=500,
    )
    made = Codetr(config, O, A)
    made.prepare(data)
    for step in range(500):
        made.gradient_step(data, generator(0, step))
    batch = whole(data)
    explained = 1 - np.mean((made.predict(batch) - batch.values) ** 2) / np.var(batch.values)
    assert explained > 0.97, explained


def test_the_loss_is_the_mean_squared_error_of_the_segments_in_units_of_the_target_scale():
    data = memory()
    made = model(data)
    batch = data.segments.sample(generator(0, 'x'), settings().codetr.batch)
    expected = (
        np.mean((made.predict(batch) - batch.values) ** 2) / data.segments.score_scale() ** 2
    )
    said = made.gradient_step(data, generator(0, 'x'))
    assert said['reward_loss'] == pytest.approx(expected, rel=1e-4)
    assert said['learning_rate'] == learning_rate(settings().codetr, 3)


def test_only_the_segments_own_steps_enter_the_loss_where_there_is_context():
    data = memory()
    made = model(data, context='episode', attention_scope='window')
    batch = data.segments.sample(generator(0, 'x'), settings().codetr.batch, made.context)
    expected = (
        np.mean((made.predict(batch) - batch.values) ** 2) / data.segments.score_scale() ** 2
    )
    assert made.gradient_step(data, generator(0, 'x'))['reward_loss'] == pytest.approx(
        expected, rel=1e-4
    )


def test_a_gradient_step_is_that_of_a_plainly_written_adamw():
    data = memory()
    made = model(data, steps=0, weight_decay=0.1, warmup_gradient_steps=0, learning_rate=1e-3)
    parameter = made.network.reward.weight
    m, v = torch.zeros_like(parameter), torch.zeros_like(parameter)
    for step in range(1, 4):
        before = parameter.detach().clone()
        made.gradient_step(data, generator(0, step))
        gradient = parameter.grad
        m, v = 0.9 * m + 0.1 * gradient, 0.999 * v + 0.001 * gradient**2
        adam = (m / (1 - 0.9**step)) / ((v / (1 - 0.999**step)).sqrt() + 1e-8)
        expected = before - 1e-3 * 0.1 * before - 1e-3 * adam
        torch.testing.assert_close(parameter.detach(), expected, rtol=1e-5, atol=1e-7)


def test_the_learning_rate_rises_then_stays_or_falls_to_a_tenth():
    steady = settings(
        warmup_gradient_steps=10, total_gradient_steps=110, learning_rate=1e-2, schedule='constant'
    )
    falling = steady.changed({'codetr.schedule': 'cosine'})
    for config in (steady.codetr, falling.codetr):
        assert [learning_rate(config, step) for step in (0, 4, 9)] == pytest.approx(
            [1e-3, 5e-3, 1e-2]
        )
    assert {learning_rate(steady.codetr, step) for step in (10, 60, 500)} == {1e-2}
    assert [learning_rate(falling.codetr, s) for s in (10, 60, 110, 500)] == pytest.approx(
        [1e-2, 5.5e-3, 1e-3, 1e-3]
    )


def test_a_peaked_learning_rate_begins_and_ends_at_the_setting_and_peaks_at_ten_times_it():
    """As optax's warmup_cosine_decay_schedule(rate, 10 rate, warm-up, total, rate) has it."""
    config = settings(
        warmup_gradient_steps=10, total_gradient_steps=110, learning_rate=1e-2, schedule='peaked'
    ).codetr
    rising = [1e-2 + (1e-1 - 1e-2) * step / 10 for step in range(10)]
    falling = [1e-2 + (1e-1 - 1e-2) * math.cos(math.pi * step / 200) ** 2 for step in range(101)]
    expected = [*rising, *falling, 1e-2, 1e-2]
    assert [learning_rate(config, step) for step in range(113)] == pytest.approx(expected)


def test_observations_are_standardised_by_moments_that_stay_as_they_were_at_the_warm_up():
    data = memory(lengths=(60,) * 4)
    made = model(data)
    batch = whole(data)
    mean, std = data.store.observation_moments()
    bare = model(data, steps=0, normalise_observations=False)
    bare.network.load_state_dict(made.network.state_dict())
    scaled = ((batch.observations - mean) / std).astype(np.float32)
    expected = bare.label(replace(batch, observations=scaled))
    np.testing.assert_allclose(made.label(batch), expected, rtol=1e-3, atol=1e-4)
    assert np.abs(bare.label(batch) - expected).max() > 1e-2
    before = made.state()['observation_mean']
    more = memory(lengths=(60,) * 4, seed=5)
    made.gradient_step(more, generator(0))
    assert torch.equal(made.state()['observation_mean'], before)


def test_an_observation_that_stood_still_in_the_warm_up_is_not_blown_up():
    data = Trajectories(O, A, DELAY, 100, 100)
    still = builders.transitions(steps=DELAY, observations=np.ones((DELAY + 1, O), np.float32))
    data.append(still)
    data.score(builders.score(length=DELAY))
    made = model(data, steps=0)
    np.testing.assert_allclose(made.state()['observation_std'], STD_FLOOR)


def test_without_a_target_scale_the_composite_rewards_are_learnt_as_they_are():
    data = memory(kind='square_sum')
    assert model(data, steps=0).target_scale == data.segments.score_scale() != 1.0
    assert model(data, steps=0, target_scale='none').target_scale == 1.0


def test_diverged_training_is_refused_and_changes_no_weight():
    data = memory()
    made = model(data)
    with torch.no_grad():
        made.network.reward.bias.fill_(math.nan)
    before = made.network.causal.action.weight.detach().clone()
    with pytest.raises(
        RewardModelError, match=r'reward_loss is nan at gradient step 3.*learning_rate = 0.001'
    ):
        made.gradient_step(data, generator(0))
    assert torch.equal(made.network.causal.action.weight, before)


# --------------------------------------------------------------------------------------- labelling


@pytest.mark.parametrize(
    'changes',
    [{}, {'tokens': 'pair'}, {'weights': 'one'}, {'context': 'episode'}, {'head_scale': 'one'}],
)
@pytest.mark.parametrize('unit', ['raw', 'scaled'])
def test_the_labels_of_a_segment_add_up_to_its_predicted_composite_reward(unit, changes):
    data = memory(kind='square_sum')
    made = model(data, reward_unit=unit, **changes)
    batch = whole(data, made.context)
    factor = 1.0 if unit == 'raw' else made.target_scale
    np.testing.assert_allclose(
        made.label(batch).sum(1) * factor, made.predict(batch), rtol=1e-4, atol=1e-4
    )


def test_a_label_is_the_weighted_reward_or_the_reward_alone():
    data = memory()
    product, plain = model(data, label='product'), model(data, label='rhat')
    batch = whole(data)
    weights, rewards = product.components(batch)
    np.testing.assert_array_equal(product.label(batch), weights * rewards)
    np.testing.assert_array_equal(plain.label(batch), rewards)


@pytest.mark.parametrize('label', ['product', 'rhat'])
@pytest.mark.parametrize('scope', ['segment', 'window'])
@pytest.mark.parametrize('tokens', TOKENS)
def test_window_labels_are_those_of_a_naive_loop_over_steps(tokens, scope, label):
    lengths, window = (20, 15), 8
    data = memory(lengths)
    made = model(
        data, labelling='window', window=window, attention_scope=scope, label=label, tokens=tokens
    )
    found = np.concatenate(
        [made.label_windows(b) for b in data.segments.windows(data.segments.ids(), window, 7)]
    )
    rng = np.random.default_rng(0)
    expected = []
    network = made.network.eval()
    for steps in lengths:
        observations = rng.normal(2.0, 3.0, (steps + 1, O)).astype(np.float32)
        actions = rng.uniform(-1, 1, (steps, A)).astype(np.float32)
        for t in range(steps):
            first = max(0, t + 1 - window)
            start = first if scope == 'window' else max(first, t // DELAY * DELAY)
            seen = (torch.from_numpy(observations[first : t + 1]) - made._mean) / made._std
            with torch.inference_mode():
                x = network.causal(seen[None], torch.from_numpy(actions[None, first : t + 1]))[0]
                q, k = network.weights.qk(x[start - first :]).chunk(2, -1)
                weight = (q @ k.T / math.sqrt(q.shape[1])).softmax(-1).sum(0)[-1]
                reward = network.reward(x[-1])[0]
            expected.append(float(weight * reward if label == 'product' else reward))
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-5)


def test_a_window_longer_than_the_model_has_places_for_is_refused():
    data = memory(delay=12)
    made = model(memory())
    with pytest.raises(
        RewardModelError, match=r'window of 12 steps.*places for 10.*delay = 6.*codetr.window = 10'
    ):
        made.label(whole(data))
