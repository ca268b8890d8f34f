"""IRCR: a step's reward is how good the score of its segment was, among all scores so far.

Gangwani et al., NeurIPS 2020 (arXiv 2010.12718): the guidance reward of a step is the min-max
normalised outcome of the trajectory that contains it. In the delayed setting each segment is a
trajectory, and every one of its steps gets

    (R - R_min) / (R_max - R_min)    in [0, 1]

Differences from the published code, and from the baseline that the authors of RBT ran, which is
the better guide to the paper's table:

* R is the segment's composite reward, as in RBT's baseline; the published code takes the
  trajectory's mean reward. A segment cut short is thus measured by a shorter sum.
* R_min and R_max are over all segments ever seen, as in RBT's baseline; the published code has
  those of its present buffers.
* Both normalise when the learner samples. Here labels are given once per phase, and anew to all
  steps in a phase in which an extreme has moved. The learner receives the same numbers, since
  nothing is scored within a phase.
* No heap of the best trajectories is sampled beside the memory, as in RBT's baseline.
* Where all scores are equal, none is better than another: all labels are 0 (decided here).
* A segment without a score is as good as one of the mean level of those that have one, within the
  extremes (decided here).

Labels are in [0, 1] by definition, so `target_scale` and `reward_unit` do not touch them. Since
they cannot be negative, every step of survival is worth something, whatever the scores are.

The formula beside its symbols: docs/methods.md#ircr.
"""

from collections.abc import Mapping
from dataclasses import replace
from typing import ClassVar

import numpy as np
import torch

from codetr_ros.config import Settings
from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F32
from codetr_ros.rewards.base import RewardMethod, segment_steps
from codetr_ros.rewards.evidence import links
from codetr_ros.rewards.unscored import LateScores, completed


class Ircr(RewardMethod):
    """Labels each step with its segment's score, normalised by all-time extremes."""

    name: ClassVar[str] = 'ircr'

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        super().__init__(settings, observation_size, action_size)
        self._link = links.make(settings.composite, settings.beta, settings.longest)
        self._late = LateScores(settings)
        self._moves = 0
        self._least = self._greatest = 0.0  # meaningless before the first move

    @property
    def version(self) -> int:
        """Phases in which an extreme has moved, and those in which late scores were others."""
        return self._moves + self._late.version

    @property
    def unit(self) -> float:
        """1: labels have no unit."""
        return 1.0

    def prepare(self, memory: Trajectories) -> None:
        """Look at the scores that the memory holds: the extremes may move, and the labels too."""
        super().prepare(memory)
        scores = memory.segments.scores(memory.segments.ids())
        extremes = float(scores.min()), float(scores.max())
        if self._moves:
            extremes = min(self._least, extremes[0]), max(self._greatest, extremes[1])
        if not self._moves or extremes != (self._least, self._greatest):
            self._least, self._greatest = extremes
            self._moves += 1
        self._late.note(memory)

    def _completed(self, memory: Trajectories, batch: SegmentBatch) -> SegmentBatch:
        whole = completed(memory, batch, self._link)
        within = np.clip(whole.values, self._least, self._greatest)
        return replace(whole, values=np.where(np.isnan(batch.values), within, whole.values))

    def label(self, batch: SegmentBatch) -> F32:
        """Step rewards (B, L); in [0, 1] for segments whose scores `prepare` has seen."""
        self._require_prepared()
        spread = self._greatest - self._least
        guidance = (batch.values - self._least) / spread if spread else np.zeros(len(batch.values))
        return (guidance[:, None] * segment_steps(batch)).astype(np.float32)

    def state(self) -> dict[str, torch.Tensor]:
        """The extremes, how often they have moved, and the target scale."""
        return super().state() | {
            'version': torch.tensor(self._moves, dtype=torch.int64),
            'least': torch.tensor(self._least, dtype=torch.float64),
            'greatest': torch.tensor(self._greatest, dtype=torch.float64),
            **self._late.state(),
        }

    def load_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Go on from a `state()`.

        Raises:
            RewardModelError: it is another method's; nothing has changed then.
        """
        super().load_state(state)
        self._moves = int(state['version'])
        self._late.load_state(state)
        self._least, self._greatest = float(state['least']), float(state['greatest'])
