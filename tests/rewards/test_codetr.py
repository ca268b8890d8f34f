"""The reward transformer: what the method promises of its weights and rewards."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from codetr_ros.rewards.transformer import CausalSelfAttention, RewardTransformer
from codetr_ros.seeding import seed_torch
from helpers import builders
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O
from helpers.codetr_models import (
    DELAY,
    TOKENS,
    changed,
    memory,
    model,
    padded,
    settings,
    whole,
)

pytestmark = pytest.mark.usefixtures('one_thread')


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


@pytest.mark.parametrize(('window', 'before'), [(10, 4), (DELAY, 0), (3, 0), (18, 12)])
def test_a_window_is_filled_up_with_the_steps_before_the_segment(window, before):
    """Its length is H, or the segment's where that is longer, or what the episode has."""
    data = memory(lengths=(30,))
    made = model(data, context='window', window=window)
    batch = whole(data, made.context)
    assert batch.context.tolist() == [min(before, DELAY * i) for i in range(5)]
    assert batch.lengths.max() == max(window, DELAY)
    plain = made.label(batch)
    last = np.concatenate([part[-DELAY:] for part in made.label_passes(data, np.array([4]))])
    np.testing.assert_allclose(last, plain[4, batch.context[4] : batch.lengths[4]], rtol=1e-5)
    alone = model(data, context='segment', window=window).label(whole(data))
    assert np.allclose(alone[4], last) == (before == 0)


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
