"""Step rewards for a bag that keeps only the first label of each segment."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from codetr_ros.config import Settings
from codetr_ros.records import I64, U32, U64, StepRewards

_EPISODE_BITS = np.uint64(32)
_NONE: tuple[U64, I64] = np.empty(0, np.uint64), np.empty(0, np.int64)


class FirstLabels:
    """Reduces step rewards to what goes into the bag.

    Every part is kept, so that the bag has as many as were published. A part keeps the segments
    labelled for the first time, or all of them where the phase's policy is evaluated. Segments are
    whole the first time; later rows may be some of their steps (`relabel` 'drawn').

    Memory: 16 bytes for each segment that the reward side may hold, for each source. The reward
    side evicts whole episodes, oldest first, and does not label them again. An episode is
    forgotten here once the labelled steps of the newer ones of its source exceed `memory_steps`.
    If it were labelled after all, those labels would be written twice, not lost.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        # of each source: (episode << 32) | first step, sorted; steps of these segments
        self._seen: dict[str, tuple[U64, I64]] = {}

    def keep(self, part: StepRewards) -> StepRewards | None:
        """The part reduced to what is kept; None if all of it is kept."""
        fresh = self._note(part.source, part.episodes, part.first_steps, part.lengths)
        if fresh.all() or self._settings.evaluated(part.phase):
            return None
        return replace(
            part,
            source=part.source if fresh.any() else '',
            episodes=part.episodes[fresh],
            first_steps=part.first_steps[fresh],
            lengths=part.lengths[fresh],
            labels=part.labels[np.repeat(fresh, part.lengths)],
        )

    def _note(
        self, source: str, episodes: U32, first_steps: U32, lengths: U32
    ) -> NDArray[np.bool_]:
        """Which segments are new. From now on they, and whatever lies in them, are not."""
        given = episodes.astype(np.uint64) << _EPISODE_BITS | first_steps
        keys, steps = self._seen.get(source, _NONE)
        ends = np.concatenate([np.zeros(1, np.uint64), keys + steps.astype(np.uint64)])
        # the end of the last segment that begins there or before; 0 where there is none
        fresh: NDArray[np.bool_] = given >= ends[np.searchsorted(keys, given, 'right')]
        if fresh.any():
            keys = np.concatenate([keys, given[fresh]])
            steps = np.concatenate([steps, lengths[fresh].astype(np.int64)])
            order = np.argsort(keys, kind='stable')
            self._seen[source] = self._of_memory(keys[order], steps[order])
        return fresh

    def _of_memory(self, keys: U64, steps: I64) -> tuple[U64, I64]:
        """Drop the episodes that are evicted by now."""
        episodes = keys >> _EPISODE_BITS
        upto = np.cumsum(steps)
        newer = upto[-1] - upto[np.searchsorted(episodes, episodes, 'right') - 1]
        held = newer <= self._settings.memory_steps
        return keys[held], steps[held]
