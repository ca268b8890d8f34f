"""CoDeTr on what single steps leave of scores: better where that is something, no worse else."""

import numpy as np
import pytest
import torch

from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F64
from codetr_ros.rewards import registry
from codetr_ros.rewards.base import RewardMethod
from codetr_ros.rewards.residual import CodetrOnEvidence, gate, held_out
from codetr_ros.runs.recovery_metrics import r_squared
from codetr_ros.seeding import generator, seed_torch
from codetr_ros.simulation.composite import composite
from helpers import builders, planted
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O

pytestmark = pytest.mark.usefixtures('one_thread')

DELAY = 10


def after_a_push(s: F64, a: F64, after: F64) -> F64:
    """A push is worth something only if the action before it pushed too."""
    pushed = a > 0
    reward: F64 = 2.0 * np.append(0.0, pushed[:-1, 0]) * pushed[:, 1]
    return reward


def made(base: str, data: Trajectories, steps: int, **changes: object) -> RewardMethod:
    own = {'embedding': 32, 'dropout': 0.0, 'learning_rate': 3e-3, 'batch': 32, 'base': base}
    settings = builders.tiny(
        delay=DELAY, **{f'codetr__{name}': value for name, value in own.items()}, **changes
    )
    method = registry.make(settings, O, A)
    method.prepare(data)
    for step in range(steps):
        seed_torch(0, step)
        method.gradient_step(data, generator(0, step))
    return method


def explained(method: RewardMethod, data: Trajectories) -> float:
    batch = data.segments.batch(data.segments.ids(), method.context)
    return r_squared(method.predict(batch), batch.values)


@pytest.mark.slow
def test_a_reward_that_depends_on_the_step_before_is_found_above_the_regression():
    data = planted.memory(after_a_push, lambda r: float(r.sum()), DELAY, segments=1000)
    unseen = planted.memory(after_a_push, lambda r: float(r.sum()), DELAY, seed=1)
    alone = made('none', data, 0, method='evidence')
    above = made('evidence', data, 1200)
    assert explained(above, unseen) > explained(alone, unseen) + 0.05
    assert planted.within(above, unseen) > planted.within(alone, unseen) + 0.07


@pytest.mark.slow
def test_a_verdict_of_peak_and_end_that_nobody_named_is_predicted_better():
    """The regression takes it for a sum."""

    def verdict(r: F64) -> float:
        return float(composite('peak_end', r, 3.0, DELAY))

    data = planted.memory(planted.progress, verdict, DELAY, segments=1000)
    unseen = planted.memory(planted.progress, verdict, DELAY, seed=1)
    alone = made('none', data, 0, method='evidence')
    above = made('evidence', data, 400)
    assert explained(above, unseen) > explained(alone, unseen) + 0.15


@pytest.mark.slow
@pytest.mark.parametrize('kind', ['sum', 'max'])
@pytest.mark.parametrize('noise', [0.0, 0.5])
def test_where_single_steps_explain_the_scores_nothing_is_lost(kind, noise):
    def score(r: F64) -> float:
        return float(composite(kind, r, 3.0, DELAY))

    data = planted.memory(planted.progress, score, DELAY, noise=noise)
    unseen = planted.memory(planted.progress, score, DELAY, seed=1, noise=noise)
    alone = made('none', data, 0, method='evidence', composite=kind)
    above = made('evidence', data, 200, composite=kind)
    assert explained(above, unseen) > explained(alone, unseen) - 0.01
    assert planted.within(above, unseen) > planted.within(alone, unseen) - 0.01


@pytest.mark.parametrize('kind', ['sum', 'max', 'sum_square', 'peak_end'])
def test_before_anything_is_learnt_labels_are_those_of_the_regression(kind):
    data = planted.memory(
        planted.progress, lambda r: float(composite(kind, r, 3.0, DELAY)), DELAY, segments=60
    )
    alone = made('none', data, 0, method='evidence', composite=kind)
    above = made('evidence', data, 0, composite=kind)
    batch = data.segments.batch(data.segments.ids())
    assert above.label(batch).tobytes() == alone.label(batch).tobytes()
    np.testing.assert_array_equal(above.predict(batch), alone.predict(batch))


