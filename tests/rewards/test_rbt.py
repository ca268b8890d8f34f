"""The reward bag transformer: rewards that are attention outputs, and next observations."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.rewards.base import segment_steps
from codetr_ros.rewards.codetr import Codetr
from codetr_ros.rewards.rbt import Rbt
from codetr_ros.seeding import generator
from helpers import builders
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O
from helpers.linear_rewards import DELAY, explained, memory, noise, recovery, trained


def settings(**changes: Any):
    """Steps depend on each other from the start, so that what is seen where can be told."""
    own = {
        'method': 'rbt',
        'delay': 7,
        'codetr__initialisation': 'lecun',
        'codetr__head_scale': 'inverse_sqrt',
        'codetr__dropout': 0.0,
        'codetr__window': 10,
        'rbt__attention_scope': 'segment',
    }
    return builders.tiny(**own | changes)


def made(data: Trajectories, steps: int = 3, **changes: Any) -> Rbt:
    method = Rbt(settings(**changes), O, A)
    trained(method, data, steps)
    return method


def filled() -> Trajectories:
    """Segments of 7 steps and short ones."""
    return memory((24, 14, 3), 7)


def whole(data: Trajectories, context: int = 0) -> SegmentBatch:
    return data.segments.batch(data.segments.ids(), context)


@pytest.mark.parametrize('tokens', ['pair', 'merged'])
def test_with_the_same_weights_it_predicts_what_codetr_predicts_but_credits_other_steps(tokens):
    """sum_t z_t = sum_t w_t rhat_t."""
    data = filled()
    rbt = made(data, codetr__tokens=tokens)
    codetr = Codetr(settings(codetr__tokens=tokens, method='codetr'), O, A)
    codetr.prepare(data)
    carried = rbt.network.state_dict()
    codetr.network.load_state_dict({n: carried[n] for n in codetr.network.state_dict()})
    batch = whole(data)
    np.testing.assert_allclose(rbt.predict(batch), codetr.predict(batch), rtol=1e-4, atol=1e-4)
    inside = segment_steps(batch)
    assert np.abs(rbt.label(batch) - codetr.label(batch))[inside].max() > 1e-2


def test_labels_are_the_outputs_of_a_plainly_written_attention():
    data = filled()
    rbt = made(data)
    batch = whole(data)
    labels = rbt.label(batch)
    network = rbt.network.eval()
    seen = (torch.from_numpy(batch.observations[:, :-1]) - rbt._mean) / rbt._std
    with torch.inference_mode():
        x = network.causal(seen, torch.from_numpy(batch.actions))
        q, k = network.weights.qk(x).chunk(2, -1)
        v = network.reward(x).squeeze(-1)
    for row, m in enumerate(batch.lengths.tolist()):
        for t in range(m):
            exps = [math.exp(float(q[row, t] @ k[row, j]) / math.sqrt(16)) for j in range(m)]
            z = sum(e * float(v[row, j]) for j, e in enumerate(exps)) / sum(exps)
            assert labels[row, t] == pytest.approx(z, rel=1e-4, abs=1e-5)


def test_a_label_depends_on_later_steps_of_its_segment_and_on_no_other_segment():
    data = filled()
    rbt = made(data)
    batch = whole(data)
    before = rbt.label(batch)
    actions = batch.actions.copy()
    actions[0, 6] -= 0.5  # the last step of the first segment
    after = rbt.label(replace(batch, actions=actions))
    assert (np.abs(after[0] - before[0]) > 1e-7).all()
    np.testing.assert_allclose(after[1:], before[1:], atol=1e-6)


def test_a_window_lets_labels_depend_on_the_steps_before_the_segment():
    data = filled()
    rbt = made(data, rbt__attention_scope='window')
    assert rbt.context == 7
    batch = whole(data, rbt.context)
    row = 1
    assert batch.context[row] == 7
    before = rbt.label(batch)
    assert not before[row, :7].any()
    actions = batch.actions.copy()
    actions[row, 0] -= 0.5
    after = rbt.label(replace(batch, actions=actions))
    inside = segment_steps(batch)[row]
    assert (np.abs(after[row] - before[row])[inside] > 1e-7).all()
    # ... by their attention too: that of a window without segments gives the same
    seen = (torch.from_numpy(batch.observations[row : row + 1, :-1]) - rbt._mean) / rbt._std
    everything = torch.ones(1, 14, dtype=torch.bool)
    with torch.inference_mode():
        z, _ = rbt.network(seen, torch.from_numpy(batch.actions[row : row + 1]), everything)
    np.testing.assert_allclose(before[row, 7:], z[0, 7:], rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(('scope', 'segments'), [('segment', 1), ('window', 3)])
def test_the_losses_are_those_of_each_segments_sum_and_next_observations_in_runs_of_segments(
    scope, segments
):
    data = filled()
    rbt = made(data, rbt__attention_scope=scope, codetr__window=21)
    ids = data.segments.ids()
    count = -(-settings().codetr.batch // segments)
    last = ids[generator(0, 'x').integers(0, len(ids), count)]
    mean, std = data.store.observation_moments()
    ((_, episodes, firsts, _),) = data.segments.spans(ids)
    scores = dict(zip(zip(episodes, firsts, strict=True), data.segments.scores(ids), strict=True))
    sums, states = [], []
    for number in last:  # one window at a time, cut from its episode's steps
        batch = data.segments.batch(np.array([number]), 1000)  # all steps before it
        begin = max(0, int(batch.context[0]) - (segments - 1) * 7)
        end = int(batch.lengths[0])
        observations = torch.tensor((batch.observations[0] - mean) / std, dtype=torch.float32)
        with torch.inference_mode():
            z, predicted = rbt.network.eval()(
                observations[None, begin:end],
                torch.from_numpy(batch.actions[None, 0, begin:end]),
                torch.ones(1, end - begin, dtype=torch.bool),
            )
        errors = predicted[0] - observations[begin + 1 : end + 1]
        states += errors.square().mean(1).tolist()
        (episode,) = episodes[ids == number]
        for first in range(begin, end, 7):
            found = float(z[0, first - begin : first - begin + 7].sum())
            sums.append((found - scores[episode, first] / data.segments.score_scale()) ** 2)
    said = rbt.gradient_step(data, generator(0, 'x'))
    assert said['reward_loss'] == pytest.approx(np.mean(sums), rel=1e-4)
    assert said['state_loss'] == pytest.approx(np.mean(states), rel=1e-4)


@pytest.mark.slow
def test_where_the_attention_sees_several_segments_credit_inside_them_is_found():
    data = memory()
    config = settings(
        delay=DELAY,
        rbt__attention_scope='window',
        codetr__window=3 * DELAY,
        codetr__batch=48,
        codetr__learning_rate=5e-3,
        codetr__initialisation='gpt2',
    )
    method = trained(Rbt(config, O, A), data, 300)
    found = recovery(method, memory(lengths=(64, 64), seed=1))
    assert found > 0.5


def test_the_next_observation_is_predicted_from_its_step_and_those_before_alone():
    torch.manual_seed(0)
    network = Rbt(settings(), O, A).network.eval()
    observations, actions = torch.randn(1, 7, O), torch.randn(1, 7, A)
    inside = torch.ones(1, 7, dtype=torch.bool)
    with torch.inference_mode():
        _, before = network(observations, actions, inside)
        for step in range(7):
            for field in (observations, actions):
                other = field.clone()
                other[0, step] += 1.0
                inputs = (other, actions) if field is observations else (observations, other)
                _, after = network(*inputs, inside)
                moved = (after - before).abs().amax(-1)[0] > 1e-5
                assert not moved[:step].any() and moved[step:].all()


def test_next_observations_far_from_those_of_the_warm_up_do_not_drown_the_rewards():
    data = filled()
    rbt = made(data)
    chunk = builders.transitions(
        sequence=3,
        episode=3,
        steps=7,
        observations=np.full((8, O), 1e5, np.float32),
        actions=np.zeros((7, A), np.float32),
        truncated=True,
    )
    data.append(chunk)
    data.score(builders.score(sequence=20, episode=3, length=7))
    losses = [rbt.gradient_step(data, generator(0, i))['state_loss'] for i in range(10)]
    assert 10 < max(losses) < 150  # an error of 10 deviations squared, and some


def test_the_weight_of_the_state_loss_is_what_the_settings_say():
    data = filled()
    plain, heavy, without = (
        made(data, steps=0, rbt__state_loss_weight=weight) for weight in (1.0, 3.0, 0.0)
    )
    said = [m.gradient_step(data, generator(0)) for m in (plain, heavy, without)]
    assert said[1]['state_loss'] == pytest.approx(3 * said[0]['state_loss'])
    assert said[2]['state_loss'] == 0
    assert len({s['reward_loss'] for s in said}) == 1
    head = [m.network.next_observation.weight.grad for m in (plain, heavy, without)]
    torch.testing.assert_close(head[1], 3 * head[0])
    assert not head[2].any()


def test_in_windows_a_step_gets_the_output_of_the_window_that_ends_with_it():
    data = filled()
    rbt = made(data, codetr__labelling='window', codetr__window=5)
    ids = data.segments.ids()[:2]  # the first 14 steps of the first episode
    found = np.concatenate(list(rbt.label_passes(data, ids)))
    batch = data.segments.batch(ids)
    for t in range(14):
        row, step = divmod(t, 7)
        first = max(0, step - 4)  # the window reaches into no other segment's attention ...
        if row == 1 and step < 4:
            continue  # ... but the causal states of these have seen it
        steps = slice(first, step + 1)
        piece = SegmentBatch(
            batch.observations[row : row + 1, first : step + 2],
            batch.actions[row : row + 1, steps],
            np.array([step + 1 - first]),
            np.array([0]),
            batch.values[row : row + 1],
        )
        assert found[t] == pytest.approx(rbt.label(piece)[0, -1], rel=1e-4, abs=1e-5)


@pytest.mark.slow
def test_sixty_four_segments_are_learnt_by_heart():
    data = noise(64)
    config = settings(
        delay=DELAY,
        codetr__initialisation='gpt2',
        codetr__learning_rate=1e-2,
        codetr__warmup_gradient_steps=20,
        codetr__batch=64,
        codetr__schedule='cosine',
        codetr__total_gradient_steps=250,
        rbt__state_loss_weight=0.1,
    )
    assert explained(trained(Rbt(config, O, A), data, 250), data) > 0.97


@pytest.mark.slow
def test_a_linear_sum_of_segments_is_predicted_on_unseen_episodes():
    config = settings(delay=DELAY, codetr__learning_rate=5e-3, codetr__initialisation='gpt2')
    data = memory()
    method = trained(Rbt(config, O, A), data, 300)
    assert explained(method, memory(lengths=(64, 64), seed=1)) > 0.9
