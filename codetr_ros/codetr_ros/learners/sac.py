"""Soft actor-critic (Haarnoja et al., arXiv 1812.05905) as jaxrl has it, in paper order.

Where implementations differ, this one follows jaxrl: orthogonal initial weights with gain sqrt(2),
the critics' output layer included; a hard clip of the log standard deviation; no factor 1/2 in the
critic loss; a target entropy of -A/2; a temperature loss whose gradient goes through exp.

Shapes: B = batch, O = observation size, A = action size, H = width of a hidden layer. The two
critics are a stack: each of their weights has a leading dimension of 2, and one batched product
serves both.

The formula beside its symbols: docs/methods.md#sac.
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.optim.adam import adam

from codetr_ros import seeding
from codetr_ros.config import SacSettings
from codetr_ros.learners.base import LearnerError
from codetr_ros.memory.batches import StepBatch
from codetr_ros.policy.actor import Actor
from codetr_ros.system.states import check_state


class SacError(LearnerError):
    """A state that does not fit this learner: names what was given and what was expected."""


class SAC:
    """Actor, twin critics, their targets, the temperature, and one update of all of them.

    Everything random comes from torch's global generator: from the same generator state, batch and
    weights an update makes the same bits.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        settings: SacSettings,
        seed: int,
        progress: int = 0,
    ) -> None:
        """Make the networks.

        Args:
            observation_size: O.
            action_size: A.
            settings: widths, learning rates and the rest.
            seed: of the initial weights; torch's global generator is seeded from it.
            progress: numbers behind each observation of a batch, which critics alone see.
        """
        seeding.seed_torch(seed, 'sac', 'init')
        self.observation_size = observation_size
        self.discount, self.tau = settings.discount, settings.tau
        self.target_entropy = settings.target_entropy * action_size
        self.actor = Actor(observation_size, action_size, settings.hidden)
        self.critic = twin_critic([observation_size + progress + action_size, *settings.hidden, 1])
        self.critic_values = [p.detach() for p in self.critic]  # the same memory, no gradients
        self.target = [p.clone() for p in self.critic_values]
        self.log_temperature = nn.Parameter(torch.tensor(math.log(settings.initial_temperature)))
        self.critic_adam = Adam(self.critic, settings.critic_learning_rate)
        self.actor_adam = Adam(list(self.actor.parameters()), settings.actor_learning_rate)
        self.temperature_adam = Adam([self.log_temperature], settings.temperature_learning_rate)

    def update(self, batch: StepBatch) -> dict[str, Tensor]:
        """One update of everything.

        Returns:
            Scalar tensors, to be converted when they are read (a conversion waits for the
            result): `critic_loss`, `actor_loss`, `temperature` (alpha before the update),
            `entropy` of the policy [nats], `q_mean` over the batch and both critics.
        """
        # Copies, in memory of torch's own: how an array lies can change the last bit of a product.
        s, a, r = map(torch.tensor, (batch.observations, batch.actions, batch.rewards))
        s2, terminated = map(torch.tensor, (batch.next_observations, batch.terminated))
        noise2, noise = torch.randn(2, *a.shape, dtype=a.dtype)
        alpha = self.log_temperature.detach().exp()

        # Target: y = r + gamma (1 - terminated) (min_i Q'_i(s', a') - alpha log pi(a'|s')),
        # a' ~ pi(s'). An episode cut short at its horizon has not terminated: it is bootstrapped.
        with torch.no_grad():
            a2, log_prob2 = squashed_gaussian(self.actor(self._seen(s2)), noise2)
            value2 = torch.minimum(*q_values(self.target, s2, a2)) - alpha * log_prob2
            y = r + self.discount * (1 - terminated.to(r.dtype)) * value2  # (B,)

        # Critics: the mean over the batch of (Q_1(s, a) - y)^2 + (Q_2(s, a) - y)^2.
        q = q_values(self.critic, s, a)  # (2, B)
        critic_loss = (q - y).square().sum(0).mean()
        self.critic_adam.step(critic_loss)

        # Targets follow: Q' <- (1 - tau) Q' + tau Q.
        torch._foreach_lerp_(self.target, self.critic_values, self.tau)

        # Actor: the mean of alpha log pi(a|s) - min_i Q_i(s, a), a ~ pi(s), under the new critics.
        a_pi, log_prob = squashed_gaussian(self.actor(self._seen(s)), noise)
        q_pi = torch.minimum(*q_values(self.critic_values, s, a_pi))
        actor_loss = (alpha * log_prob - q_pi).mean()
        self.actor_adam.step(actor_loss)

        # Temperature: alpha (entropy - target entropy), the entropy as the actor's step saw it.
        entropy = -log_prob.detach().mean()
        temperature_loss = self.log_temperature.exp() * (entropy - self.target_entropy)
        self.temperature_adam.step(temperature_loss)

        return {
            'critic_loss': critic_loss.detach(),
            'actor_loss': actor_loss.detach(),
            'temperature': alpha,
            'entropy': entropy,
            'q_mean': q.detach().mean(),
        }

    def _seen(self, s: Tensor) -> Tensor:
        """What the actor sees of the rows of a batch."""
        return s[:, : self.observation_size]

    def state(self) -> dict[str, Tensor]:
        """All that the next update depends on except its batch and the generator: copies on the
        CPU, by name.
        """
        return {name: tensor.to('cpu', copy=True) for name, tensor in self._tensors().items()}

    def load_state(self, state: dict[str, Tensor]) -> None:
        """Restore what `state` returned.

        Raises:
            SacError: it is another learner's or architecture's; nothing has changed then.
        """
        mine = self._tensors()
        check_state("policy learner 'sac'", mine, state, SacError)
        for name, tensor in state.items():
            mine[name].copy_(tensor)

    def _tensors(self) -> dict[str, Tensor]:
        """The state itself, by name."""
        named = {f'actor.{name}': tensor for name, tensor in self.actor.state_dict().items()}
        named['log_temperature'] = self.log_temperature.detach()
        lists = {'critic': self.critic_values, 'target': self.target}
        for name in ('critic', 'actor', 'temperature'):
            optimiser: Adam = getattr(self, f'{name}_adam')
            lists |= {f'{name}_adam.{key}': tensors for key, tensors in optimiser.state().items()}
        for name, tensors in lists.items():
            named |= {f'{name}.{i}': tensor for i, tensor in enumerate(tensors)}
        return named


