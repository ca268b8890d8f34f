"""LIRPG: its meta-gradient against finite differences, what it learns from, and that it learns."""

import math
from collections.abc import Iterator

import numpy as np
import pytest
import safetensors.torch
import torch
from torch import Tensor

from codetr_ros.config import SettingsError
from codetr_ros.cores import in_process
from codetr_ros.learners.base import LearnerError
from codetr_ros.learners.lirpg import Lirpg, PhaseBatch
from codetr_ros.memory.ring import Rollout
from codetr_ros.records import CompositeReward, EpisodeResult, Policy, StepRewards, Transitions
from helpers.builders import tiny

torch.set_num_threads(1)

OBS, ACT, T = 2, 1, 8
LAST = np.array([False, False, False, True, False, False, False, True])
MINIBATCH = torch.tensor([5, 0, 3, 2, 6])  # normalised advantages of two steps are always +-1


@pytest.fixture
def double() -> Iterator[None]:
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


def learner(**changes) -> Lirpg:
    settings = tiny(
        method='lirpg',
        lirpg__hidden=(4, 3),
        lirpg__learning_rate=2e-2,
        lirpg__reward_learning_rate=3e-2,
        lirpg__discount=0.9,
        lirpg__trace_decay=0.8,
        lirpg__extrinsic_coefficient=0.3,
        lirpg__intrinsic_coefficient=0.7,
        **changes,
    )
    made = Lirpg(settings, OBS, ACT)
    torch.manual_seed(5)
    with torch.no_grad():
        for parameter in (*made.theta, *made.eta):
            parameter.add_(0.3 * torch.randn_like(parameter))
    return made


def rollout(seed: int = 0) -> Rollout:
    rng = np.random.default_rng(seed)
    rewards = np.where(np.arange(T) % 2, rng.normal(size=T), 0.0)
    return Rollout(
        rng.standard_normal((T, OBS)),
        rng.uniform(-0.9, 0.9, (T, ACT)),
        rewards,
        rng.standard_normal((T, OBS)),
        np.arange(T) == 3,
        LAST,
    )


def log_prob(lirpg: Lirpg, policy: list[Tensor], batch: PhaseBatch, t: int) -> Tensor:
    """Of step t under a policy given by its parameters, by the book."""
    log_std, *layers = policy
    x = batch.observations[t]
    for i in range(0, len(layers) - 2, 2):
        x = torch.tanh(layers[i] @ x + layers[i + 1])
    mean = layers[-2] @ x + layers[-1]
    return torch.distributions.Normal(mean, log_std.exp()).log_prob(batch.squashed[t]).sum()


def ppo(lirpg: Lirpg, policy: list[Tensor], batch: PhaseBatch, advantages: np.ndarray) -> Tensor:
    """PPO's loss over the minibatch, step by step."""
    advantages = (advantages - advantages.mean()) / advantages.std()
    terms = []
    for t, advantage in zip(MINIBATCH.tolist(), advantages, strict=True):
        ratio = (log_prob(lirpg, policy, batch, t) - batch.log_probs[t]).exp()
        terms.append(-torch.min(advantage * ratio, advantage * ratio.clamp(0.8, 1.2)))
    return torch.stack(terms).mean()


def advantages(delta: np.ndarray) -> np.ndarray:
    """GAE's backward recursion, gamma lambda = 0.72."""
    found = np.zeros(T)
    for t in reversed(range(T)):
        found[t] = delta[t] + (0 if LAST[t] else 0.72 * found[t + 1])
    return found[MINIBATCH.numpy()]


