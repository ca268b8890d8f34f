"""The policy learner, held against a plain re-statement of the textbook and known values."""

from dataclasses import asdict

import numpy as np
import pytest
import safetensors.torch
import torch
from torch import nn

from codetr_ros.config import SacSettings
from codetr_ros.learners.sac import SAC, SacError, q_values, squashed_gaussian
from codetr_ros.memory.batches import StepBatch
from helpers.tensors import crooked, same

torch.set_num_threads(1)  # a second thread is slower at these sizes


OBS, ACT, B = 5, 3, 32


SETTINGS = SacSettings(
    hidden=(24, 16),
    batch=B,
    actor_learning_rate=3e-3,  # each another, so that none can stand for another
    critic_learning_rate=5e-3,
    temperature_learning_rate=7e-3,
    discount=0.9,
    tau=0.05,
    initial_temperature=0.5,
    target_entropy=-0.5,
)


def make_batch(seed: int, dtype: type = np.float32) -> StepBatch:
    rng = np.random.default_rng(seed)
    return StepBatch(
        observations=rng.standard_normal((B, OBS)).astype(dtype),
        actions=rng.uniform(-1, 1, (B, ACT)).astype(dtype),
        rewards=rng.standard_normal(B).astype(dtype),
        next_observations=rng.standard_normal((B, OBS)).astype(dtype),
        terminated=rng.random(B) < 0.3,
    )


def update(sac: SAC, index: int, dtype: type = np.float32) -> dict[str, torch.Tensor]:
    torch.manual_seed(1000 + index)
    return sac.update(make_batch(index, dtype))