@pytest.mark.parametrize('kind', ['sum', 'max', 'peak_end'])
def test_the_gradient_is_that_of_the_squared_error_of_levels(kind):
    """By finite differences of the loss in the weights of the head."""
    data = planted.memory(
        planted.progress, lambda r: float(composite(kind, r, 3.0, DELAY)), DELAY, segments=60
    )
    method = made('evidence', data, 20, composite=kind)
    weight = method.network.reward.weight

    def loss() -> torch.Tensor:
        terms = list(method._terms(data, generator(7)))
        return torch.stack([term['reward_loss'] for term in terms]).sum()

    method.network.zero_grad()
    loss().backward()
    found, step = weight.grad.clone(), 3e-3
    assert found.abs().max() > 0
    for column in (0, 5, 9):
        values = []
        for sign in (1, -1):
            with torch.no_grad():
                weight[0, column] += sign * step
                values.append(float(loss()))
                weight[0, column] -= sign * step
        due = (values[0] - values[1]) / (2 * step)
        assert float(found[0, column]) == pytest.approx(due, rel=0.03, abs=2e-4)


def test_labels_explain_their_scores_and_have_as_much_of_the_network_as_the_gate_lets_in():
    data = planted.memory(after_a_push, lambda r: float(r.sum()), DELAY, segments=60)
    method = made('evidence', data, 5, reward_unit='raw')
    batch = data.segments.batch(data.segments.ids())
    closed = method.label(batch)
    method._gate = 0.5
    w, rhat = method.components(batch)
    added = 0.5 * w * rhat * method._base.model.scale
    added -= added.mean(1, keepdims=True)
    np.testing.assert_allclose(method.label(batch), closed + added, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(method.label(batch).sum(1), batch.values, rtol=1e-4, atol=1e-4)


def test_a_fifth_of_the_scores_has_no_part_in_what_the_network_learns():
    data = planted.memory(planted.progress, lambda r: float(r.sum()), DELAY, segments=300)
    method = made('evidence', data, 0)
    ids = data.segments.ids()
    held = held_out(ids)
    assert 0.15 < held.mean() < 0.25
    drawn = []
    whole = data.segments.batch

    def batch(some, context=0):
        drawn.append(some)
        return whole(some, context)

    data.segments.batch = batch
    method.gradient_step(data, generator(0))
    assert len(drawn) == 1 and not np.isin(drawn[0], ids[held]).any()


def test_the_gate_opens_by_what_held_out_scores_ask_for_and_seldom_for_noise():
    rng = np.random.default_rng(0)
    opened = []
    for _ in range(2000):
        found, noise = rng.normal(size=(2, 40))
        opened.append(gate(noise, found)[0])
        assert gate(-found, found) == (0.0, 0.0)
    assert np.mean(np.array(opened) > 0) < 0.04  # two standard errors, on one side
    found, noise = rng.normal(size=(2, 4000))
    assert gate(0.5 * found + 0.1 * noise, found)[0] == pytest.approx(0.5, abs=0.01)
    assert gate(found, found) == (1.0, 1.0) == gate(3 * found, 3 * found)
    assert gate(3 * found, found)[0] == 1.0  # it never makes more of what was found
    assert gate(np.empty(0), np.empty(0)) == gate(found, 0 * found) == (0.0, 0.0)


def test_verdicts_on_a_scale_of_which_only_the_order_means_anything_are_explained_too():
    """The level of a verdict is what the regression expects of it."""
    cuts = np.array([-0.6, 0.0, 0.6])
    data = planted.memory(
        planted.progress, lambda r: float(np.searchsorted(cuts, r.mean())), DELAY, segments=100
    )
    changes = {'evidence__score_scale': 'ordinal'}
    alone = made('none', data, 0, method='evidence', **changes)
    above = made('evidence', data, 10, **changes)
    batch = data.segments.batch(data.segments.ids())
    assert above._gate == 0 and np.isfinite(above.gradient_step(data, generator(0))['reward_loss'])
    assert above.label(batch).tobytes() == alone.label(batch).tobytes()


def test_the_registry_makes_it_of_the_setting():
    assert registry.kind(builders.tiny(codetr__base='evidence')) is CodetrOnEvidence
