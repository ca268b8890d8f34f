"""RBT: the reward bag transformer, whose attention outputs are the step rewards themselves.

Tang et al., TMLR 2025 (arXiv 2402.03771): "reinforcement learning from bagged reward".

    R(segment) = sum_t z_t,    z_t = sum_j softmax_j(q_t k_j) v_j

v_j is linear in the causal state of step j, and the softmax is bidirectional. This is CoDeTr's
network, with the rows of its attention read where CoDeTr reads the columns. The loss is the
squared error of the sums plus that of the next observation, predicted from the causal state. Steps
are labelled with z_t.

The attention must see more than one segment. Within a single one sum_t z_t = sum_j w_j v_j, which
is what CoDeTr predicts with the same weights: any credit inside the segment gives the same sum,
and the one that is learnt is arbitrary. Where a window has several segments, each with a score of
its own, z_t must attend to its surroundings. `rbt.attention_scope` 'segment' exists to show that.

Differences from the published code, as far as it could be read; the paper itself was not at hand:

* There a batch is 64 windows of 500 consecutive steps. They cross episodes and cut bags, and a cut
  bag is scored by its share. Here windows are runs of whole segments of one episode: as many as
  fit into `codetr.window` steps, two at least, that end with a segment drawn uniformly; and as
  many windows as make up `codetr.batch` segments (fewer where an episode has fewer before it).
* There the loss on sums is divided by the number of steps, here by that of segments: it does not
  shrink where segments are long.
* There the next state is predicted from the action's token, which has not seen the state. Here it
  is predicted from the state's token, which has seen both.
* There a step's label is the output of the last step of the window of H = 100 steps that ends with
  it, as here if `codetr.labelling` is 'window'. By default a segment's steps are labelled in one
  pass, from the window of segments that ends with theirs.
* Composite rewards are in units of the target scale c. Observations, the predicted ones too, are
  standardised and cut off at 10 deviations. Architecture, attention scale, initial weights,
  learning rate and number of gradient steps follow the settings `codetr`, so that RBT is compared
  with CoDeTr and not with other settings. The published code has one head, unscaled attention, a
  learning rate of 1e-4 that rises to 1e-3 and falls again, and four times as many gradient steps.

The formula beside its symbols: docs/methods.md#rbt.
"""

from collections.abc import Iterator
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from codetr_ros.config import CodetrSettings, Settings
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import I64
from codetr_ros.rewards.base import segment_steps
from codetr_ros.rewards.learned import CLIP
from codetr_ros.rewards.sequence import SequenceMethod
from codetr_ros.rewards.transformer import CausalTransformer, SequenceWeights, initialise


