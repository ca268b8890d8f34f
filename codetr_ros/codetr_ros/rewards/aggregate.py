"""A learnt aggregator: what a segment is worth so far, told by three numbers carried through it.

    z_t = (A_t, M_t, E_t) = u(z_{t-1}, r_t),  r_t = r(s_t, a_t, s_{t+1} - s_t)
    R(segment) = p(z_m),  label: p(z_t) - p(z_{t-1})

    A_t  the first of the three numbers of r, added up
    M_t  the soft maximum of the second so far, sum softmax(beta r) r; a minimum where beta < 0
    E_t  the third

r is a network, beta is learnt, and p is linear in A, A |A|, A / t, M and E. With p(z_0) = 0 the
labels of a segment sum to its predicted score. A label depends on the steps up to its own, a
segment costs O(m), and m may be anything. Sums, their squares, sums of squares, means, soft and
hard maxima, minima, and peak and end are of this form, without error.

Labels are what a step changes of the verdict, so they are not functions of the step alone: under a
maximum most are 0. With `aggregate.critic_sees_aggregate` the critics see the sum of the segment's
labels so far, p(z_{t-1}), and (t - 1) / n beside the observation. Where one of the numbers counts
alone, what a step changes follows from these two, and the critics' problem is Markov again (our
reading: z itself has no scale that lasts while u is learnt, and stays with the reward model).

The formula beside its symbols: docs/methods.md#aggregate. All of it is decided here.
"""

from collections.abc import Iterator
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.rewards.base import segment_steps
from codetr_ros.rewards.learned import CLIP, Learned
from codetr_ros.rewards.mlp import perceptron


class Aggregate(Learned):
    """Learns R(segment) = p(z_m) by regression; labels steps with p(z_t) - p(z_{t-1})."""

    name: ClassVar[str] = 'aggregate'
    group: ClassVar[str] = 'aggregate'
    clip: ClassVar[float] = CLIP
    network: 'Worth'

    def _make_network(self, observation_size: int, action_size: int) -> 'Worth':
        hidden, longest = self._settings.aggregate.hidden, self._settings.longest
        return Worth(2 * observation_size + action_size, hidden, longest)

    def _terms(
        self, memory: Trajectories, rng: np.random.Generator
    ) -> Iterator[dict[str, Tensor]]:
        batch = memory.segments.sample(rng, self._settings.aggregate.batch)
        inside = self._put(segment_steps(batch))  # (B, L)
        predicted = (self._step_rewards(batch) * inside).sum(1)  # (B,)
        yield {'reward_loss': F.mse_loss(predicted, self._scaled(batch.values))}

    def _step_rewards(self, batch: SegmentBatch) -> Tensor:
        observations = self._standardised(batch.observations)  # (B, L + 1, O)
        before, change = observations[:, :-1], torch.diff(observations, dim=1)
        worth = self.network(torch.cat([before, self._put(batch.actions), change], -1))  # (B, L)
        return torch.diff(worth, dim=1, prepend=torch.zeros_like(worth[:, :1])).float()


class Worth(nn.Module):
    """What the steps of a segment are worth together, up to each of them.

    Args:
        inputs: 2 O + A.
        hidden: widths of the network r.
        longest: n, steps of the longest segment, in units of which p's coefficients are.
    """

    def __init__(self, inputs: int, hidden: tuple[int, ...], longest: int) -> None:
        super().__init__()
        self._longest = longest
        self.step = perceptron(inputs, hidden, 3)
        self.sharpness = nn.Parameter(torch.zeros(()))  # beta; at 0 neither maximum nor minimum
        self.readout = nn.Parameter(torch.tensor([1.0, 0.0, 0.0, 1.0, 1.0]) / 3)

    def forward(self, steps: Tensor) -> Tensor:
        """P of the steps (B, L, 2 O + A) up to each of them (B, L), float64."""
        return self.worth(self.step(steps))

    def worth(self, rewards: Tensor) -> Tensor:
        """P (B, L) of r (B, L, 3)."""
        added, most, last = self.states(rewards).unbind(-1)  # (B, L) each
        n, place = self._longest, torch.arange(1, added.shape[1] + 1, device=added.device)
        share = added / n
        numbers = torch.stack([share, share * share.abs(), added / place, most, last], -1)
        return n * (numbers @ self.readout.double())

    def states(self, rewards: Tensor) -> Tensor:
        """Z (B, L, 3) after each step, of r (B, L, 3)."""
        added, risen, last = rewards.double().unbind(-1)
        heat = self.sharpness.double() * risen
        share = (heat - torch.logcumsumexp(heat, 1)).exp()  # in the maximum so far
        most = [risen[:, 0]]
        for t in range(1, risen.shape[1]):
            most.append(torch.lerp(most[-1], risen[:, t], share[:, t]))
        return torch.stack([added.cumsum(1), torch.stack(most, 1), last], -1)
