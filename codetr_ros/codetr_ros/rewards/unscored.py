"""What stands in for the scores of segments that have none, where a rule needs one.

A learnt model labels such steps by itself. A rule spreads what is known: the mean level of all
segments of the memory that have a score, decided here. For sums that is the mean score per step.

By method: docs/methods.md#inexact-scores.
"""

from dataclasses import replace

import numpy as np

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
