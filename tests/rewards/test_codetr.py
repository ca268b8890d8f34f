"""The reward transformer: what the method promises of its weights, rewards, training, labels."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from codetr_ros.config import Settings
from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import CompositeReward, Transitions
from codetr_ros.rewards.base import RewardModelError
from codetr_ros.rewards.codetr import Codetr
from codetr_ros.rewards.learned import STD_FLOOR
from codetr_ros.rewards.sequence import learning_rate
from codetr_ros.rewards.transformer import CausalSelfAttention, RewardTransformer
from codetr_ros.seeding import generator, seed_torch
from codetr_ros.simulation.composite import composite
from helpers import builders
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O

DELAY = 6
TOKENS = ('pair', 'merged')


@pytest.fixture(autouse=True)
def one_thread():
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def settings(**changes) -> Settings:
    """Small networks without dropout; `label='rhat'` sets codetr.label, `delay=4` the delay."""
    own = {'delay', 'target_scale', 'reward_unit', 'method', 'seed'}
    small = {
        # steps depend on each other from the start, so that what is seen where can be told
        'codetr__initialisation': 'lecun',
        'codetr__dropout': 0.0,
        'codetr__head_scale': 'inverse_sqrt',
        'codetr__layers': 2,
        'codetr__window': 10,
        'delay': DELAY,
    }
    named = {name if name in own else f'codetr__{name}': value for name, value in changes.items()}
    return builders.tiny(**small | named)


def memory(lengths=(20, 15), delay=DELAY, kind='sum', seed=0) -> Trajectories:
    """Episodes of these lengths, all segments scored; a step's reward depends on it alone."""
    rng = np.random.default_rng(seed)
    found = Trajectories(O, A, delay, 10_000, 1000)
    for episode, steps in enumerate(lengths):
        observations = rng.normal(2.0, 3.0, (steps + 1, O)).astype(np.float32)
        actions = rng.uniform(-1, 1, (steps, A)).astype(np.float32)
        rewards = np.tanh(observations[:-1, 0] - 2) + actions[:, 0].astype(np.float64)
        found.append(
            Transitions(
                run_id='run',
                source='sim',
                sequence=episode,
                phase=0,
                episode=episode,
                first_step=0,
                steps=steps,
                observations=observations,
                actions=actions,
                terminated=False,
                truncated=True,
                phase_end=False,
                scores_due=0,
            )
        )
        for first in range(0, steps, delay):
            part = rewards[first : first + delay]
            value = composite(kind, part.astype(np.float64), 3.0, delay)
            found.score(
                CompositeReward(
                    run_id='run',
                    source='sim',
                    scorer='sim',
                    sequence=first,
                    episode=episode,
                    first_step=first,
                    length=len(part),
                    value=value,
                )
            )
    return found


def model(data: Trajectories, steps: int = 3, **changes) -> Codetr:
    """A model that has taken a few gradient steps, so that nothing is 0 or symmetric any more."""
    made = Codetr(settings(**changes), O, A)
    made.prepare(data)
    for step in range(steps):
        made.gradient_step(data, generator(0, step))
    return made


def whole(data: Trajectories, context: int = 0) -> SegmentBatch:
    return data.segments.batch(data.segments.ids(), context)


def changed(batch: SegmentBatch, row: int, step: int) -> SegmentBatch:
    """The batch with another observation and action at one step."""
    observations, actions = batch.observations.copy(), batch.actions.copy()
    observations[row, step] += 1.0
    actions[row, step] -= 0.5
    return replace(batch, observations=observations, actions=actions)


def padded(batch: SegmentBatch, by: int, value: float = 0.0) -> SegmentBatch:
    wider = [(0, 0), (0, by), (0, 0)]
    return replace(
        batch,
        observations=np.pad(batch.observations, wider, constant_values=value),
        actions=np.pad(batch.actions, wider, constant_values=value),
    )


# ------------------------------------------------------------------------------------- the network


@pytest.mark.parametrize('tokens', TOKENS)
def test_the_reward_of_a_step_depends_on_that_step_and_those_before_but_on_none_after(tokens):
    data = memory()
    made = model(data, tokens=tokens)
    batch = whole(data)
    _, before = made.components(batch)
    for step in range(DELAY):
        _, after = made.components(changed(batch, 0, step))
        np.testing.assert_allclose(after[0, :step], before[0, :step], atol=1e-6)
        assert (np.abs(after[0, step:] - before[0, step:]) > 1e-5).all()
        np.testing.assert_allclose(after[1:], before[1:], atol=1e-6)