def squashed_gaussian(policy: tuple[Tensor, Tensor], noise: Tensor) -> tuple[Tensor, Tensor]:
    """Sample a = tanh(u), u = mean + std noise; log pi(a) = log N(u) - sum log(1 - tanh(u)^2).

    Args:
        policy: means and log standard deviations before the squash, both (B, A).
        noise: (B, A), standard normal.

    Returns:
        Actions (B, A) and their log-probabilities (B,).
    """
    mean, log_std = policy
    u = mean + log_std.exp() * noise
    log_normal = -0.5 * noise.square() - log_std - 0.5 * math.log(2 * math.pi)
    # log(1 - tanh(u)^2) = 2 (log 2 - u - softplus(-2u)), finite also where tanh(u) rounds to 1
    log_slope = 2 * (math.log(2) - u - F.softplus(-2 * u))
    return u.tanh(), (log_normal - log_slope).sum(-1)


def twin_critic(sizes: Sequence[int]) -> list[nn.Parameter]:
    """Two critics, layer by layer: orthogonal weights (2, in, out), zero biases (2, 1, out)."""
    parameters = []
    for inputs, outputs in pairwise(sizes):
        weight = torch.empty(2, inputs, outputs)
        for one in weight:
            nn.init.orthogonal_(one, math.sqrt(2))
        parameters += [nn.Parameter(weight), nn.Parameter(torch.zeros(2, 1, outputs))]
    return parameters


def q_values(critic: Sequence[Tensor], observations: Tensor, actions: Tensor) -> Tensor:
    """The values (2, B) that both critics give to actions (B, A) after observations (B, O)."""
    x = torch.cat([observations, actions], -1).expand(2, -1, -1)  # (2, B, O+A)
    *hidden, weight, bias = critic
    for w, b in zip(hidden[::2], hidden[1::2], strict=True):
        x = torch.baddbmm(b, x, w).relu()  # (2, B, H)
    return (x * weight.mT).sum(-1) + bias.squeeze(-1)  # faster than a product with one column


class Adam:
    """Adam with its usual constants: one fused step for all parameters, state in plain sight."""

    def __init__(self, parameters: Sequence[nn.Parameter], learning_rate: float) -> None:
        self.parameters: list[Tensor] = list(parameters)
        self.learning_rate = learning_rate
        self.means = [torch.zeros_like(p, requires_grad=False) for p in self.parameters]
        self.squares = [torch.zeros_like(p, requires_grad=False) for p in self.parameters]
        self.steps = [torch.zeros((), dtype=torch.float32) for _ in self.parameters]

    def step(self, loss: Tensor) -> None:
        """One step down the gradient of `loss` with respect to these parameters and no others."""
        gradients = torch.autograd.grad(loss, self.parameters)
        with torch.no_grad():
            adam(
                self.parameters,
                list(gradients),
                self.means,
                self.squares,
                [],
                self.steps,
                fused=True,
                amsgrad=False,
                beta1=0.9,
                beta2=0.999,
                lr=self.learning_rate,
                weight_decay=0.0,
                eps=1e-8,
                maximize=False,
            )

    def state(self) -> dict[str, list[Tensor]]:
        """Moments and step count of each parameter: the tensors themselves, not copies."""
        return {'mean': self.means, 'square': self.squares, 'step': self.steps}
