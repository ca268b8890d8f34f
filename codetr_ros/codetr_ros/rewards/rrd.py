"""RRD: randomized return decomposition, which learns a sum from random subsequences.

Ren et al., ICLR 2022 (arXiv 2111.13485). A trajectory's mean reward per step is regressed on the
mean of rhat over K of its steps, drawn at random, so that a long trajectory costs no more than a
short one. In the delayed setting each segment is a trajectory. `rrd.loss` chooses between

    biased      ( R/m - (1/K) sum_{t in I} rhat_t )^2          I: K of the m steps
    unbiased    the same less the variance of that mean over the draws of I, as estimated from I

The second is in expectation the loss of the mean over all steps. The first is larger by that
variance: it also favours rewards that differ little within a segment.

Differences from the published code:

* Segments take the place of whole trajectories, so that often K > m; then steps are drawn with
  replacement, as there.
* There a gradient step of the reward net goes with every update of the policy learner, and rewards
  are computed as they are sampled. Here gradient steps come per phase, by default as many as a
  phase has steps, and the learner receives the labels of the phase's last net.
* R is in units of the target scale c and observations are standardised, as in all methods here;
  there neither is. The difference s - s' is that of the standardised ones, cut off at 10
  deviations.
* The learner is the SAC of all methods here.

The published code has the network (input s, a, s - s'; Xavier weights), the learning rate, four
subsequences of K = 64 steps, and draws trajectories in proportion to their lengths, as here. That
its Xavier weights are uniform, as here, is inferred; the paper itself was not at hand.

The formula beside its symbols: docs/methods.md#rrd.
"""

from collections.abc import Iterator
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import I64
from codetr_ros.rewards.learned import CLIP, Learned
from codetr_ros.rewards.mlp import perceptron


class Rrd(Learned):
    """Learns R(segment) = sum_t rhat(s_t, a_t, s_t+1) from random subsequences; labels with rhat.

    Args:
        settings: the run's settings; the initial weights depend on its seed.
        observation_size: O.
        action_size: A.
    """

    name: ClassVar[str] = 'rrd'
    group: ClassVar[str] = 'rrd'
    clip: ClassVar[float] = CLIP

    def _make_network(self, observation_size: int, action_size: int) -> nn.Module:
        return perceptron(2 * observation_size + action_size, self._settings.rrd.hidden)

    def _terms(
        self, memory: Trajectories, rng: np.random.Generator
    ) -> Iterator[dict[str, Tensor]]:
        rrd = self._settings.rrd
        drawn = draw_by_length(memory, rng, rrd.subsequences)
        batch = memory.segments.batch(drawn)
        steps = subsequences(rng, batch.lengths, rrd.subsequence_steps)  # (B, K)
        rewards = self._rewards_at(batch, steps)
        returns = self._scaled(batch.values / batch.lengths)
        lengths = self._put(batch.lengths)
        yield {
            'reward_loss': decomposition_loss(rewards, returns, lengths, rrd.loss == 'unbiased')
        }

    def _step_rewards(self, batch: SegmentBatch) -> Tensor:
        every = np.arange(batch.actions.shape[1])
        return self._rewards_at(batch, np.broadcast_to(every, batch.actions.shape[:2]))

    def _rewards_at(self, batch: SegmentBatch, steps: NDArray[np.int64]) -> Tensor:
        """Rhat (B, K) of these steps (B, K) of the segments."""
        row = np.arange(len(steps))[:, None]
        before = self._standardised(batch.observations[row, steps])  # (B, K, O)
        after = self._standardised(batch.observations[row, steps + 1])
        actions = self._put(batch.actions[row, steps])  # (B, K, A)
        inputs = torch.cat([before, actions, before - after], -1)  # (B, K, O + A + O)
        rewards: Tensor = self.network(inputs).squeeze(-1)
        return rewards


def draw_by_length(memory: Trajectories, rng: np.random.Generator, count: int) -> I64:
    """Ids of scored segments, drawn with replacement and in proportion to their lengths.

    Each uniformly drawn one is kept with probability length / delay, which needs no table of all
    lengths.
    """
    ids = memory.segments.ids()
    kept = np.empty(0, np.int64)
    while len(kept) < count:
        some = ids[rng.integers(0, len(ids), count)]
        lucky = rng.random(count) * memory.delay < memory.segments.lengths(some)
        kept = np.concatenate([kept, some[lucky]])
    return kept[:count]


def subsequences(rng: np.random.Generator, lengths: I64, size: int) -> NDArray[np.int64]:
    """`size` steps (B, K) of each segment, with replacement only where it has fewer than that."""
    return np.stack([rng.choice(m, size, replace=size > m) for m in lengths.tolist()])


def decomposition_loss(
    rewards: Tensor, returns: Tensor, lengths: Tensor, unbiased: bool
) -> Tensor:
    """The loss of random subsequences; the unbiased one may be negative.

    Args:
        rewards: rhat (B, K) of the steps drawn, K at least 2.
        returns: R/m (B,) of their segments.
        lengths: m (B,).
        unbiased: subtract what the variance of the mean over K steps adds in expectation. Its
            estimate is the sample variance over K, times 1 - K/m where steps are drawn without
            replacement.
    """
    loss = (returns - rewards.mean(1)) ** 2
    if unbiased:
        k = rewards.shape[1]
        share = torch.where(lengths >= k, 1 - k / lengths, 1.0)
        loss = loss - share * rewards.var(1) / k
    return loss.mean()
