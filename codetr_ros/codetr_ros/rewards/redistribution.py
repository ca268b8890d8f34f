"""Reward methods that learn nothing: the delayed reward as it is or spread, the truth, a constant.

Their rewards are of the size of those of learnt methods, so that results differ only by how
rewards are distributed: the mean rewards of segments have the root mean square 1 when they are
first measured (`target_scale`, `reward_unit`).

The rules in a table: docs/methods.md#fixed-rules. The unit: docs/methods.md#scale.
"""

import hashlib
from abc import abstractmethod
from collections.abc import Mapping

import numpy as np
import torch
from torch import Tensor

from codetr_ros.config import Settings
from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F32, F64
from codetr_ros.rewards.base import RewardMethod, RewardModelError, segment_steps
from codetr_ros.rewards.evidence import links
from codetr_ros.rewards.evidence.link import Sum, level_scale
from codetr_ros.rewards.unscored import LateScores, completed
from codetr_ros.seeding import generator


class Redistribution(RewardMethod):
    """A fixed rule from a segment and its composite reward to step rewards.

    A segment without a score is treated as if it had the mean level of those that have one.
    """

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        super().__init__(settings, observation_size, action_size)
        self._link = links.make(settings.composite, settings.beta, settings.longest)
        self._late = LateScores(settings)

    @property
    def version(self) -> int:
        """Phases in which late scores have changed what segments are labelled by."""
        return self._late.version

    def prepare(self, memory: Trajectories) -> None:
        """Freeze the target scale, the first time; note scores that came late."""
        super().prepare(memory)
        self._late.note(memory)

    def state(self) -> dict[str, Tensor]:
        """The target scale, and what is known of late scores."""
        return super().state() | self._late.state()

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a `state()`.

        Raises:
            RewardModelError: it is another method's; nothing has changed then.
        """
        super().load_state(state)
        self._late.load_state(state)

    def _completed(self, memory: Trajectories, batch: SegmentBatch) -> SegmentBatch:
        return completed(memory, batch, self._link)

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


class StepReward(Redistribution):
    """A rule whose rewards are in the unit of step rewards, whatever the kind of score.

    The target scale is the root mean square level of the scores (`Link.level`): for sums it is
    that of the scores per step, c. Were it c for others too, the oracle's rewards would be many
    times as large as all others under a soft maximum, and vanish where scores are squares.
    """

    def prepare(self, memory: Trajectories) -> None:
        """Freeze the scale of levels, the first time."""
        if not self.target_scale and not self._of_scores and self._settings.target_scale == 'rms':
            ids, segments = memory.segments.ids(), memory.segments
            levels = self._link.level(segments.scores(ids), segments.lengths(ids))
            self.target_scale = level_scale(levels)
        super().prepare(memory)

    @property
    def _of_scores(self) -> bool:
        """Whether levels are scores per step, and their scale c."""
        return isinstance(self._link, Sum)

    def state(self) -> dict[str, Tensor]:
        """The target scale, and where it was another one before, that it is that of levels."""
        return super().state() | ({} if self._of_scores else {'of_levels': torch.tensor(1)})

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a `state()`.

        Raises:
            RewardModelError: it is another method's, or its unit is that of scores per step.
        """
        if not self._of_scores and state.keys() == {'target_scale'}:
            raise RewardModelError(
                f'state of method {self.name!r} refused: it has no of_levels. It was saved when '
                f'rewards of composite = {self._settings.composite!r} were in units of scores per '
                'step, no longer in that of their levels. Start the run again, or finish it with '
                'the version that began it'
            )
        super().load_state(state)


class Uniform(StepReward):
    """The even spread: on each step the constant step reward that explains the segment's score.

    For a sum R of m steps that is R / m.
    """

    name = 'uniform'

    def _rule(self, batch: SegmentBatch, unit: float) -> F64:
        level = self._link.level(batch.values, batch.lengths - batch.context)
        rewards: F64 = (level / unit)[:, None]
        return rewards


class Random(Redistribution):
    """A control: R split by random weights w of a segment's steps, w R on each; sum w = 1.

    All weights that sum to 1 are equally likely (normalised exponential numbers). They are drawn
    from the seed and what the segment's steps were, so that a segment has the same labels whenever
    and wherever it is labelled.
    """

    name = 'random'

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        super().__init__(settings, observation_size, action_size)
        self._seed = settings.seed

    def _rule(self, batch: SegmentBatch, unit: float) -> F64:
        rewards = np.zeros(batch.actions.shape[:2])
        for i, value in enumerate((batch.values / unit).tolist()):
            own = slice(int(batch.context[i]), int(batch.lengths[i]))
            steps = batch.observations[i, own].tobytes() + batch.actions[i, own].tobytes()
            rng = generator(self._seed, self.name, hashlib.sha256(steps).hexdigest())
            weights = rng.standard_exponential(own.stop - own.start)
            rewards[i, own] = value * weights / weights.sum()
        return rewards

    def state(self) -> dict[str, Tensor]:
        """The seed of the weights, and the target scale."""
        return super().state() | {'seed': torch.tensor(self._seed, dtype=torch.int64)}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a `state()`.

        Raises:
            RewardModelError: it is another method's; nothing has changed then.
        """
        super().load_state(state)
        self._seed = int(state['seed'])


class TrueReward(StepReward):
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