class Inner:
    """theta' as a function of eta, restated: the second moment as it is for the eta at hand."""

    def __init__(self, lirpg: Lirpg, batch: PhaseBatch) -> None:
        self.lirpg, self.batch = lirpg, batch
        self.state = lirpg.state()
        self.squares: list[Tensor] | None = None

    def gradients(self) -> list[Tensor]:
        lirpg, batch = self.lirpg, self.batch
        both = torch.cat([batch.observations, batch.actions], 1)
        intrinsic = lirpg.intrinsic_reward(both)[:, 0].tanh()
        mixed = 0.7 * intrinsic + 0.3 * batch.rewards
        delta = (mixed + batch.following - batch.values).detach().numpy()
        found = advantages(delta)
        loss = ppo(lirpg, list(lirpg.actor.parameters()), batch, found)
        targets = torch.from_numpy(found) + batch.values[MINIBATCH]
        value = lirpg.value(batch.observations[MINIBATCH])[:, 0]
        loss = loss + 0.5 * 0.5 * (value - targets).square().mean()
        gradients = torch.autograd.grad(loss, lirpg.theta)
        norm = math.sqrt(sum(float(g.square().sum()) for g in gradients))
        return [g * min(1.0, 0.5 / norm) for g in gradients]

    def theta(self) -> list[Tensor]:
        gradients, found = self.gradients(), []
        old = [self.state[f'theta_adam.squares.{i}'] for i in range(len(gradients))]
        if self.squares is None:
            pairs = zip(old, gradients, strict=True)
            self.squares = [0.999 * v + 0.001 * g**2 for v, g in pairs]
        n = int(self.state['theta_adam.steps']) + 1
        for i, (p, g) in enumerate(zip(self.lirpg.theta, gradients, strict=True)):
            m = 0.9 * self.state[f'theta_adam.means.{i}'] + 0.1 * g
            root = (self.squares[i] / (1 - 0.999**n)).sqrt()
            found.append(p.detach() - 2e-2 * m / (1 - 0.9**n) / (root + 1e-5))
        return found

    def objective(self) -> float:
        """The outer policy loss of theta'."""
        policy = self.theta()[: len(list(self.lirpg.actor.parameters()))]
        found = self.batch.advantages[MINIBATCH].numpy()
        return float(ppo(self.lirpg, policy, self.batch, found))


def test_the_meta_gradient_is_that_of_finite_differences(double: None) -> None:
    lirpg = learner()
    batch = lirpg.prepare(rollout())
    lirpg.update(batch, MINIBATCH)  # so that Adam has moments and the ratios are not all 1
    parameters = list(lirpg.intrinsic_reward.parameters())
    inner = Inner(lirpg, batch)

    gradients = lirpg.policy_gradients(batch, MINIBATCH)
    expected = inner.gradients()
    for mine, books in zip(gradients, expected, strict=True):
        torch.testing.assert_close(mine.detach(), books)
    step = lirpg._theta_adam.propose(gradients)
    loss, _ = lirpg.outer_losses(step.values, batch, MINIBATCH)
    assert float(loss.detach()) == pytest.approx(inner.objective())
    meta = torch.autograd.grad(loss, parameters)
    assert max(float(g.abs().max()) for g in meta) > 1e-4

    for parameter, gradient in zip(parameters, meta, strict=True):
        flat, slopes = parameter.data.view(-1), gradient.reshape(-1)
        for i in range(len(flat)):
            kept, difference = float(flat[i]), []
            for sign in (1, -1):
                flat[i] = kept + sign * 1e-5
                difference.append(inner.objective())
            flat[i] = kept
            slope = (difference[0] - difference[1]) / 2e-5
            assert float(slopes[i]) == pytest.approx(slope, rel=1e-4, abs=1e-8)


def test_the_phase_is_prepared_as_its_steps_were_taken(double: None) -> None:
    lirpg, steps = learner(), rollout()
    with torch.no_grad():
        lirpg.actor.observation_mean.copy_(torch.tensor([0.5, -0.5]))
        lirpg.actor.observation_deviation.copy_(torch.tensor([2.0, 0.05]))
    batch = lirpg.prepare(steps)
    x = np.clip((steps.observations - [0.5, -0.5]) / [2.0, 0.05], -10, 10)
    assert np.abs(x).max() == 10
    np.testing.assert_allclose(batch.observations.numpy(), x)
    np.testing.assert_allclose(batch.squashed.tanh().numpy(), steps.actions)
    policy = list(lirpg.actor.parameters())
    for t in range(T):
        assert float(batch.log_probs[t]) == pytest.approx(
            float(log_prob(lirpg, policy, batch, t).detach())
        )
    assert batch.following[3] == 0 and (batch.following[[0, 7]] != 0).all()
    running = np.zeros(T)
    for t in range(T):
        running[t] = steps.rewards[t] + (0 if t in (0, 4) else 0.9 * running[t - 1])
    scale = math.sqrt(running.var() + 1e-8)
    np.testing.assert_allclose(batch.rewards.numpy(), steps.rewards / scale)
    value = lirpg.extrinsic_value(batch.observations)[:, 0].detach().numpy()
    x2 = np.clip((steps.next_observations - [0.5, -0.5]) / [2.0, 0.05], -10, 10)
    following = lirpg.extrinsic_value(torch.from_numpy(x2))[:, 0].detach().numpy()
    delta = batch.rewards.numpy() + 0.9 * following * (np.arange(T) != 3) - value
    np.testing.assert_allclose(batch.advantages[MINIBATCH].numpy(), advantages(delta), rtol=1e-6)


