"""The recurrent multiple-instance model: rewards that know the steps before, in three spaces."""

from typing import Any

import numpy as np
import pytest

from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.rewards.base import segment_steps
from codetr_ros.rewards.learned import Learned
from codetr_ros.rewards.mil_lstm import MilLstm
from codetr_ros.rewards.mlp import Mlp
from codetr_ros.seeding import generator
from helpers import builders
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O
from helpers.linear_rewards import DELAY, explained, memory, noise, recovery, trained

SPACES = ('csc', 'instance', 'embedding')


def settings(**changes: Any):
    return builders.tiny(**{'method': 'mil_lstm', 'delay': DELAY} | changes)


def restated(made: MilLstm, steps: np.ndarray, space: str) -> np.ndarray:
    """Rewards of a segment's steps (m, D): the equations of an LSTM, step by step in numpy."""
    weights = {n: p.detach().double().numpy() for n, p in made.network.named_parameters()}
    names = ('weight_ih', 'weight_hh', 'bias_ih', 'bias_hh')
    into, back, ahead, over = (weights[f'recurrent.{name}_l0'] for name in names)

    def layers(x: np.ndarray, part: str) -> np.ndarray:
        numbers = sorted({int(n.split('.')[1]) for n in weights if n.startswith(part)})
        for number in numbers:
            x = weights[f'{part}.{number}.weight'] @ x + weights[f'{part}.{number}.bias']
            if part == 'encoder' or number != numbers[-1]:
                x = np.maximum(x, 0)
        return x

    def sigmoid(x: np.ndarray) -> np.ndarray:
        return 1 / (1 + np.exp(-x))

    hidden, cell = weights['first_hidden'][0, 0], weights['first_cell'][0, 0]
    values = []
    for step in steps:
        embedded = layers(step, 'encoder')
        enter, keep, new, leave = np.split(into @ embedded + ahead + back @ hidden + over, 4)
        cell = sigmoid(keep) * cell + sigmoid(enter) * np.tanh(new)
        hidden = sigmoid(leave) * np.tanh(cell)
        read = np.append(embedded, hidden) if space == 'csc' else hidden
        values.append(float(layers(read, 'head')[0]))
    return np.diff(values, prepend=0.0) if space == 'embedding' else np.array(values)


@pytest.mark.parametrize('space', SPACES)
def test_rewards_and_loss_are_those_of_the_equations_step_by_step(space):
    data = memory((20, 11, 3))  # three segments are short
    config = settings(mil_lstm__space=space, mil_lstm__dropout=0.0)
    made = trained(MilLstm(config, O, A), data, 5)
    assert made.network.first_cell.abs().max() > 0  # learnt too
    batch = data.segments.sample(generator(0, 'x'), config.mil_lstm.batch)
    observations = made._standardised(batch.observations[:, :-1]).numpy()
    steps = np.concatenate([observations, batch.actions], -1).astype(np.float64)
    labels, sums = made.label(batch), []
    for i, m in enumerate(batch.lengths.tolist()):
        expected = restated(made, steps[i, :m], space)
        np.testing.assert_allclose(labels[i, :m], expected, rtol=1e-4, atol=1e-5)
        sums.append(expected.sum())
    error = np.array(sums) - batch.values / data.segments.score_scale()
    stated = made.gradient_step(data, generator(0, 'x'))
    assert stated['reward_loss'] == pytest.approx(np.mean(error**2), rel=1e-4)


@pytest.mark.parametrize('space', SPACES)
def test_a_label_depends_on_the_steps_up_to_its_own_and_on_no_other_segment(space):
    data = memory(lengths=(64,))
    made = trained(MilLstm(settings(mil_lstm__space=space), O, A), data, 3)
    batch = data.segments.batch(data.segments.ids())
    before = made.label(batch)
    batch.actions[2, 3] += 0.5
    changed = np.argwhere(made.label(batch) != before)
    assert set(changed[:, 0]) == {2} and set(changed[:, 1]) == set(range(3, DELAY))
    assert segment_steps(batch).all()


def test_in_the_space_of_embeddings_labels_sum_to_what_the_last_state_is_worth():
    data = memory((20, 11, 3))
    spaces = {}
    for space in ('embedding', 'instance'):  # with the same weights
        spaces[space] = MilLstm(settings(mil_lstm__space=space), O, A)
        spaces[space].prepare(data)
    batch = data.segments.batch(data.segments.ids())
    values, labels = (spaces[space].label(batch) for space in ('instance', 'embedding'))
    last = values[np.arange(len(values)), batch.lengths - 1]
    np.testing.assert_allclose(labels.sum(1), last, rtol=1e-4, atol=1e-6)


def toggled(seed: int, episodes: int) -> tuple[Trajectories, np.ndarray]:
    """Segments whose first step decides whether the other steps are worth anything."""
    rng = np.random.default_rng(seed)
    found, true = Trajectories(O, A, DELAY, 10_000, 1000), []
    for episode in range(episodes):
        actions = rng.uniform(-1, 1, (DELAY, A)).astype(np.float32)
        rewards = (actions[0, 1] > 0) * (1 + actions[:, 0]) * (np.arange(DELAY) > 0)
        observations = rng.normal(size=(DELAY + 1, O)).astype(np.float32)
        chunk = builders.transitions(
            steps=DELAY,
            sequence=episode,
            episode=episode,
            observations=observations,
            actions=actions,
            truncated=True,
        )
        found.append(chunk)
        found.score(builders.score(episode=episode, length=DELAY, value=float(rewards.sum())))
        true.append(rewards)
    return found, np.array(true)


@pytest.mark.slow
def test_what_an_earlier_step_decided_is_found_and_no_reward_of_single_steps_finds_it():
    data, _ = toggled(0, 800)
    unseen, true = toggled(1, 50)
    batch = unseen.segments.batch(unseen.segments.ids())
    common = {'batch': 64, 'learning_rate': 1e-2, 'hidden': (32, 32)}

    def agreement(made: Learned) -> float:
        labels = trained(made, data, 800).label(batch)
        return float(np.corrcoef(labels.ravel(), true.ravel())[0, 1])

    ours = common | {'dropout': 0.0, 'width': 8, 'head': (32,)}
    recurrent = MilLstm(settings(**{f'mil_lstm__{n}': v for n, v in ours.items()}), O, A)
    single = Mlp(settings(method='mlp', **{f'mlp__{n}': v for n, v in common.items()}), O, A)
    found = agreement(recurrent), agreement(single)
    assert found[0] > 0.8 and found[1] < 0.4


@pytest.mark.slow
def test_a_linear_step_reward_is_found_again_on_unseen_episodes():
    config = settings(
        mil_lstm__batch=32,
        mil_lstm__learning_rate=1e-2,
        mil_lstm__hidden=(32, 32),
        mil_lstm__head=(32,),
        mil_lstm__dropout=0.0,
    )
    made = trained(MilLstm(config, O, A), memory(), 400)
    unseen = memory(lengths=(64, 64), seed=1)
    assert recovery(made, unseen) > 0.95
    assert explained(made, unseen) > 0.95


def test_sixty_four_segments_are_learnt_by_heart():
    data = noise(64)
    config = settings(
        mil_lstm__batch=64,
        mil_lstm__learning_rate=1e-2,
        mil_lstm__hidden=(64, 64),
        mil_lstm__head=(64,),
        mil_lstm__dropout=0.0,
    )
    assert explained(trained(MilLstm(config, O, A), data, 300), data) > 0.97
