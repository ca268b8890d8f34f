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
        self._segments = max(2, settings.codetr.window // settings.delay) if several else 1
        context = (self._segments - 1) * settings.delay
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
        row, place = places([len(window) for window in windows])
        inside = side_by_side(self._put(segment_steps(batch)), row, place)  # (B, L)
        before = self._standardised(batch.observations[:, :-1])
        observations = side_by_side(before, row, place)  # (B, L, O)
        actions = side_by_side(self._put(batch.actions), row, place)  # (B, L, A)
        rewards, predicted = self.network(observations, actions, inside)  # (B, L), (B, L, O)
        after = self._standardised(batch.observations[:, 1:])
        following = side_by_side(after, row, place)  # (B, L, O)
        each = rewards.view(len(windows), -1, batch.actions.shape[1])[row, place]  # (S, n)
        sums = each.sum(1)  # (S,)
        state_loss = (predicted - following)[inside].square().mean()
        yield {
            'reward_loss': (sums - self._scaled(batch.values)).square().mean(),
            'state_loss': self._settings.rbt.state_loss_weight * state_loss,
        }

    def _read_off(self, observations: Tensor, actions: Tensor, inside: Tensor) -> Tensor:
        rewards: Tensor = self.network(observations, actions, inside)[0]
        return rewards


def places(sizes: list[int]) -> tuple[Tensor, Tensor]:
    """Each segment's window, and its place in it, for windows of these numbers of segments."""
    row = torch.repeat_interleave(torch.tensor(sizes))
    return row, torch.cat([torch.arange(size) for size in sizes])


def side_by_side(each: Tensor, row: Tensor, place: Tensor) -> Tensor:
    """Steps of segments (S, n, ...), laid out in their windows (B, L, ...), 0 elsewhere.

    All segments but the last of a window are as long as the longest, so that its steps follow on
    each other and padding lies on the right.
    """
    laid = each.new_zeros(int(row[-1]) + 1, int(place.max()) + 1, *each.shape[1:])
    laid[row, place] = each
    return laid.flatten(1, 2)


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
