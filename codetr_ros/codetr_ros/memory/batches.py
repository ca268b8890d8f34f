"""Batches from the memory D: labelled steps for SAC, segments for reward models."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codetr_ros.records import F32, F64, I64


@dataclass(frozen=True, eq=False, slots=True)
class StepBatch:
    """Labelled steps for the policy learner; B = batch, O = observation size, A = action size."""

    observations: F32  # (B, O), or (B, O + 2) with what critics see of the segment's progress
    actions: F32  # (B, A)
    rewards: F32  # (B,) inferred step rewards
    next_observations: F32  # as wide as observations
    terminated: NDArray[np.bool_]  # (B,) true: nothing is bootstrapped from the next observation


@dataclass(frozen=True, eq=False, slots=True)
class SegmentBatch:
    """Segments, or windows that end in one, padded with zeros on the right to L steps."""

    observations: F32  # (B, L+1, O): the observation before each step, and the one after the last
    actions: F32  # (B, L, A)
    lengths: I64  # (B,) steps in the window, context included
    context: I64  # (B,) leading steps that precede the segment
    values: F64  # (B,) the segment's composite reward; NaN: none, or only a window to be labelled
    true_rewards: F32 | None = None  # (B, L) if the memory holds them, for the oracle only
    terminated: NDArray[np.bool_] | None = None  # (B,) the last step led to a terminal state

    def part(self, rows: slice) -> 'SegmentBatch':
        """Some of the segments, in views of the same arrays."""
        rewards, ends = self.true_rewards, self.terminated
        return SegmentBatch(
            self.observations[rows],
            self.actions[rows],
            self.lengths[rows],
            self.context[rows],
            self.values[rows],
            None if rewards is None else rewards[rows],
            None if ends is None else ends[rows],
        )
