"""LIRPG: learning an intrinsic reward for policy gradients (Zheng et al., "On Learning Intrinsic
Rewards for Policy Gradient Methods", NeurIPS 2018, arXiv 1804.06459).

The policy, theta, is trained by PPO on an intrinsic reward r(s, a; eta) of every step. After each
of its updates the intrinsic reward is changed so that the updated policy theta' would have earned
more of what really counts, the composite rewards:

    theta' = theta - Adam(gradient of the PPO loss with advantages of c_in r(s, a; eta) + c_ex R)
    eta'   = eta - Adam(gradient, through theta', of the PPO loss of theta' with advantages of R)

On-policy, with a gradient through the policy: it runs in process and in lock-step only, learns
from each phase's steps once the phase is over, and forgets them. Nothing labels steps and there is
no reward node; R is a segment's composite reward at its last step and 0 elsewhere.

How certain this is: structure and constants were read from the authors' published code, its PPO
for MuJoCo, and with them:

- The handwritten Adam takes the second moment as a constant to the meta-gradient.
- Both objectives normalise advantages by minibatch, and the meta-gradient goes through that of the
  inner one.
- The norm of gradients is bounded for each of the two updates by itself, policy with value and
  intrinsic reward with value of R. The meta-gradient goes through the bound of the inner one.
- Eta and theta move together after each minibatch.

A point marked (recalled) was not looked up again. It is inferred that the comparison in the CoDeTr
paper used that code, with its delay of rewards set to n. The differences, all on purpose:

- A phase (`phase_steps`, 1000) takes the place of 2048 steps. `lirpg.batch` sets the size of a
  minibatch to theirs, 64; they set the number of minibatches, 32.
- Actions are tanh(u) of a Gaussian u, as for every policy here; theirs are Gaussian and clipped by
  the environment (recalled). Losses are those of u, recovered from the action: the effect of tanh
  on the density cancels in PPO's ratio.
- Composite rewards are computed from raw rewards and then divided by the running deviation of
  their discounted return; theirs are scaled first and then summed: a composite is not linear.
  `target_scale` and `reward_unit` do not matter. The running return begins anew with each phase.
- Moments of the observations change between phases, not between steps, so that a phase has one
  policy. They begin with the warm-up's random steps, from which nothing else is learnt.
- At the time limit values are bootstrapped, as everywhere here; theirs are not.
- The value loss is a plain squared error (half of it, times `value_coefficient`); theirs is
  clipped. There is no bonus for entropy (their coefficient is 0). Adam's step size and the place
  of its epsilon are torch's.
- A segment without a score has the mean of all known ones in its place (decided here).

Shapes: T = steps of the phase, B = steps of a minibatch, O, A = sizes of observation and action.

The formula beside its symbols: docs/methods.md#lirpg.
"""

import math
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call

from codetr_ros.config import Settings
from codetr_ros.learners.base import LearnerError
from codetr_ros.learners.on_policy import (
    DifferentiableAdam,
    RunningMoments,
    clipped,
    discounted_returns,
    ends,
    normalised,
    trace,
)
from codetr_ros.memory.ring import Rollout
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.policy.actor import StandardisedActor, layers, orthogonal, standardise
from codetr_ros.policy.network import STANDARDISED, describe_network
from codetr_ros.records import F32
from codetr_ros.seeding import generator, seed_torch
from codetr_ros.system.states import check_state

KIND = STANDARDISED
REWARD_CLIP = 10.0
"""Scaled composite rewards are clipped to this (baselines' VecNormalize)."""
LARGEST_ACTION = 1 - 1e-6
"""Actions are clipped to this before their squash is inverted."""