@pytest.mark.parametrize('tokens', TOKENS)
def test_the_reward_of_a_step_depends_on_its_observation_and_on_its_action_alone(tokens):
    data = memory()
    made = model(data, tokens=tokens)
    batch = whole(data)
    _, before = made.components(batch)
    for field in ('observations', 'actions'):
        array = getattr(batch, field).copy()
        array[0, 2] += 0.7
        _, after = made.components(replace(batch, **{field: array}))
        assert abs(after[0, 2] - before[0, 2]) > 1e-5, field


def test_the_weight_of_a_step_depends_on_later_steps_of_its_segment():
    data = memory()
    made = model(data)
    batch = whole(data)
    before, _ = made.components(batch)
    after, _ = made.components(changed(batch, 0, DELAY - 1))
    assert (np.abs(after[0] - before[0]) > 1e-7).all()


@pytest.mark.parametrize('head_scale', ['inverse', 'inverse_sqrt', 'one'])
@pytest.mark.parametrize('tokens', TOKENS)
def test_the_weights_of_a_segment_are_positive_and_sum_to_its_steps(tokens, head_scale):
    data = memory()
    weights, _ = model(data, tokens=tokens, head_scale=head_scale).components(whole(data))
    lengths = whole(data).lengths
    assert set(lengths.tolist()) == {6, 2, 3}  # the last segment of either episode is shorter
    np.testing.assert_allclose(weights.sum(1), lengths, rtol=1e-5)
    inside = np.arange(DELAY) < lengths[:, None]
    assert (weights[inside] > 0).all() and (weights[~inside] == 0).all()


def test_with_the_weights_fixed_to_one_every_step_has_weight_one_and_no_attention_is_learnt():
    data = memory()
    made = model(data, weights='one')
    batch = whole(data)
    weights, rewards = made.components(batch)
    np.testing.assert_array_equal(weights, np.arange(DELAY) < batch.lengths[:, None])
    np.testing.assert_array_equal(made.label(batch), rewards)
    assert not [name for name in made.state() if 'weights.qk' in name]


def test_the_sum_of_weighted_rewards_is_the_sum_of_the_attention_outputs():
    """sum_i z_i = sum_t w_t rhat_t, with z_i = sum_t softmax_t(q_i k_t) rhat_t."""
    data = memory()
    made = model(data)
    batch = whole(data)
    weights, rewards = made.components(batch)
    network = made.network.eval()
    inside = torch.from_numpy(np.arange(DELAY) < batch.lengths[:, None])
    seen = (torch.from_numpy(batch.observations[:, :-1]) - made._mean) / made._std
    with torch.inference_mode():
        x = network.causal(seen, torch.from_numpy(batch.actions))
        attention = network.weights.attention(x, inside)
    outputs = (attention.numpy() * rewards[:, None, :]).sum(2)  # z, (B, L)
    np.testing.assert_allclose(outputs.sum(1), (weights * rewards).sum(1), rtol=1e-4, atol=1e-5)
    assert (
        np.abs(outputs - weights * rewards).max() > 1e-3
    )  # the terms differ, only the sums agree


@pytest.mark.parametrize('head_scale', ['inverse', 'inverse_sqrt', 'one'])
def test_the_weights_are_column_sums_of_a_plainly_written_attention(head_scale):
    torch.manual_seed(0)
    config = settings(head_scale=head_scale).codetr
    head = RewardTransformer(O, A, DELAY, config).weights
    x = torch.randn(2, 4, config.embedding)
    inside = torch.tensor([[True, True, True, False], [False, True, True, True]])
    found = head(x, inside)
    q, k = head.qk(x).detach().split(config.embedding, -1)
    scale = {'inverse': 1 / 16, 'inverse_sqrt': 1 / 4, 'one': 1.0}[head_scale]  # 16 wide
    for row in range(2):
        steps = torch.nonzero(inside[row]).flatten().tolist()
        expected = torch.zeros(4)
        for i in steps:
            exps = {t: math.exp(scale * float(q[row, i] @ k[row, t])) for t in steps}
            for t in steps:
                expected[t] += exps[t] / sum(exps.values())
        torch.testing.assert_close(found[row], expected, rtol=1e-4, atol=1e-5)


def test_the_fused_attention_equals_the_plain_one():
    torch.manual_seed(0)
    config = settings().codetr
    attention = CausalSelfAttention(config).eval()
    h = torch.randn(3, 7, config.embedding)
    q, k, v = (
        part.view(3, 7, config.heads, -1).transpose(1, 2)
        for part in attention.qkv(h).split(config.embedding, -1)
    )
    logits = q @ k.transpose(-1, -2) / math.sqrt(config.embedding / config.heads)
    logits = logits.masked_fill(torch.ones(7, 7).triu(1).bool(), -math.inf)
    plain = attention.out((logits.softmax(-1) @ v).transpose(1, 2).reshape(3, 7, -1))
    torch.testing.assert_close(attention(h), plain, rtol=1e-4, atol=1e-5)


