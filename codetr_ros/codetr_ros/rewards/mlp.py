"""A Markovian reward model: r(s, a) of each step by itself, trained on the sums of segments.

It is a control, not a published method: CoDeTr without a transformer and without weights. Where it
does as well as CoDeTr, no step's reward depended on the steps around it. Sizes, learning rate and
weight decay are decided here, after the reward network of RRD. Composite rewards, target scale,
segments, batch and number of gradient steps are CoDeTr's.

The formula beside its symbols: docs/methods.md#mlp.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import ClassVar

import numpy as np
from torch import Tensor, nn
from torch.nn import functional as F

from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.rewards.base import segment_steps
from codetr_ros.rewards.learned import CLIP, Learned


class Mlp(Learned):
    """Learns R(segment) = sum_t r(s_t, a_t) by regression; labels steps with r(s_t, a_t)."""

    name: ClassVar[str] = 'mlp'
    group: ClassVar[str] = 'mlp'
    clip: ClassVar[float] = CLIP

    def _make_network(self, observation_size: int, action_size: int) -> nn.Module:
        return perceptron(observation_size + action_size, self._settings.mlp.hidden)

    def _terms(
        self, memory: Trajectories, rng: np.random.Generator
    ) -> Iterator[dict[str, Tensor]]:
        batch = memory.segments.sample(rng, self._settings.mlp.batch)
        inside = self._put(segment_steps(batch))  # (B, L)
        predicted = (self._step_rewards(batch) * inside).sum(1)  # (B,)
        yield {'reward_loss': F.mse_loss(predicted, self._scaled(batch.values))}

    def _step_rewards(self, batch: SegmentBatch) -> Tensor:
        rewards: Tensor = self.network(self._step_inputs(batch)).squeeze(-1)  # (B, L)
        return rewards


def perceptron(inputs: int, hidden: Sequence[int], outputs: int = 1) -> nn.Sequential:
    """Linear layers with ReLU between them; Xavier weights, zero biases."""
    layers: list[nn.Module] = []
    for before, after in itertools.pairwise((inputs, *hidden, outputs)):
        layer = nn.Linear(before, after)
        nn.init.xavier_uniform_(layer.weight)
        nn.init.zeros_(layer.bias)
        layers += [layer, nn.ReLU()]
    return nn.Sequential(*layers[:-1])
