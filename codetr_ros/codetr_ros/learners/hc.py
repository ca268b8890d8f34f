"""HC: off-policy learning from delayed scores with a critic that knows the history (Han et al.,
"Off-Policy Reinforcement Learning with Delayed Rewards", ICML 2022, arXiv 2106.11854).

A score depends on the whole segment, so a value of state and action alone is not defined. The
critic therefore sees the segment so far, and is a sum of two parts:

    Q(tau_{t_i:t+1}) = H(tau_{t_i:t}) + C(s_t, a_t)

Only C depends on the action: the actor follows C alone, free of the variance that H carries. A
regulariser ties H of a whole segment to its score. The policy sees how far the segment is,
(t - t_i) / n, as one more observation, and so does C.

No step is labelled: this learner takes the composite rewards themselves, and needs no reward node.

How certain this is: the formulas are recalled from the paper and agree with the documentation of a
third-party port on the paper's section 4 (equations 6 to 9). The paper's text and code could not
be had, and it is not claimed that the published code does any of this in the same way. Decided
here:

- H and C are fitted together to one target, by the formula above; the port fits them one after the
  other.
- Twin critics as in SAC: each has its own H and C, the target takes the smaller of the two sums,
  the actor the smaller C.
- The segment's end empties the history, also where the time limit cuts the segment short; nothing
  is bootstrapped from a terminal state.
- Steps are drawn from `hc.segments` segments, so that one pass over a segment serves several
  steps. Each step is as likely as with independent draws; a batch's steps are not independent.
- Scores are in units of the target scale (`target_scale`, `reward_unit`), as for other methods.
- The rest is this project's SAC with its settings, the history's learning rate included. The GRU's
  width of 128 and the regulariser's weight of 5 are those of that port.

Shapes: B = batch of steps, S = segments, L = steps of the longest, O, A = sizes of observation and
action.

The formula beside its symbols: docs/methods.md#hc.
"""

import copy
import math
from collections.abc import Iterator, Mapping

import numpy as np
import torch
from torch import Tensor, nn

from codetr_ros import seeding
from codetr_ros.config import Settings
from codetr_ros.learners.base import LearnerError, OffPolicy, add
from codetr_ros.learners.histories import HISTORIES, HistoryBatch, ScoredSteps
from codetr_ros.learners.sac import Adam, q_values, squashed_gaussian, twin_critic
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.policy.actor import Actor
from codetr_ros.policy.network import describe_network
from codetr_ros.system.states import check_state


class Critic(nn.Module):
    """Two critics Q = H + C."""

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        super().__init__()
        hidden = settings.sac.hidden
        sizes = [observation_size + 1 + action_size, *hidden, 1]
        self.parts = nn.ParameterList(twin_critic(sizes))
        history = HISTORIES[settings.hc.history]
        self.history = history(observation_size, action_size, hidden, settings.hc)

    def current(self, observations: Tensor, actions: Tensor) -> Tensor:
        """C (2, B) of actions (B, A) after observations with the place in the segment (B, O+1)."""
        return q_values(list(self.parts), observations, actions)