def test_dropout_acts_in_training_only_and_draws_from_the_global_generator():
    torch.manual_seed(0)
    config = settings(dropout=0.3).codetr
    network = RewardTransformer(O, A, DELAY, config)
    x = torch.randn(2, DELAY, O), torch.randn(2, DELAY, A), torch.ones(2, DELAY, dtype=torch.bool)
    seed_torch(0, 'a')
    first, second = network(*x)[1], network(*x)[1]
    seed_torch(0, 'a')
    assert not torch.equal(first, second) and torch.equal(network(*x)[1], first)
    network.eval()
    assert torch.equal(network(*x)[1], network(*x)[1])


@pytest.mark.parametrize('tokens', TOKENS)
def test_a_paper_sized_network_has_as_many_parameters_as_the_published_code(tokens):
    """Ant with 111 observations, 1000 positions: 2.79 million."""
    config = builders.load('paper').changed({'codetr.tokens': tokens}).codetr
    network = RewardTransformer(111, 8, 1001, config)
    assert sum(p.numel() for p in network.parameters()) == 2_789_377


# ---------------------------------------------------------------------------- segments and padding


def test_the_attention_of_a_segment_does_not_see_the_context_unless_its_scope_is_the_window():
    data = memory()
    made = model(data, context='episode', attention_scope='segment', layers=1)
    batch = whole(data, made.context)
    row = int(np.argmax(batch.context))
    assert batch.context[row] >= DELAY
    network = made.network.eval()
    with torch.inference_mode():
        # causal states as they are: what differs then is what the attention in the sequence sees
        x = torch.randn(1, batch.actions.shape[1], made._codetr.embedding)
        inside = torch.from_numpy(
            (np.arange(x.shape[1]) >= batch.context[row])
            & (np.arange(x.shape[1]) < batch.lengths[row])
        )[None]
        other = x.clone()
        other[:, : batch.context[row]] += 1.0
        everything = torch.ones_like(inside)
        assert torch.equal(network.weights(x, inside), network.weights(other, inside))
        assert not torch.allclose(
            network.weights(x, everything), network.weights(other, everything)
        )


@pytest.mark.parametrize('context', ['segment', 'episode'])
def test_another_segment_is_invisible_without_context_and_visible_with_it(context):
    data = memory()
    made = model(data, context=context)
    batch = whole(data, made.context)
    row = 1  # the second segment of the first episode
    before_w, before_r = made.components(batch)
    if context == 'segment':
        assert made.context == 0 and not batch.context.any()
        other = changed(batch, 0, 0)
    else:
        assert batch.context[row] == DELAY
        other = changed(batch, row, 0)
    after_w, after_r = made.components(other)
    same = np.allclose(after_w[row], before_w[row], atol=1e-6) and np.allclose(
        after_r[row], before_r[row], atol=1e-6
    )
    assert same == (context == 'segment')


@pytest.mark.parametrize('scope', ['segment', 'window'])
def test_the_scope_decides_whether_the_context_takes_part_in_the_weights(scope):
    data = memory()
    made = model(data, context='episode', attention_scope=scope)
    batch = whole(data, made.context)
    weights, _ = made.components(batch)
    own = batch.lengths - batch.context
    with_context = batch.context > 0
    np.testing.assert_allclose(weights.sum(1)[~with_context], own[~with_context], rtol=1e-5)
    fits = np.isclose(weights.sum(1)[with_context], own[with_context], rtol=1e-5)
    assert fits.all() if scope == 'segment' else not fits.any()
    before = np.arange(batch.actions.shape[1]) < batch.context[:, None]
    assert not weights[before].any()
    assert not made.label(batch)[before].any()


@pytest.mark.parametrize(
    'changes', [{}, {'tokens': 'pair'}, {'context': 'episode', 'attention_scope': 'window'}]
)
def test_padding_changes_nothing_whatever_it_holds(changes):
    data = memory()
    made = model(data, **changes)
    batch = whole(data, made.context)
    short = int(np.argmin(batch.lengths))
    before = made.label(batch)
    filled = padded(batch, 0)
    filled.observations[short, batch.lengths[short] + 1 :] = 1e3
    filled.actions[short, batch.lengths[short] :] = -1e3
    np.testing.assert_allclose(made.label(filled), before, rtol=1e-5, atol=1e-6)
    if made.context == 0:
        wider = made.label(padded(batch, 4, value=9.0))
        np.testing.assert_allclose(wider[:, :DELAY], before, rtol=1e-5, atol=1e-6)
        assert not wider[:, DELAY:].any()
    alone = data.segments.batch(data.segments.ids()[[short]], made.context)
    row = before[short, : batch.lengths[short]]
    np.testing.assert_allclose(made.label(alone)[0], row, rtol=1e-5, atol=1e-6)


# ---------------------------------------------------------------------------------------- training


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
