"""RBT: the reward bag transformer, whose attention outputs are the step rewards themselves.

Tang et al., TMLR 2025 (arXiv 2402.03771): "reinforcement learning from bagged reward".

    R(segment) = sum_t z_t,    z_t = sum_j softmax_j(q_t k_j) v_j

v_j is linear in the causal state of step j, and the softmax is bidirectional: CoDeTr's network,
read in its rows where CoDeTr has its columns, so that with the same weights both predict the same
sums (sum_t z_t = sum_j w_j v_j). The loss is the squared error of the sums plus that of the next
observation, predicted from the causal state. Steps are labelled with z_t.

What differs from the published code, as far as that could be read; the paper itself was not at
hand:

* There a batch is 64 windows of 500 consecutive steps, which cross episodes and cut bags, a cut
  bag being scored by its share; all steps of a window attend to each other. Here it is segments,
  as for CoDeTr: whole, of one episode, attending within themselves. With `rbt.attention_scope`
  'window' up to `codetr.window` steps before a segment are seen and attended to as well; the loss
  on sums remains the segment's own.
* There the loss on sums is divided by the number of steps, here by that of segments: it does not
  shrink where segments are long.
* There actions precede states among the tokens, and the next state is predicted from the action's
  token, which has not seen the state. Here the token has seen both.
* There labels are those of the last steps of windows of H = 100 steps, as here if
  `codetr.labelling` is 'window'. By default whole segments are labelled, in one pass.
* Composite rewards are in units of the target scale c and observations, the predicted ones too,
  are standardised. Architecture, attention scale, initial weights, learning rate and number of
  gradient steps are by the settings `codetr`, so that RBT is compared with CoDeTr and not with
  other settings. There it is one head, an unscaled attention, a learning rate of 1e-4 that rises
  to 1e-3 and falls again, and four times as many gradient steps.
"""

from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from codetr_ros.config import CodetrSettings, Settings
from codetr_ros.rewards.method import segment_steps
from codetr_ros.rewards.sequence import SequenceMethod
from codetr_ros.rewards.transformer import CausalTransformer, SequenceWeights, initialise
from codetr_ros.trajectories import SegmentBatch, Trajectories


class Rbt(SequenceMethod):
    """Learns R(segment) = sum_t z_t and the next observations; labels steps with z_t.

    Args:
        settings: the run's settings; the initial weights depend on its seed.
        observation_size: O.
        action_size: A.
    """

    name: ClassVar[str] = 'rbt'

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        whole_window = settings.rbt.attention_scope == 'window'
        context = settings.codetr.window if whole_window else 0
        super().__init__(settings, observation_size, action_size, context, whole_window)

    def _make_network(self, observation_size: int, action_size: int) -> 'BagTransformer':
        return BagTransformer(observation_size, action_size, self._positions, self._codetr)

    def _terms(self, memory: Trajectories, rng: np.random.Generator) -> dict[str, Tensor]:
        """`reward_loss` of the sums, and `state_loss` of next observations times its weight."""
        batch = memory.sample_segments(rng, self._codetr.batch, self.context)
        observations, actions, inside = self._inputs(batch)
        rewards, predicted = self.network(observations, actions, inside)  # (B, L), (B, L, O)
        sums = (rewards * torch.from_numpy(segment_steps(batch))).sum(1)  # (B,)
        following = self._standardised(batch.observations[:, 1:])  # (B, L, O)
        state_loss = (predicted - following)[inside].square().mean()
        return {
            'reward_loss': (sums - self._scaled(batch.values)).square().mean(),
            'state_loss': self._settings.rbt.state_loss_weight * state_loss,
        }

    def _step_rewards(self, batch: SegmentBatch) -> Tensor:
        rewards: Tensor = self.network(*self._inputs(batch))[0]
        return rewards


class BagTransformer(nn.Module):
    """Steps of a window to their rewards z and the observations that follow them.

    Its modules are called as those of `RewardTransformer`, whose weights fit it.

    Args:
        observation_size: O.
        action_size: A.
        positions: steps of the longest window that will ever come.
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
            z (B, L), 0 outside, and predicted observations (B, L, O), of no meaning in the
            padding.
        """
        x = self.causal(observations, actions)  # (B, L, d)
        attention = self.weights.attention(x, inside)  # (B, L, L)
        z = (attention @ self.reward(x)).squeeze(-1)  # (B, L)
        return z, self.next_observation(x)