class HC(OffPolicy):
    """Actor, twin critics H + C, their targets, the temperature, and one update of all of them.

    Args:
        settings: the run's settings; `hc` and `sac` are this learner's.
        observation_size: O of the task.
        action_size: A of the task.
    """

    lacking = 'nothing scored'

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        super().__init__(settings)
        seeding.seed_torch(settings.seed, 'hc', 'init')
        sac = settings.sac
        self.target_scale = 0.0
        self._steps: ScoredSteps | None = None
        self._actor = Actor(observation_size + 1, action_size, sac.hidden)
        self.network = describe_network(
            observation_size, action_size, sac.hidden, settings.longest
        )
        self.critic = Critic(settings, observation_size, action_size)
        self.target = copy.deepcopy(self.critic).requires_grad_(False)
        self.target_entropy = sac.target_entropy * action_size
        self.log_temperature = nn.Parameter(torch.tensor(math.log(sac.initial_temperature)))
        self._adams = {
            'critic': Adam(list(self.critic.parameters()), sac.critic_learning_rate),
            'actor': Adam(list(self.actor.parameters()), sac.actor_learning_rate),
            'temperature': Adam([self.log_temperature], sac.temperature_learning_rate),
        }

    @property
    def actor(self) -> Actor:
        """The policy network."""
        return self._actor

    def train(self, phase: int, memory: Trajectories) -> Iterator[dict[str, float]]:
        """Take the updates of the phase, or none if nothing is scored.

        Raises:
            LearnerError: the policy is not finite any more.
        """
        yield from super().train(phase, memory)
        assert self._steps is not None
        yield {'target_scale': self.target_scale, 'scored_steps': len(self._steps)}

    def _prepare(self, memory: Trajectories) -> bool:
        self._steps = ScoredSteps(memory)
        if not len(self._steps):
            return False
        if not self.target_scale:  # frozen with the first scores
            self.target_scale = memory.segments.target_scale(self._settings.target_scale)
        return True

    def _burst(
        self, memory: Trajectories, rng: np.random.Generator, updates: int
    ) -> dict[str, Tensor]:
        assert self._steps is not None
        totals: dict[str, Tensor] = {}
        for _ in range(updates):
            batch = self._steps.sample(rng, self._settings.hc.segments, self._settings.sac.batch)
            add(totals, self.update(batch))
        return totals

    def update(self, batch: HistoryBatch) -> dict[str, Tensor]:
        """One update of everything, with noise from torch's global generator.

        Returns:
            Scalar tensors: `critic_loss` of the temporal difference alone, `history_loss` (the
            regulariser, without its weight), `actor_loss`, `temperature`, `entropy` [nats],
            `q_mean`.
        """
        settings = self._settings.sac
        segments, actions = torch.tensor(batch.observations), torch.tensor(batch.actions)
        before = segments[:, :-1]  # (S, L, O)
        owners, t = torch.tensor(batch.owners), torch.tensor(batch.steps)
        lengths, scores = torch.tensor(batch.lengths), self._scores(batch).to(segments.dtype)
        last = t == lengths[owners] - 1
        following = torch.where(last, 0, t + 1)  # a new segment begins with an empty history
        s, s2 = (
            self._placed(segments[owners, t], t),
            self._placed(segments[owners, t + 1], following),
        )
        a = actions[owners, t]
        terminated = last & torch.tensor(batch.terminal)[owners]
        noise2, noise = torch.randn(2, *a.shape, dtype=a.dtype)
        alpha = self.log_temperature.detach().exp()

        # Target: y = R_t + gamma (1 - terminated) (min_k [H'_k(h_{t+1}) + C'_k(s', a')]
        #     - alpha log pi(a'|s')); the segment's score R comes with its last step, else R_t = 0.
        with torch.no_grad():
            a2, log_prob2 = squashed_gaussian(self.actor(s2), noise2)
            h2 = self.target.history(before, actions)[:, owners, following]
            value2 = torch.minimum(*(h2 + self.target.current(s2, a2))) - alpha * log_prob2
            y = scores[owners] * last + settings.discount * value2 * ~terminated  # (B,)

        # Critics: mean of (H + C - y)^2, plus lambda times that of (H(whole segment) - R)^2.
        h = self.critic.history(before, actions)  # (2, S, L+1)
        q = h[:, owners, t] + self.critic.current(s, a)
        critic_loss = (q - y).square().sum(0).mean()
        whole = h[:, torch.arange(len(lengths)), lengths]
        history_loss = (whole - scores).square().sum(0).mean()
        self._adams['critic'].step(critic_loss + self._settings.hc.regulariser * history_loss)

        # Targets follow.
        weights = [p.detach() for p in self.critic.parameters()]
        torch._foreach_lerp_(list(self.target.parameters()), weights, settings.tau)

        # Actor: the mean of alpha log pi(a|s) - min_k C_k(s, a), a ~ pi(s).
        actor_loss, log_prob = self.actor_loss(s, noise, alpha)
        self._adams['actor'].step(actor_loss)

        # Temperature: alpha (entropy - target entropy).
        entropy = -log_prob.detach().mean()
        self._adams['temperature'].step(
            self.log_temperature.exp() * (entropy - self.target_entropy)
        )
        return {
            'critic_loss': critic_loss.detach(),
            'history_loss': history_loss.detach(),
            'actor_loss': actor_loss.detach(),
            'temperature': alpha,
            'entropy': entropy,
            'q_mean': q.detach().mean(),
        }

    def actor_loss(
        self, observations: Tensor, noise: Tensor, alpha: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The actor's loss, and the log-probabilities (B,) of its actions.

        Args:
            observations: (B, O+1), with the place in the segment.
            noise: (B, A), standard normal.
            alpha: the temperature.
        """
        actions, log_prob = squashed_gaussian(self.actor(observations), noise)
        value = torch.minimum(*self.critic.current(observations, actions))
        return (alpha * log_prob - value).mean(), log_prob

    def _scores(self, batch: HistoryBatch) -> Tensor:
        """Composite rewards (S,) in the unit of the settings."""
        unit = self.target_scale if self._settings.reward_unit == 'scaled' else 1.0
        return torch.tensor(batch.values / unit)

    def _placed(self, observations: Tensor, steps: Tensor) -> Tensor:
        """Observations (B, O) with how far the segment is after `steps` (B,) of its n steps."""
        place = (steps / self._settings.longest).to(observations.dtype)
        return torch.cat([observations, place[:, None]], -1)

    def state(self) -> dict[str, Tensor]:
        """Copies of all that the next update depends on except batch and generator, by name."""
        return {name: tensor.clone() for name, tensor in self._tensors().items()} | {
            'target_scale': torch.tensor(self.target_scale, dtype=torch.float64)
        }

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Restore what `state` returned.

        Raises:
            LearnerError: it is another learner's or architecture's; nothing has changed then.
        """
        check_state("policy learner 'hc'", self.state(), state, LearnerError)
        for name, tensor in self._tensors().items():
            tensor.copy_(state[name])
        self.target_scale = float(state['target_scale'])

    def _tensors(self) -> dict[str, Tensor]:
        """The state itself, by name."""
        named = {'log_temperature': self.log_temperature.detach()}
        for name in ('actor', 'critic', 'target'):
            weights = getattr(self, name).state_dict()
            named |= {f'{name}.{key}': tensor for key, tensor in weights.items()}
        for name, adam in self._adams.items():
            for key, tensors in adam.state().items():
                named |= {f'{name}_adam.{key}.{i}': tensor for i, tensor in enumerate(tensors)}
        return named
