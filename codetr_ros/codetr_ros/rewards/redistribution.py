"""Reward methods that learn nothing: the delayed reward as it is or spread, the truth, a constant.

All of them state their rewards in the unit of the reward transformer (`target_scale`,
`reward_unit`), so that what a learner makes of them differs by how rewards are distributed and by
nothing else.
"""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar

import numpy as np
import torch

from codetr_ros.config import Settings
from codetr_ros.records import F32, F64
from codetr_ros.rewards.method import RewardModelError, check_state, measure_scale, segment_steps
from codetr_ros.trajectories import SegmentBatch, Trajectories


class Redistribution(ABC):
    """A fixed rule from a segment and its composite reward to step rewards.

    Args:
        settings: the run's settings.
        observation_size: O, of no interest to a rule.
        action_size: A, of no interest to a rule.
    """

    name: ClassVar[str]
    in_process_only: ClassVar[bool] = False
    frozen: ClassVar[bool] = True
    version = 0
    context = 0

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        self._settings = settings
        self.target_scale = 0.0

    def prepare(self, memory: Trajectories) -> None:
        """Freeze the target scale c."""
        self.target_scale = measure_scale(self._settings.target_scale, memory)

    def gradient_step(self, memory: Trajectories, rng: np.random.Generator) -> dict[str, float]:
        """Learn nothing."""
        return {}

    def label(self, batch: SegmentBatch) -> F32:
        """Step rewards (B, L) by the rule.

        Raises:
            RewardModelError: `prepare` was never called.
        """
        if not self.target_scale:
            raise RewardModelError(
                f'method {self.name!r} has no target scale yet: call prepare(memory) before label'
            )
        unit = self.target_scale if self._settings.reward_unit == 'scaled' else 1.0
        return (self._rule(batch, unit) * segment_steps(batch)).astype(np.float32)

    def label_windows(self, batch: SegmentBatch) -> F32:
        """Refused: a window does not know its segment's composite reward.

        Raises:
            RewardModelError: always.
        """
        raise RewardModelError(
            f'method {self.name!r} labels whole segments, not windows: call label'
        )

    def state(self) -> dict[str, torch.Tensor]:
        """The target scale."""
        return {'target_scale': torch.tensor(self.target_scale, dtype=torch.float64)}

    def load_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Go on from a `state()`.

        Raises:
            RewardModelError: it is another method's; nothing has changed then.
        """
        check_state(self.name, self.state(), state)
        self.target_scale = float(state['target_scale'])

    @abstractmethod
    def _rule(self, batch: SegmentBatch, unit: float) -> F32 | F64:
        """Rewards in units of `unit`, broadcastable to (B, L), of any value elsewhere."""


class LastStep(Redistribution):
    """The raw delayed reward: all of it on the segment's last step (the paper's plain SAC)."""

    name = 'none'

    def _rule(self, batch: SegmentBatch, unit: float) -> F64:
        last = np.arange(batch.actions.shape[1]) == batch.lengths[:, None] - 1
        rewards: F64 = last * (batch.values / unit)[:, None]
        return rewards


class Uniform(Redistribution):
    """The composite reward R of a segment of m steps spread evenly: R / m on each."""

    name = 'uniform'

    def _rule(self, batch: SegmentBatch, unit: float) -> F64:
        rewards: F64 = (batch.values / (batch.lengths - batch.context) / unit)[:, None]
        return rewards


class TrueReward(Redistribution):
    """The oracle: the environment's own step rewards. In process only; no node may see them."""

    name = 'true'
    in_process_only = True

    def _rule(self, batch: SegmentBatch, unit: float) -> F64:
        if batch.true_rewards is None:
            raise RewardModelError(
                "method 'true': the batch has no true_rewards; "
                'make the memory with true_rewards=True and run in process'
            )
        return batch.true_rewards / np.float64(unit)


class Ones(Redistribution):
    """A constant reward of 1 in any unit, whatever the scores say: what survival is worth."""

    name = 'ones'
    in_process_only = True

    def _rule(self, batch: SegmentBatch, unit: float) -> F32:
        return np.ones(batch.actions.shape[:2], np.float32)