def test_an_action_at_the_edge_of_the_box_does_not_become_infinite() -> None:
    lirpg, steps = learner(), rollout()
    steps.actions[0] = 1.0
    batch = lirpg.prepare(steps)
    assert batch.squashed.isfinite().all() and batch.log_probs.isfinite().all()


def test_a_learner_goes_on_from_its_state_as_if_nothing_had_been() -> None:
    one, other = learner(), learner(seed=9)
    one.update(one.prepare(rollout(0)), MINIBATCH)
    other.load_state(one.state())
    for lirpg in (one, other):
        lirpg.update(lirpg.prepare(rollout(1)), MINIBATCH)
    before, after = one.state(), other.state()
    assert before.keys() == after.keys()
    assert all(torch.equal(before[name], after[name]) for name in before)


def test_a_state_of_other_settings_is_refused_and_changes_nothing() -> None:
    lirpg = learner()
    before = lirpg.state()
    wrong = lirpg.state() | {'value.0.weight': torch.zeros(9, 9)}
    with pytest.raises(LearnerError, match=r"'lirpg' refused: value.0.weight is \(9, 9\)"):
        lirpg.load_state(wrong)
    assert all(torch.equal(tensor, before[name]) for name, tensor in lirpg.state().items())


def test_a_last_phase_of_a_single_step_does_not_spoil_what_was_learnt() -> None:
    records: list = []
    changes = {'steps': 201, 'phase_steps': 100, 'warmup_steps': 100, 'evaluate_every': 0}
    in_process.run(tiny(method='lirpg', **changes), 'run', observe=records.append)
    last = [record for record in records if isinstance(record, Policy)][-1]
    weights = safetensors.torch.load(last.weights)
    assert last.version == 2
    assert all(tensor.isfinite().all() for tensor in weights.values())


def test_it_is_refused_with_overlap() -> None:
    with pytest.raises(SettingsError, match='overlap=True with method=lirpg: it learns on-policy'):
        tiny(method='lirpg', overlap=True)


@pytest.fixture(scope='module')
def seen() -> list:
    records: list = []
    in_process.run(tiny(method='lirpg', simulators=2), 'run', observe=records.append)
    return records


def test_a_run_takes_scores_labels_nothing_and_lets_each_phase_change_the_policy(
    seen: list,
) -> None:
    kinds = {type(record) for record in seen}
    assert CompositeReward in kinds and StepRewards not in kinds
    weights = [record.weights for record in seen if isinstance(record, Policy)]
    assert weights[:2] == [b'', b''] and len(set(weights[2:])) == 5
    assert sum(isinstance(r, EpisodeResult) and r.purpose == 'evaluation' for r in seen) == 6


def test_policies_carry_the_moments_of_all_observations_before_them(seen: list) -> None:
    for policy in (r for r in seen if isinstance(r, Policy) and not r.random):
        rows = np.concatenate(
            [
                r.observations[:-1].astype(np.float64)
                for r in seen
                if isinstance(r, Transitions) and r.phase < policy.phase
            ]
        )
        tensors = safetensors.torch.load(policy.weights)
        mean = tensors['observation_mean'].numpy()
        np.testing.assert_allclose(mean, rows.mean(0), rtol=1e-4, atol=1e-6)
        deviation = tensors['observation_deviation'].numpy()
        np.testing.assert_allclose(deviation, np.sqrt(rows.var(0) + 1e-8), rtol=1e-4)