class Plain:
    """The same algorithm by the book: a network for each critic, torch's optimiser, no tricks."""

    def __init__(self, sac: SAC) -> None:
        state = sac.state()
        self.policy = nn.ModuleList(
            [nn.Linear(OBS, 24), nn.Linear(24, 16), nn.Linear(16, 2 * ACT)]
        )
        for i, name in enumerate(('body.0', 'body.2', 'heads')):
            self.policy[i].weight.data = state[f'actor.{name}.weight']
            self.policy[i].bias.data = state[f'actor.{name}.bias']
        self.critics = [self.critic(state, 'critic', i) for i in (0, 1)]
        self.targets = [self.critic(state, 'target', i) for i in (0, 1)]
        self.log_alpha = state['log_temperature'].requires_grad_()
        both = [p for critic in self.critics for p in critic.parameters()]
        self.critic_adam = torch.optim.Adam(both, lr=5e-3)
        self.actor_adam = torch.optim.Adam(self.policy.parameters(), lr=3e-3)
        self.alpha_adam = torch.optim.Adam([self.log_alpha], lr=7e-3)

    @staticmethod
    def critic(state: dict[str, torch.Tensor], name: str, index: int) -> nn.Sequential:
        layers = [nn.Linear(OBS + ACT, 24), nn.Linear(24, 16), nn.Linear(16, 1)]
        for i, layer in enumerate(layers):
            layer.weight.data = state[f'{name}.{2 * i}'][index].T.clone()
            layer.bias.data = state[f'{name}.{2 * i + 1}'][index, 0].clone()
        return nn.Sequential(layers[0], nn.ReLU(), layers[1], nn.ReLU(), layers[2])

    def act(self, s: torch.Tensor, noise: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        x = self.policy[1](self.policy[0](s).relu()).relu()
        out = self.policy[2](x)
        normal = torch.distributions.Normal(out[:, :ACT], out[:, ACT:].clamp(-10, 2).exp())
        u = normal.mean + normal.stddev * noise
        a = torch.tanh(u)
        return a, (normal.log_prob(u) - torch.log(1 - a**2)).sum(1)

    def update(self, index: int) -> dict[str, torch.Tensor]:
        batch = make_batch(index, np.float64)
        s, a, r, s2 = map(
            torch.from_numpy,
            (batch.observations, batch.actions, batch.rewards, batch.next_observations),
        )
        torch.manual_seed(1000 + index)
        noises = torch.randn(2, B, ACT)
        alpha = self.log_alpha.exp().item()
        with torch.no_grad():
            a2, log_prob2 = self.act(s2, noises[0])
            q2 = [critic(torch.hstack([s2, a2]))[:, 0] for critic in self.targets]
            y = r.clone()
            for i in range(B):
                if not batch.terminated[i]:
                    y[i] += 0.9 * (min(q2[0][i], q2[1][i]) - alpha * log_prob2[i])
        q = [critic(torch.hstack([s, a]))[:, 0] for critic in self.critics]
        critic_loss = ((q[0] - y) ** 2 + (q[1] - y) ** 2).mean()
        self.critic_adam.zero_grad()
        critic_loss.backward()
        self.critic_adam.step()
        for critic, target in zip(self.critics, self.targets, strict=True):
            for p, t in zip(critic.parameters(), target.parameters(), strict=True):
                t.data = 0.05 * p.data + 0.95 * t.data
        a_pi, log_prob = self.act(s, noises[1])
        q_pi = [critic(torch.hstack([s, a_pi]))[:, 0] for critic in self.critics]
        actor_loss = (alpha * log_prob - torch.min(q_pi[0], q_pi[1])).mean()
        self.actor_adam.zero_grad()
        actor_loss.backward()
        self.actor_adam.step()
        entropy = -log_prob.mean().detach()
        alpha_loss = self.log_alpha.exp() * (entropy - (-0.5 * ACT))
        self.alpha_adam.zero_grad()
        alpha_loss.backward()
        self.alpha_adam.step()
        return {
            'critic_loss': critic_loss.detach(),
            'actor_loss': actor_loss.detach(),
            'temperature': torch.tensor(alpha),
            'entropy': entropy,
            'q_mean': (q[0].mean() + q[1].mean()).detach() / 2,
        }

    def state(self) -> dict[str, torch.Tensor]:
        state = {'log_temperature': self.log_alpha.detach()}
        for i, name in enumerate(('body.0', 'body.2', 'heads')):
            state[f'actor.{name}.weight'] = self.policy[i].weight.detach()
            state[f'actor.{name}.bias'] = self.policy[i].bias.detach()
        for name, pair in (('critic', self.critics), ('target', self.targets)):
            for i in range(3):
                layers = [critic[2 * i] for critic in pair]
                state[f'{name}.{2 * i}'] = torch.stack([x.weight.detach().T for x in layers])
                state[f'{name}.{2 * i + 1}'] = torch.stack([x.bias.detach()[None] for x in layers])
        return state


def test_updates_are_those_of_a_plain_restatement(double: None) -> None:
    sac = SAC(OBS, ACT, SETTINGS, seed=3)
    plain = Plain(sac)
    for index in range(6):
        metrics, expected = update(sac, index, np.float64), plain.update(index)
        torch.testing.assert_close(metrics, expected, atol=1e-9, rtol=1e-9)
        state = sac.state()
        for name, tensor in plain.state().items():
            torch.testing.assert_close(state[name], tensor, atol=1e-8, rtol=1e-8, msg=name)


def test_log_probabilities_agree_with_a_numeric_jacobian_of_the_squash() -> None:
    generator = torch.Generator().manual_seed(0)
    mean, log_std, noise = torch.randn(3, 40, ACT, generator=generator, dtype=torch.float64)
    actions, log_prob = squashed_gaussian((mean, log_std), noise)
    u = mean + log_std.exp() * noise
    step = 1e-6
    for row in range(40):
        jacobian = np.empty((ACT, ACT))
        for column in range(ACT):
            shift = step * torch.eye(ACT, dtype=torch.float64)[column]
            difference = torch.tanh(u[row] + shift) - torch.tanh(u[row] - shift)
            jacobian[:, column] = difference / (2 * step)
        density = torch.distributions.MultivariateNormal(
            mean[row], torch.diag((2 * log_std[row]).exp())
        ).log_prob(u[row])
        expected = float(density) - np.log(np.linalg.det(jacobian))
        assert float(log_prob[row]) == pytest.approx(expected, rel=1e-5, abs=1e-5)
    assert torch.equal(actions, torch.tanh(u))


def test_log_probabilities_stay_right_where_the_squash_rounds_to_one() -> None:
    u = torch.tensor([[-40.0], [-15.0], [15.0], [40.0]])
    actions, log_prob = squashed_gaussian((u, torch.zeros_like(u)), torch.zeros_like(u))
    assert torch.all(actions.abs() == 1)
    log_slope = 2 * np.log(2) - 2 * np.abs(u[:, 0].numpy())
    expected = -0.5 * np.log(2 * np.pi) - log_slope
    np.testing.assert_allclose(log_prob.numpy(), expected, rtol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(('terminated', 'value'), [(True, 1.0), (False, 5.0)])
def test_a_terminal_step_is_worth_its_reward_and_a_truncated_one_all_that_would_follow(
    terminated: bool, value: float
) -> None:
    """One state, reward 1 for ever, discount 0.8, no entropy bonus: 1 or 1 / (1 - 0.8)."""
    settings = SacSettings(
        hidden=(16, 16),
        batch=16,
        critic_learning_rate=3e-3,
        temperature_learning_rate=1e-12,
        initial_temperature=1e-9,
        discount=0.8,
        tau=0.1,
    )
    sac = SAC(1, 1, settings, seed=0)
    here = np.ones((16, 1), np.float32)
    actions = np.linspace(-1, 1, 16, dtype=np.float32)[:, None]
    ends = np.full(16, terminated)
    batch = StepBatch(here, actions, np.ones(16, np.float32), here, ends)
    for _ in range(800):
        sac.update(batch)
    with torch.no_grad():
        values = q_values(sac.critic, torch.from_numpy(here), torch.from_numpy(actions))
    assert values.shape == (2, 16)
    np.testing.assert_allclose(values.numpy(), value, rtol=0.02)


@pytest.mark.parametrize(('target', 'direction'), [(-10, -1), (10, 1)])
def test_the_temperature_moves_the_entropy_towards_its_target(
    target: float, direction: int
) -> None:
    sac = SAC(OBS, ACT, SETTINGS.model_copy(update={'target_entropy': target}), seed=0)
    temperatures = [float(update(sac, index)['temperature']) for index in range(5)]
    assert temperatures[0] == pytest.approx(0.5)
    assert np.all(np.sign(np.diff(temperatures)) == direction)


def test_the_target_entropy_is_minus_half_the_action_size_as_in_jaxrl() -> None:
    assert SAC(OBS, ACT, SacSettings(hidden=(8,)), seed=0).target_entropy == -ACT / 2


def test_both_critics_start_orthogonal_up_to_their_output_and_different() -> None:
    sac = SAC(OBS, ACT, SETTINGS, seed=0)
    for weight, bias in zip(sac.critic_values[::2], sac.critic_values[1::2], strict=True):
        assert not torch.equal(weight[0], weight[1])
        assert not bias.any()
        for one in weight:
            gram = one @ one.T if one.shape[0] < one.shape[1] else one.T @ one
            torch.testing.assert_close(gram, 2 * torch.eye(len(gram)), atol=1e-5, rtol=0)
    assert all(map(torch.equal, sac.target, sac.critic_values))


def test_the_same_seed_gives_the_same_bits_and_another_seed_does_not() -> None:
    one, other, third = (SAC(OBS, ACT, SETTINGS, seed) for seed in (4, 4, 5))
    assert same(one.state(), other.state())
    assert not same(one.state(), third.state())
    for index in range(3):
        assert same(update(one, index), update(other, index))
    assert same(one.state(), other.state())


def test_where_a_batch_lies_in_memory_does_not_change_a_bit() -> None:
    settings = SETTINGS.model_copy(update={'hidden': (9, 9)})  # sizes at which it would
    one, other = SAC(OBS, ACT, settings, 4), SAC(OBS, ACT, settings, 4)
    for index in range(5):
        parts = {name: part[:7] for name, part in asdict(make_batch(index)).items()}
        moved = {name: crooked(part) for name, part in parts.items()}
        for sac, given in ((one, parts), (other, moved)):
            torch.manual_seed(index)
            sac.update(StepBatch(**given))
    assert same(one.state(), other.state())


def test_a_saved_learner_goes_on_bit_for_bit() -> None:
    sac = SAC(OBS, ACT, SETTINGS, seed=0)
    for index in range(3):
        update(sac, index)
    saved = safetensors.torch.save(sac.state())
    loaded = SAC(OBS, ACT, SETTINGS, seed=99)
    loaded.load_state(safetensors.torch.load(saved))
    for index in range(3, 6):
        assert same(update(sac, index), update(loaded, index))
    assert same(sac.state(), loaded.state())


def test_a_state_is_a_copy_that_later_updates_leave_alone() -> None:
    sac = SAC(OBS, ACT, SETTINGS, seed=0)
    state = sac.state()
    before = {name: tensor.clone() for name, tensor in state.items()}
    update(sac, 0)
    assert same(state, before)
    changed = {
        name for name, tensor in sac.state().items() if not torch.equal(tensor, state[name])
    }
    assert changed == state.keys()


def test_a_state_of_other_settings_is_refused_and_changes_nothing() -> None:
    sac = SAC(OBS, ACT, SETTINGS, seed=0)
    before = sac.state()
    deeper = SAC(OBS, ACT, SETTINGS.model_copy(update={'hidden': (24, 16, 16)}), seed=1).state()
    with pytest.raises(SacError, match=r"'sac' refused: .*critic\.6 is unknown"):
        sac.load_state(deeper)
    wider = SAC(OBS, ACT, SETTINGS.model_copy(update={'hidden': (24, 32)}), seed=1).state()
    with pytest.raises(SacError, match=r'actor\.body\.2\.weight is .*\(32, 24\).* \(16, 24\)'):
        sac.load_state(wider)
    assert same(sac.state(), before)
