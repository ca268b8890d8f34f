"""CoDeTr: a reward transformer, trained to compose composite rewards from step rewards.

The formula beside its symbols: docs/methods.md#codetr.
"""

from collections.abc import Iterator
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F

from codetr_ros.config import Settings
from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F32, F64
from codetr_ros.rewards.base import segment_steps
from codetr_ros.rewards.sequence import SequenceMethod
from codetr_ros.rewards.transformer import RewardTransformer


class Codetr(SequenceMethod):
    """Learns R(segment) = sum_t w_t rhat_t by regression; labels steps with w_t rhat_t or rhat_t.

    The switches of `CodetrSettings`, beyond their descriptions:

    * `context` puts steps of the episode before the segment, in training and in labelling; the
      loss and the labels are the segment's own in any case. With 'window' all of them make up to
      `window` steps. That is our reading of the supplement's "sequence length used for
      prediction", H = 100. Its windows end with segments: with n = 25, steps see the 75 to 99
      steps before them, and one pass labels n steps.
    * `attention_scope` 'window' lets all steps of the window attend to all. The weights of the
      window's steps then sum to their number, and those of the segment to its share of that.
    * `labelling` 'window' takes the last `window` steps, in the segment or not, and keeps only the
      output of the last step. With `label` 'rhat' that is what Preference Transformer does; with
      'product' the weight of the step is its weight within that window. All steps see `window`-1
      steps before them, at the cost of a pass for each. If `context` is 'segment', places beyond
      the delay occur in labelling only, untrained.

    Args:
        settings: the run's settings; the initial weights depend on its seed.
        observation_size: O.
        action_size: A.
    """

    name: ClassVar[str] = 'codetr'
    network: RewardTransformer

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        codetr = settings.codetr
        before = {
            'segment': 0,
            'window': max(0, codetr.window - settings.longest),
            'episode': codetr.window,
        }
        super().__init__(
            settings,
            observation_size,
            action_size,
            context=before[codetr.context],
            whole_window=codetr.attention_scope == 'window',
        )

    def components(self, batch: SegmentBatch) -> tuple[F32, F32]:
        """Weights w and rewards rhat (in units of c) of the segments' steps, (B, L) each."""
        self._require_prepared()
        self.network.eval()
        with torch.inference_mode():
            parts = [self.network(*self._inputs(part)) for part in self._parts(batch)]
        outside = ~segment_steps(batch)
        w, rhat = (torch.cat(each).cpu().numpy() for each in zip(*parts, strict=True))
        w[outside] = 0  # with a window's scope the context has weights too
        rhat[outside] = 0
        return w, rhat

    def step_weights(self, batch: SegmentBatch) -> F32:
        """Weights w (B, L), 1 on average over a segment's steps."""
        return self.components(batch)[0]

    def predict(self, batch: SegmentBatch) -> F64:
        """The predicted composite rewards R_hat (B,), in the task's unit, whatever the label."""
        weights, rewards = self.components(batch)
        predicted: F64 = (weights.astype(np.float64) * rewards).sum(1) * self.target_scale
        return predicted

    def _make_network(self, observation_size: int, action_size: int) -> RewardTransformer:
        return RewardTransformer(observation_size, action_size, self._positions, self._codetr)

    def _terms(
        self, memory: Trajectories, rng: np.random.Generator
    ) -> Iterator[dict[str, Tensor]]:
        batch = memory.segments.sample(rng, self._codetr.batch, self.context)
        for part in self._parts(batch):
            weights, rewards = self.network(*self._inputs(part))  # (b, L) each
            inside = self._put(segment_steps(part))
            predicted = (weights * rewards * inside).sum(1)  # (b,)
            error = F.mse_loss(predicted, self._scaled(part.values), reduction='sum')
            yield {'reward_loss': error / len(batch.values)}

    def _predicted(self, batch: SegmentBatch) -> Tensor:
        weights, rewards = self.network(*self._inputs(batch))  # (B, L) each
        predicted: Tensor = (weights * rewards * self._put(segment_steps(batch))).sum(1)
        return predicted

    def _read_off(self, observations: Tensor, actions: Tensor, inside: Tensor) -> Tensor:
        """Step rewards; with `label` 'product' they sum to a segment's predicted score."""
        weights, rewards = self.network(observations, actions, inside)
        labels: Tensor = weights * rewards if self._codetr.label == 'product' else rewards
        return labels