class Rbt(SequenceMethod):
    """Learns R(segment) = sum_t z_t and the next observations; labels steps with z_t.

    Args:
        settings: the run's settings; the initial weights depend on its seed.
        observation_size: O.
        action_size: A.
    """

    name: ClassVar[str] = 'rbt'
    clip: ClassVar[float] = CLIP  # of the observations that it predicts

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        several = settings.rbt.attention_scope == 'window'
        self._segments = max(2, settings.codetr.window // settings.longest) if several else 1
        context = (self._segments - 1) * settings.longest
        super().__init__(settings, observation_size, action_size, context, whole_window=several)

    def _make_network(self, observation_size: int, action_size: int) -> 'BagTransformer':
        return BagTransformer(observation_size, action_size, self._positions, self._codetr)

    def _terms(
        self, memory: Trajectories, rng: np.random.Generator
    ) -> Iterator[dict[str, Tensor]]:
        """`reward_loss` of the sums, and `state_loss` of next observations times its weight."""
        ids = memory.segments.ids()
        last = ids[rng.integers(0, len(ids), -(-self._codetr.batch // self._segments))]
        windows = memory.segments.runs(last, self._segments)
        batch = memory.segments.batch(np.concatenate(windows))  # (S, n): S segments of all windows
        layout = Layout([len(window) for window in windows], batch.lengths)
        own = self._put(segment_steps(batch))  # (S, n)
        inside = layout.side_by_side(own)  # (B, L)
        before = self._standardised(batch.observations[:, :-1])
        observations = layout.side_by_side(before)  # (B, L, O)
        actions = layout.side_by_side(self._put(batch.actions))  # (B, L, A)
        rewards, predicted = self.network(observations, actions, inside)  # (B, L), (B, L, O)
        after = self._standardised(batch.observations[:, 1:])
        following = layout.side_by_side(after)  # (B, L, O)
        sums = (layout.taken_apart(rewards) * own).sum(1)  # (S,)
        state_loss = (predicted - following)[inside].square().mean()
        yield {
            'reward_loss': (sums - self._scaled(batch.values)).square().mean(),
            'state_loss': self._settings.rbt.state_loss_weight * state_loss,
        }

    def _read_off(self, observations: Tensor, actions: Tensor, inside: Tensor) -> Tensor:
        rewards: Tensor = self.network(observations, actions, inside)[0]
        return rewards


class Layout:
    """Where the steps of segments, padded to n, lie in windows of several segments.

    The segments of a window follow on each other without a gap. Windows have room for L steps: for
    as many segments as the largest has, each as long as the longest.

    Args:
        sizes: numbers of segments of the windows (B,).
        lengths: steps of all segments (S,), window after window.
    """

    def __init__(self, sizes: list[int], lengths: I64) -> None:
        self.row = torch.repeat_interleave(torch.tensor(sizes))  # (S,) each segment's window
        self.first = torch.empty(len(lengths), dtype=torch.int64)  # (S,) its first step's place
        steps = torch.from_numpy(lengths)
        for part in torch.split(torch.arange(len(lengths)), sizes):
            self.first[part] = steps[part].cumsum(0) - steps[part]
        n = int(steps.max())
        self.size = len(sizes), max(sizes) * n  # B, L
        ends = torch.cumsum(torch.tensor(sizes), 0) - 1
        # the last of a window with its padding, the others without: no two share a place
        taken = torch.arange(n) < steps[:, None]
        taken[ends] = True
        self._segment, self._step = taken.nonzero(as_tuple=True)
        self._n = n

    def side_by_side(self, each: Tensor) -> Tensor:
        """Steps of segments (S, n, ...), laid out in their windows (B, L, ...), 0 elsewhere."""
        laid = each.new_zeros(*self.size, *each.shape[2:])
        segment, step = self._segment, self._step
        laid[self.row[segment], self.first[segment] + step] = each[segment, step]
        return laid

    def taken_apart(self, laid: Tensor) -> Tensor:
        """Numbers of the steps of windows (B, L) as (S, n); of any value beyond a segment."""
        return laid[self.row[:, None], self.first[:, None] + torch.arange(self._n)]


class BagTransformer(nn.Module):
    """Maps the steps of a window to their rewards z and the observations that follow them.

    Its modules have the names of those of `RewardTransformer`, whose weights fit it.

    Args:
        observation_size: O.
        action_size: A.
        positions: steps of the longest window that can occur.
        settings: architecture and dropout.
    """

    def __init__(
        self, observation_size: int, action_size: int, positions: int, settings: CodetrSettings
    ) -> None:
        super().__init__()
        self.causal = CausalTransformer(observation_size, action_size, positions, settings)
        self.weights = SequenceWeights(settings)
        self.reward = nn.Linear(settings.embedding, 1)
        self.next_observation = nn.Linear(settings.embedding, observation_size)
        initialise(self, settings)

    def forward(
        self, observations: Tensor, actions: Tensor, inside: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Rewards and next observations of every step.

        Args:
            observations: (B, L, O) before each step.
            actions: (B, L, A).
            inside: (B, L) bool, the steps that attend to each other; at least one in each row.

        Returns:
            z (B, L), 0 outside, and predicted observations (B, L, O), meaningless in the padding.
        """
        x = self.causal(observations, actions)  # (B, L, d)
        attention = self.weights.attention(x, inside)  # (B, L, L)
        z = (attention @ self.reward(x)).squeeze(-1)  # (B, L)
        return z, self.next_observation(x)
