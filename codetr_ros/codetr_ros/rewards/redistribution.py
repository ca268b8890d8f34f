"""Reward methods that learn nothing: the delayed reward as it is or spread, the truth, a constant.

All of them state their rewards in the unit of the reward transformer (`target_scale`,
`reward_unit`), so that results differ only by how rewards are distributed.

The rules in a table: docs/methods.md#fixed-rules.
"""

from abc import abstractmethod

import numpy as np

from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.records import F32, F64
from codetr_ros.rewards.base import RewardMethod, RewardModelError, segment_steps


class Redistribution(RewardMethod):
    """A fixed rule from a segment and its composite reward to step rewards."""

    def label(self, batch: SegmentBatch) -> F32:
        """Step rewards (B, L) by the rule.

        Raises:
            RewardModelError: `prepare` was never called.
        """
        self._require_prepared()
        return (self._rule(batch, self.unit) * segment_steps(batch)).astype(np.float32)

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
    needs_true_rewards = True

    def _rule(self, batch: SegmentBatch, unit: float) -> F64:
        if batch.true_rewards is None:
            raise RewardModelError(
                "method 'true': the batch has no true_rewards; "
                'make the memory with true_rewards=True and run in process'
            )
        return batch.true_rewards / np.float64(unit)


class Ones(Redistribution):
    """A constant reward of 1 in any unit, whatever the scores are: the worth of survival alone."""

    name = 'ones'
    in_process_only = True

    def _rule(self, batch: SegmentBatch, unit: float) -> F32:
        return np.ones(batch.actions.shape[:2], np.float32)
