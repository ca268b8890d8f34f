"""What stands in for the scores of segments that have none, where a rule needs one.

A learnt model labels such steps by itself. A rule spreads what is known: the mean level of all
segments of the memory that have a score, decided here. For sums that is the mean score per step.

By method: docs/methods.md#inexact-scores.

Where others than the simulator score, a rule also has to label a segment again once its score has
come, or was corrected: `LateScores` counts how often there were other scores than before.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from codetr_ros.config import Settings
from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.rewards.base import RewardModelError
from codetr_ros.rewards.evidence.link import Link


def completed(memory: Trajectories, batch: SegmentBatch, link: Link) -> SegmentBatch:
    """A batch whose segments without a score have that of segments of the mean known level.

    Args:
        memory: holds the segments.
        batch: some of them.
        link: from step rewards to scores.

    Raises:
        RewardModelError: no segment of the memory has a score.
    """
    missing = np.isnan(batch.values)
    if not missing.any():
        return batch
    ids, segments = memory.segments.ids(), memory.segments
    if not len(ids):
        raise RewardModelError(
            f'{int(missing.sum())} segments have no score, and no other one in memory has any: '
            'there is nothing to spread. Raise memory_steps, or label by a learnt method'
        )
    level = float(link.level(segments.scores(ids), segments.lengths(ids)).mean())
    m = (batch.lengths - batch.context)[missing]
    values = batch.values.copy()
    values[missing] = link.score(np.full(len(m), level), m)
    return replace(batch, values=values)


class LateScores:
    """Counts how often a rule has seen other scores than before, if they may come late.

    Args:
        settings: the run's settings.
    """

    def __init__(self, settings: Settings) -> None:
        self._may_be_late = settings.scored_elsewhere
        self._seen = 0
        self.version = 0
        """Phases in which there were other scores; 0 where the simulator scores."""

    def note(self, memory: Trajectories) -> None:
        """Look at the scores that the memory holds."""
        if not self._may_be_late:
            return
        seen = memory.segments.digest()
        self.version += seen != self._seen
        self._seen = seen

    def state(self) -> dict[str, torch.Tensor]:
        """The count, and what was seen last; nothing where the simulator scores."""
        numbers = {'late_version': self.version, 'late_seen': self._seen}
        known = numbers.items() if self._may_be_late else ()
        return {name: torch.tensor(number, dtype=torch.int64) for name, number in known}

    def load_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Go on from a `state()`."""
        if self._may_be_late:
            self.version, self._seen = int(state['late_version']), int(state['late_seen'])
