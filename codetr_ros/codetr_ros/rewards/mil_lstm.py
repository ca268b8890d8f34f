"""MIL_LSTM: the recurrent multiple-instance model, whose step rewards know the steps before.

Early, Bewley et al., NeurIPS 2022 (arXiv 2205.15367): a segment is a bag whose label is its score,
and its steps are the instances. A step is embedded as x_t, an LSTM carries a hidden state h_t from
step to step, and a head reads rewards whose sum is regressed on the score:

    ( sum_t rhat_t - R )^2

`mil_lstm.space` chooses between the paper's three recurrent models:

    csc          rhat_t = head(x_t, h_t): concatenated skip connections, the paper's best
    instance     rhat_t = head(h_t)
    embedding    rhat_t = head(h_t) - head(h_t-1), the first less nothing: the sum is head(h_m)

Its fourth, without recurrence, is method `mlp` here.

Differences from the published code, which was at hand with the paper's abstract:

* There a bag is a whole trajectory, a batch is one bag, and a fixed data set is learnt in 150 to
  250 epochs until held-out bags are no longer predicted better. Here segments are bags, 64 of them
  make a batch, and gradient steps come per phase. Adam's second decay is 0.999 here, 0.99 there.
* There the policy sees h_t as a part of its observation. Here methods only label steps.
* R is in units of the target scale c, and observations are standardised and cut off at 10
  deviations; there neither is.

Sizes, dropout and learning rate are those of its grid-world tasks. For Lunar Lander it has an
encoder of 128, 64 and 64, a head of 64 and 32, no dropout, and rewards that cannot be negative.
That the head's last layer has no dropout is inferred from a later version of the code.

The formula beside its symbols: docs/methods.md#mil_lstm.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from codetr_ros.config import MilLstmSettings
from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.rewards.base import segment_steps
from codetr_ros.rewards.learned import CLIP, Learned


class MilLstm(Learned):
    """Learns R(segment) = sum_t rhat_t, rhat_t of the steps up to t; labels with rhat_t.

    Args:
        settings: the run's settings; the initial weights depend on its seed.
        observation_size: O.
        action_size: A.
    """

    name: ClassVar[str] = 'mil_lstm'
    group: ClassVar[str] = 'mil_lstm'
    clip: ClassVar[float] = CLIP
    network: 'RecurrentRewards'

    def _make_network(self, observation_size: int, action_size: int) -> 'RecurrentRewards':
        return RecurrentRewards(observation_size + action_size, self._settings.mil_lstm)

    def _terms(
        self, memory: Trajectories, rng: np.random.Generator
    ) -> Iterator[dict[str, Tensor]]:
        batch = memory.segments.sample(rng, self._settings.mil_lstm.batch)
        inside = self._put(segment_steps(batch))  # (B, L)
        predicted = (self._step_rewards(batch) * inside).sum(1)  # (B,)
        yield {'reward_loss': F.mse_loss(predicted, self._scaled(batch.values))}

    def _step_rewards(self, batch: SegmentBatch) -> Tensor:
        rewards: Tensor = self.network(self._step_inputs(batch))
        return rewards


class RecurrentRewards(nn.Module):
    """Embeds steps, remembers them, and reads off rewards.

    Args:
        inputs: D, numbers that describe a step.
        settings: widths, dropout, and what the head reads.
    """

    def __init__(self, inputs: int, settings: MilLstmSettings) -> None:
        super().__init__()
        self._space = settings.space
        self.encoder = stack((inputs, *settings.hidden), settings.dropout)
        embedded = settings.hidden[-1]
        self.recurrent = nn.LSTM(embedded, settings.width, batch_first=True)
        self.first_hidden = nn.Parameter(torch.zeros(1, 1, settings.width))
        self.first_cell = nn.Parameter(torch.zeros(1, 1, settings.width))
        read = settings.width + (embedded if settings.space == 'csc' else 0)
        head = stack((read, *settings.head), settings.dropout)
        self.head = nn.Sequential(*head, nn.Linear(settings.head[-1], 1))

    def forward(self, steps: Tensor) -> Tensor:
        """Rewards (B, L) of steps (B, L, D), each of the steps up to it."""
        embedded = self.encoder(steps)  # (B, L, E)
        first = [
            state.expand(-1, len(steps), -1).contiguous()
            for state in (self.first_hidden, self.first_cell)
        ]
        states, _ = self.recurrent(embedded, (first[0], first[1]))  # (B, L, W)
        if self._space == 'csc':
            states = torch.cat([embedded, states], -1)
        values: Tensor = self.head(states).squeeze(-1)  # (B, L)
        if self._space == 'embedding':
            return torch.diff(values, dim=1, prepend=torch.zeros_like(values[:, :1]))
        return values


def stack(widths: Sequence[int], dropout: float) -> nn.Sequential:
    """Linear layers, each with ReLU and dropout after it; torch's initial weights."""
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise(widths):
        layers += [nn.Linear(before, after), nn.ReLU(), nn.Dropout(dropout)]
    return nn.Sequential(*layers)
