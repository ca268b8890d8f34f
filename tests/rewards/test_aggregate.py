"""The learnt aggregator: what it can express without error, and what it finds."""

import math

import numpy as np
import pytest
import torch

from codetr_ros.records import F64
from codetr_ros.rewards.aggregate import Aggregate, Worth
from codetr_ros.runs.recovery_metrics import r_squared
from codetr_ros.simulation.composite import composite
from helpers import builders, planted
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O
from helpers.linear_rewards import memory, trained

pytestmark = pytest.mark.usefixtures('one_thread')

N = 40
SHARP = 1e4


def worth(readout: list[float], sharpness: float = 3.0) -> Worth:
    made = Worth(O + A, (4,), N).double()
    with torch.no_grad():
        made.readout.copy_(torch.tensor(readout, dtype=torch.float64))
        made.sharpness.fill_(sharpness)
    return made


def same(r: F64) -> F64:
    return np.stack([r, r, r], -1)


def of_squares(r: F64) -> F64:
    return np.stack([np.abs(r) * r, r, r], -1)


def mean(r: F64) -> float:
    return float(r.mean())


KINDS = {
    'sum': (same, [1, 0, 0, 0, 0], 3.0),
    'sum_square': (of_squares, [1, 0, 0, 0, 0], 3.0),
    'square_sum': (same, [0, N, 0, 0, 0], 3.0),
    'mean': (same, [0, 0, 1 / N, 0, 0], 3.0),
    'max': (same, [0, 0, 0, 1 / N, 0], 3.0),
    'max_times_n': (same, [0, 0, 0, 1, 0], 3.0),
    'max_hard': (same, [0, 0, 0, 1 / N, 0], SHARP),
    'minimum': (same, [0, 0, 0, 1 / N, 0], -3.0),
    'peak_end': (same, [0, 0, 0, 0.5 / N, 0.5 / N], SHARP),
}


@pytest.mark.parametrize('kind', KINDS)
def test_three_numbers_express_every_kind_of_score_at_every_step(kind):
    outputs, readout, sharpness = KINDS[kind]
    made = worth(readout, sharpness)
    rewards = np.random.default_rng(0).normal(size=(3, N))
    with torch.no_grad():
        found = made.worth(torch.tensor(outputs(rewards))).numpy()
    for row, each in zip(found, rewards, strict=True):
        due = [
            mean(each[:t]) if kind == 'mean' else composite(kind, each[:t], 3.0, N)
            for t in range(1, N + 1)
        ]
        np.testing.assert_allclose(row, due, rtol=1e-9, atol=1e-9)


def test_the_numbers_are_those_of_a_recursion_step_by_step_however_long():
    rng = np.random.default_rng(1)
    r = rng.normal(size=(1000, 3)) * [1, 20, 1]
    made = worth([1, 0, 0, 0, 0], 2.0)
    with torch.no_grad():
        found = made.states(torch.tensor(r)[None])[0].numpy()
    added, most, log_weight = 0.0, 0.0, -math.inf
    for t in range(1000):
        added += r[t, 0]
        heavier = float(np.logaddexp(log_weight, 2.0 * r[t, 1]))
        most += math.exp(2.0 * r[t, 1] - heavier) * (r[t, 1] - most)
        log_weight = heavier
        np.testing.assert_allclose(found[t], [added, most, r[t, 2]], rtol=1e-8, atol=1e-8)


def test_a_label_depends_on_the_steps_up_to_its_own_and_on_no_other_segment():
    data = memory(lengths=(64,))
    made = trained(Aggregate(builders.tiny(method='aggregate', delay=8), O, A), data, 3)
    batch = data.segments.batch(data.segments.ids())
    before = made.label(batch)
    batch.actions[2, 3] += 0.5
    changed = np.argwhere(~np.isclose(made.label(batch), before, rtol=1e-5, atol=1e-7))
    assert set(changed[:, 0]) == {2} and set(changed[:, 1]) == set(range(3, 8))


@pytest.mark.parametrize('changes', [{}, {'reward_unit': 'raw'}])
def test_labels_sum_to_the_predicted_scores(changes):
    data = memory((20, 11, 3))
    settings = builders.tiny(method='aggregate', delay=8, **changes)
    made = trained(Aggregate(settings, O, A), data, 5)
    batch = data.segments.batch(data.segments.ids())
    sums = made.label(batch).sum(1, dtype=np.float64) * made.unit
    np.testing.assert_allclose(sums, made.predict(batch), rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize('kind', ['sum', 'max', 'minimum', 'peak_end'])
def test_scores_of_each_kind_are_learnt_from_scores_alone(kind):
    def score(r: F64) -> float:
        return float(composite(kind, r, 3.0, 10))

    data = planted.memory(planted.progress, score, segments=800)
    unseen = planted.memory(planted.progress, score, seed=1)
    settings = builders.tiny(
        method='aggregate',
        delay=10,
        aggregate__hidden=(64, 64),
        aggregate__learning_rate=3e-3,
        aggregate__batch=64,
    )
    made = trained(Aggregate(settings, O, A), data, 800)
    batch = unseen.segments.batch(unseen.segments.ids())
    assert r_squared(made.predict(batch), batch.values) > 0.95
