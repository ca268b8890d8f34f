"""Diaster: step rewards are differences of what the beginnings of a segment are worth.

Lin et al., AAAI 2024 (arXiv 2312.10642): difference of implicitly assigned sub-trajectory reward.
A recurrent network S gives any run of steps a worth. Wherever a segment of m steps is cut, its two
parts are to be worth its score R together, and a step's reward is regressed on what the step adds:

    ( S(tau_1:c) + S(tau_c+1:m) - R )^2                         c drawn from 1 ... m; m: not cut
    ( rhat(s_t, a_t) - S(tau_1:t) + S(tau_1:t-1) )^2            S of no steps: 0; S(tau_1:m): R

So the targets of a segment's steps sum to its score, whatever S is. In the delayed setting each
segment is a trajectory.

Differences from the published code, which was at hand with the paper's abstract:

* There S has a second output, the logarithm of a variance by which normal noise is added to the
  first, in training and for the targets. The squared error drives it to its lower bound. It is
  left out here.
* Every 1000 environment steps there, 64 episodes are drawn, and S takes as many gradient steps on
  them as the longest has steps, each with a new cut; then rhat takes as many, each on 64 of the
  steps drawn. Here both take their gradient steps together, as many as there (1000 for episodes of
  that length), each on 64 segments drawn anew and on all of their steps.
* Whole episodes are divided by 10 there; here R is in units of the target scale c.
* Observations are standardised and cut off at 10 deviations; there they are not.
* Xavier weights of rhat, as for all perceptrons here; there those of torch, as here for S.

As there, one cut serves all segments of a batch (a shorter one is then whole), segments are drawn
in proportion to their lengths, and gradients of the second loss do not reach S.

The formula beside its symbols: docs/methods.md#diaster.
"""

from collections.abc import Iterator
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from codetr_ros.config import DiasterSettings
from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.rewards.base import segment_steps
from codetr_ros.rewards.learned import CLIP, Learned
from codetr_ros.rewards.mlp import perceptron
from codetr_ros.rewards.rrd import draw_by_length


class Diaster(Learned):
    """Learns what parts of segments are worth, and labels steps with the expected differences.

    Args:
        settings: the run's settings; the initial weights depend on its seed.
        observation_size: O.
        action_size: A.
    """

    name: ClassVar[str] = 'diaster'
    group: ClassVar[str] = 'diaster'
    clip: ClassVar[float] = CLIP
    network: 'SubTrajectories'

    def _make_network(self, observation_size: int, action_size: int) -> 'SubTrajectories':
        return SubTrajectories(observation_size + action_size, self._settings.diaster)

    def _terms(
        self, memory: Trajectories, rng: np.random.Generator
    ) -> Iterator[dict[str, Tensor]]:
        """`reward_loss` of the cut segments, and `step_loss` of the step rewards."""
        batch = memory.segments.batch(draw_by_length(memory, rng, self._settings.diaster.batch))
        cut = int(rng.integers(1, batch.actions.shape[1] + 1))
        steps = self._step_inputs(batch)
        lengths, returns = self._put(batch.lengths), self._scaled(batch.values)
        worth = self.network.cut_worth(steps, lengths, cut)  # (B,)
        with torch.no_grad():
            targets = differences(self.network.worths(steps), lengths, returns)  # (B, L)
        inside = self._put(segment_steps(batch))
        error = (self.network.rewards(steps) - targets) * inside
        yield {
            'reward_loss': F.mse_loss(worth, returns),
            'step_loss': (error**2).sum() / inside.sum(),
        }

    def _step_rewards(self, batch: SegmentBatch) -> Tensor:
        return self.network.rewards(self._step_inputs(batch))


class SubTrajectories(nn.Module):
    """The worth S of runs of steps, and the rewards rhat of single ones.

    Args:
        inputs: D, numbers that describe a step.
        settings: widths.
    """

    def __init__(self, inputs: int, settings: DiasterSettings) -> None:
        super().__init__()
        self.recurrent = nn.GRU(inputs, settings.width, batch_first=True)
        self.worth = nn.Linear(settings.width, 1)
        self.step = perceptron(inputs, settings.hidden)

    def worths(self, steps: Tensor) -> Tensor:
        """S (B, L) of runs of the steps (B, L, D): from the first up to each."""
        states, _ = self.recurrent(steps)
        worths: Tensor = self.worth(states).squeeze(-1)
        return worths

    def cut_worth(self, steps: Tensor, lengths: Tensor, cut: int) -> Tensor:
        """S (B,) of the first `cut` steps of each segment, and of the rest if there is one."""
        first = at(self.worths(steps[:, :cut]), lengths.clamp(max=cut))
        if cut == steps.shape[1]:
            return first
        rest = at(self.worths(steps[:, cut:]), (lengths - cut).clamp(min=1))
        return first + torch.where(lengths > cut, rest, 0.0)

    def rewards(self, steps: Tensor) -> Tensor:
        """Rhat (B, L)."""
        rewards: Tensor = self.step(steps).squeeze(-1)
        return rewards


def at(worths: Tensor, lengths: Tensor) -> Tensor:
    """The worths (B,) of the first so many steps."""
    return worths.gather(1, lengths[:, None] - 1).squeeze(1)


def differences(worths: Tensor, lengths: Tensor, returns: Tensor) -> Tensor:
    """What each step adds (B, L): the worth of the steps up to it, less that without it.

    Args:
        worths: S (B, L) of the steps up to each; in place of a segment's last comes its score.
        lengths: m (B,); differences beyond have no meaning.
        returns: R (B,).
    """
    worths = worths.scatter(1, lengths[:, None] - 1, returns[:, None])
    return torch.diff(worths, dim=1, prepend=torch.zeros_like(worths[:, :1]))