def value_network(inputs: int, hidden: Sequence[int]) -> nn.Sequential:
    """A tanh network with one output and orthogonal weights, of gain 1 in the last layer."""
    body = layers(inputs, hidden, nn.Tanh)
    orthogonal(body, math.sqrt(2))
    head = nn.Sequential(nn.Linear(hidden[-1], 1))
    orthogonal(head, 1.0)
    return body.extend(head)


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class PhaseBatch:
    """A phase's steps, with all that stays fixed while they are learnt from."""

    observations: Tensor  # (T, O) standardised
    actions: Tensor  # (T, A)
    squashed: Tensor  # (T, A) u; the action is tanh(u)
    log_probs: Tensor  # (T,) of u under the policy that acted
    rewards: Tensor  # (T,) R at the last steps of segments, scaled
    values: Tensor  # (T,) of mixed rewards, before the phase is learnt from
    following: Tensor  # (T,) gamma times the value of what follows; 0 after a terminal state
    ends: Tensor  # (T,) the last step of each step's stretch
    advantages: Tensor  # (T,) by R alone
    returns: Tensor  # (T,) by R alone


class Lirpg:
    """PPO's policy and value, the intrinsic reward and the value of R, and their updates.

    Args:
        settings: the run's settings; `lirpg` is this learner's group.
        observation_size: O of the task.
        action_size: A of the task.
    """

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        seed_torch(settings.seed, 'lirpg', 'init')
        self._settings, own = settings, settings.lirpg
        self.updates = 0
        self.counters: Counter[str] = Counter()
        self.actor = StandardisedActor(observation_size, action_size, own.hidden)
        self.network = describe_network(observation_size, action_size, own.hidden, kind=KIND)
        self.value = value_network(observation_size, own.hidden)
        self.extrinsic_value = value_network(observation_size, own.hidden)
        self.intrinsic_reward = value_network(observation_size + action_size, own.hidden)
        self._policy_names = [name for name, _ in self.actor.named_parameters()]
        self.theta = [*self.actor.parameters(), *self.value.parameters()]
        self.eta = [*self.intrinsic_reward.parameters(), *self.extrinsic_value.parameters()]
        self._theta_adam = DifferentiableAdam(self.theta, own.learning_rate, own.epsilon)
        self._eta_adam = DifferentiableAdam(self.eta, own.reward_learning_rate, own.epsilon)
        self._moments = RunningMoments(observation_size)
        self._return_moments = RunningMoments(1)

    def train(self, phase: int, memory: Trajectories) -> Iterator[dict[str, float]]:
        """PPO's epochs over the steps of the phase, one epoch a slice.

        Raises:
            LearnerError: the policy is not finite any more.
        """
        settings, own = self._settings, self._settings.lirpg
        if phase < settings.warmup_phases:
            self.counters['steps not learnt from, acted at random'] += memory.steps
            everything = memory.store.newest([memory.steps] * settings.source_count)
            self._observe(everything.observations)
            return
        began = time.perf_counter()
        rollout = memory.store.newest(settings.shares_of(phase))
        missing = np.isnan(rollout.rewards)  # of segments without a score
        if missing.any():
            known = memory.segments.scores(memory.segments.ids())
            rollout.rewards[missing] = known.mean() if len(known) else 0.0
        self.counters['steps evicted before they were learnt from'] += settings.steps_of(
            phase
        ) - len(rollout.rewards)
        batch = self.prepare(rollout)
        totals: dict[str, Tensor] = {}
        parts = -(-len(rollout.rewards) // own.batch)
        for epoch in range(own.epochs):
            rng = generator(settings.seed, 'learner', phase, epoch)
            for part in np.array_split(rng.permutation(len(rollout.rewards)), parts):
                for name, value in self.update(batch, torch.from_numpy(part)).items():
                    totals[name] = totals.get(name, torch.zeros(())) + value
                self.updates += 1
            yield {}
        self._observe(rollout.observations)
        means = {name: float(total) / (own.epochs * parts) for name, total in totals.items()}
        if not all(bool(p.isfinite().all()) for p in (*self.theta, *self.eta)):
            raise LearnerError(
                f'the policy is not finite after phase {phase} ({means}): training has diverged. '
                'Lower lirpg.learning_rate and lirpg.reward_learning_rate'
            )
        yield means | {'update_seconds': time.perf_counter() - began}

    def prepare(self, rollout: Rollout) -> PhaseBatch:
        """The batch of a phase's steps, by the policy and the values as they are now."""
        own = self._settings.lirpg
        returns = discounted_returns(rollout, own.discount)
        self._return_moments.add(returns[:, None])
        scale = float(self._return_moments.deviation)
        weight = self.actor.log_std
        with torch.no_grad():
            x, x2 = (
                self._standardised(torch.tensor(o, dtype=weight.dtype))
                for o in (rollout.observations, rollout.next_observations)
            )
            a = torch.tensor(rollout.actions, dtype=weight.dtype)
            u = a.clamp(-LARGEST_ACTION, LARGEST_ACTION).atanh()
            r = torch.tensor(rollout.rewards / scale, dtype=weight.dtype)
            r = r.clamp(-REWARD_CLIP, REWARD_CLIP)
            goes_on = own.discount * ~torch.tensor(rollout.terminated)
            stretch_ends = torch.from_numpy(ends(rollout.last))
            v, v2 = (self.extrinsic_value(o).squeeze(-1) for o in (x, x2))
            delta = r + goes_on * v2 - v
            advantages = torch.cat(
                [
                    self._advantages(torch.from_numpy(some), stretch_ends, delta)
                    for some in np.array_split(np.arange(len(r)), -(-len(r) // own.batch))
                ]
            )
            return PhaseBatch(
                observations=x,
                actions=a,
                squashed=u,
                log_probs=self.log_probs(list(self.actor.parameters()), x, u),
                rewards=r,
                values=self.value(x).squeeze(-1),
                following=goes_on * self.value(x2).squeeze(-1),
                ends=stretch_ends,
                advantages=advantages,
                returns=advantages + v,
            )

    def update(self, batch: PhaseBatch, indices: Tensor) -> dict[str, Tensor]:
        """One update of everything from a minibatch: the steps `indices` (B,) of the phase.

        Returns:
            Scalar tensors: `policy_loss` of the outer objective, `extrinsic_value_loss`,
            `intrinsic_reward`, the mean over the phase, and the norm of its meta-gradient.
        """
        own = self._settings.lirpg
        theta = self._theta_adam.propose(self.policy_gradients(batch, indices))
        policy_loss, value_loss = self.outer_losses(theta.values, batch, indices)
        loss = policy_loss + own.value_coefficient * value_loss
        gradients = torch.autograd.grad(loss, self.eta)
        of_reward = gradients[: len(list(self.intrinsic_reward.parameters()))]
        self._eta_adam.accept(self._eta_adam.propose(clipped(gradients, own.gradient_norm)))
        self._theta_adam.accept(theta)
        return {
            'policy_loss': policy_loss.detach(),
            'extrinsic_value_loss': value_loss.detach(),
            'intrinsic_reward': self.intrinsic_rewards(batch).detach().mean(),
            'meta_gradient_norm': torch.stack([g.square().sum() for g in of_reward]).sum().sqrt(),
        }

    def policy_gradients(self, batch: PhaseBatch, indices: Tensor) -> list[Tensor]:
        """The inner gradients, of PPO's loss on mixed rewards with respect to theta: clipped, and
        functions of eta.
        """
        own = self._settings.lirpg
        rewards = own.intrinsic_coefficient * self.intrinsic_rewards(batch)
        rewards = rewards + own.extrinsic_coefficient * batch.rewards
        delta = rewards + batch.following - batch.values
        advantages = self._advantages(indices, batch.ends, delta)
        returns = advantages + batch.values[indices]
        policy = list(self.actor.parameters())
        value = self.value(batch.observations[indices]).squeeze(-1)
        loss = self.policy_loss(policy, batch, indices, advantages)
        loss = loss + own.value_coefficient * 0.5 * (value - returns).square().mean()
        gradients = torch.autograd.grad(loss, self.theta, create_graph=True)
        return clipped(gradients, own.gradient_norm)

    def outer_losses(
        self, theta: Sequence[Tensor], batch: PhaseBatch, indices: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The losses that eta is to lower: PPO's loss of the policy in `theta` with advantages of
        R alone, and the loss of R's value.
        """
        policy = theta[: len(self._policy_names)]
        value = self.extrinsic_value(batch.observations[indices]).squeeze(-1)
        value_loss = 0.5 * (value - batch.returns[indices]).square().mean()
        return self.policy_loss(policy, batch, indices, batch.advantages[indices]), value_loss

    def policy_loss(
        self, policy: Sequence[Tensor], batch: PhaseBatch, indices: Tensor, advantages: Tensor
    ) -> Tensor:
        """PPO's clipped loss of a policy with these parameters (Schulman et al., arXiv 1707.06347,
        equation 7) for advantages (B,), which it normalises.
        """
        clip = self._settings.lirpg.clip
        squashed = batch.squashed[indices]
        log_probs = self.log_probs(policy, batch.observations[indices], squashed)
        ratio = (log_probs - batch.log_probs[indices]).exp()
        advantages = normalised(advantages)
        return -torch.minimum(
            advantages * ratio, advantages * ratio.clamp(1 - clip, 1 + clip)
        ).mean()

    def log_probs(
        self, policy: Sequence[Tensor], observations: Tensor, squashed: Tensor
    ) -> Tensor:
        """Logarithm of N(u) (B,) for actions u (B, A) before their squash."""
        named = dict(zip(self._policy_names, policy, strict=True))
        mean, log_std = functional_call(self.actor, named, (observations,))
        normal = -0.5 * ((squashed - mean) / log_std.exp()).square() - log_std
        log_probs: Tensor = (normal - 0.5 * math.log(2 * math.pi)).sum(-1)
        return log_probs

    def intrinsic_rewards(self, batch: PhaseBatch) -> Tensor:
        """r(s, a; eta) in (-1, 1) of all steps (T,)."""
        both = torch.cat([batch.observations, batch.actions], -1)
        rewards: Tensor = self.intrinsic_reward(both).squeeze(-1).tanh()
        return rewards

    def _advantages(self, indices: Tensor, stretch_ends: Tensor, delta: Tensor) -> Tensor:
        """Of the steps `indices` (B,), from temporal differences `delta` (T,)."""
        own = self._settings.lirpg
        return trace(indices, stretch_ends, own.discount * own.trace_decay).to(delta) @ delta

    def _standardised(self, observations: Tensor) -> Tensor:
        actor = self.actor
        return standardise(observations, actor.observation_mean, actor.observation_deviation)

    def _observe(self, observations: F32) -> None:
        """Include these observations (T, O) in the moments of the policy that acts next."""
        self._moments.add(observations)
        self.actor.observation_mean.copy_(self._moments.mean)
        self.actor.observation_deviation.copy_(self._moments.deviation)

    def state(self) -> dict[str, Tensor]:
        """Copies of everything needed to go on from here."""
        return {name: tensor.clone() for name, tensor in self._tensors().items()}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a `state()`.

        Raises:
            LearnerError: it is another learner's or architecture's; nothing has changed then.
        """
        mine = self._tensors()
        check_state("policy learner 'lirpg'", mine, state, LearnerError)
        for name, tensor in mine.items():
            tensor.copy_(state[name])

    def _tensors(self) -> dict[str, Tensor]:
        """The state itself, by name."""
        tensors: dict[str, Tensor] = {}
        for name in ('actor', 'value', 'extrinsic_value', 'intrinsic_reward'):
            weights = getattr(self, name).state_dict()
            tensors |= {f'{name}.{key}': tensor for key, tensor in weights.items()}
        for name, adam in (('theta', self._theta_adam), ('eta', self._eta_adam)):
            tensors |= {f'{name}_adam.{key}': tensor for key, tensor in adam.state().items()}
        for name, moments in (('observed', self._moments), ('returned', self._return_moments)):
            tensors |= {f'{name}.{key}': tensor for key, tensor in moments.tensors.items()}
        return tensors
