"""The labelled steps of the memory D: step rewards, the versions that gave them, and draws."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codetr_ros.memory.batches import StepBatch
from codetr_ros.memory.ring import PROGRESS, ranges
from codetr_ros.memory.segments import segment_ids
from codetr_ros.memory.store import Store
from codetr_ros.records import F32, I64, U32, RecordError, StepRewards

Slots = NDArray[np.uint32] | NDArray[np.int64]


class LabelledSteps:
    """The steps of a store that have a step reward.

    They are numbered source by source, in the order of names, and within a source by their slots.
    Such a number is a step's place among them. It is valid until the next change of the memory.

    Args:
        store: where the steps lie.
        longest: steps n of the longest segment.
    """

    def __init__(self, store: Store, longest: int) -> None:
        self._store = store
        self._longest = longest
        # (place of the source) * (rows of a source) + slot, of each labelled step
        self._slots: Slots | None = None

    # ------------------------------------------------------------------------------------------
    # changing

    def apply(self, rewards: StepRewards) -> int:
        """Store labels, except those of evicted episodes.

        Returns:
            The number of labels that were left out.

        Raises:
            RecordError: a label is for steps that are not here; nothing is stored then.
        """
        if len(rewards.lengths) == 0:
            return 0
        source = self._store.source(rewards.source)
        if source is None:
            raise RecordError(
                f'step rewards for {rewards.source!r}, which sent no steps; sources: '
                f'{[source.name for source in self._store.sources]}'
            )
        starts = np.zeros(len(rewards.lengths), np.int64)
        evicted = np.zeros(len(starts), np.bool_)
        newest = source.newest.number if source.newest else -1
        triples = zip(
            rewards.episodes.tolist(),
            rewards.first_steps.tolist(),
            rewards.lengths.tolist(),
            strict=True,
        )
        for i, (number, first, length) in enumerate(triples):
            episode = source.by_number.get(number)
            if episode is None and number <= newest:
                evicted[i] = True
            elif episode is None or first + length > episode.steps:
                raise RecordError(
                    f'step rewards of phase {rewards.phase} for {rewards.source!r}, episode '
                    f'{number}, first_step {first}, length {length}: these steps are not here'
                )
            else:
                starts[i] = episode.start + first
        keep = np.repeat(~evicted, rewards.lengths)
        slots = ranges(starts, rewards.lengths.astype(np.int64))[keep] % source.capacity
        source.labels[slots] = rewards.labels[keep]
        source.versions[slots] = rewards.version
        if source.progress is not None:
            source.progress[slots] = self._progress(rewards.labels, rewards.lengths)[keep]
        self.forget()
        return int(np.count_nonzero(~keep))

    def _progress(self, labels: F32, lengths: U32) -> F32:
        """How far whole segments have come before and after each of their steps: (T, 2, PROGRESS).

        The worth so far is the sum of the labels so far, p(z_t), over n; the share is t / n. After
        its last step a segment has gone back to where the next one begins: both are 0.
        """
        ends = np.cumsum(lengths, dtype=np.int64)
        firsts = ends - lengths
        sums = np.concatenate([[0.0], np.cumsum(labels, dtype=np.float64)])
        begun = np.repeat(firsts, lengths)
        steps = np.arange(len(labels))
        after = np.stack([sums[steps + 1] - sums[begun], steps + 1 - begun], 1) / self._longest
        after[ends - 1] = 0
        before = np.roll(after, 1, axis=0)
        return np.stack([before, after], 1).astype(np.float32)

    def restore(self, columns: Mapping[str, Mapping[str, NDArray[Any]]]) -> None:
        """Give all steps held the labels that `columns` had: for each name, by source."""
        for name, by_source in columns.items():
            for source in self._store.sources:
                slots = np.arange(source.start, source.end) % source.capacity
                getattr(source, name)[slots] = by_source[source.name]
        self.forget()

    def forget(self) -> None:
        """Drop the list of labelled steps: it is made anew when it is next needed."""
        self._slots = None

    # ------------------------------------------------------------------------------------------
    # reading

    @property
    def count(self) -> int:
        """Steps that have a step reward."""
        return len(self._places())

    def columns(self) -> dict[str, dict[str, NDArray[Any]]]:
        """What is known of each source's steps (T,), in order: `labels`, NaN where there is none,
        `versions` of the models that gave them, and `progress` where it is kept.
        """
        names = ('labels', 'versions', *(('progress',) if self._store.progress else ()))
        return {name: self._by_source(name) for name in names}

    def _by_source(self, name: str) -> dict[str, NDArray[Any]]:
        return {
            source.name: getattr(source, name)[
                np.arange(source.start, source.end) % source.capacity
            ]
            for source in self._store.sources
        }

    def of(self, name: str, episodes: U32, first_steps: U32, lengths: U32) -> F32:
        """The labels of spans of steps that are held, one span after the other.

        Args:
            name: of their source; where there is no span it may be of none.
            episodes: (S,).
            first_steps: (S,) of each span, within its episode.
            lengths: (S,) steps of each.
        """
        source = self._store.source(name)
        if source is None:
            return np.empty(0, np.float32)
        starts = np.array([source.by_number[n].start for n in episodes.tolist()], np.int64)
        slots = ranges(starts + first_steps, lengths.astype(np.int64)) % source.capacity
        labels: F32 = source.labels[slots]
        return labels

    def versions(self) -> I64:
        """The version of the model that gave each labelled step its label."""
        rings = self._store.by_name()
        parts = [s.versions[: s.used][np.isfinite(s.labels[: s.used])] for s in rings]
        return np.concatenate([np.empty(0, np.int64), *parts])

    def draw(self, rng: np.random.Generator, batch: int) -> I64:
        """Places (B,) among the labelled steps, drawn uniformly, with replacement.

        Consecutive draws are the same in batches of any size.

        Raises:
            ValueError: no step is labelled.
        """
        if not self.count:
            raise ValueError('no step of the memory is labelled: nothing to sample')
        return rng.integers(0, self.count, batch)

    def sample(self, rng: np.random.Generator, batch: int) -> StepBatch:
        """Draw labelled steps uniformly, with replacement.

        Raises:
            ValueError: no step is labelled.
        """
        drawn = self._places()[self.draw(rng, batch)].astype(np.int64)
        sources = self._store.by_name()
        if len(sources) == 1:
            return sources[0].steps_in(drawn)
        width = self._store.observation_size + (PROGRESS if self._store.progress else 0)
        observations = np.empty((batch, width), np.float32)
        result = StepBatch(
            observations,
            np.empty((batch, self._store.action_size), np.float32),
            np.empty(batch, np.float32),
            np.empty_like(observations),
            np.empty(batch, np.bool_),
        )
        for index, source in enumerate(sources):
            mine = np.flatnonzero(drawn // self._store.rows == index)
            some = source.steps_in(drawn[mine] % self._store.rows)
            for name in StepBatch.__dataclass_fields__:
                getattr(result, name)[mine] = getattr(some, name)
        return result

    def located(self, places: I64) -> tuple[I64, I64]:
        """The segments of labelled steps, which are given by their places among them.

        Returns:
            The id of each step's segment (B,), and its number within the segment (B,), ordered by
            both.
        """
        chosen = self._places()[places].astype(np.int64)
        ids, within = np.empty_like(chosen), np.empty_like(chosen)
        for index, source in enumerate(self._store.by_name()):
            mine = np.flatnonzero(chosen // self._store.rows == index)
            slots = chosen[mine] % self._store.rows
            rows = source.start + (slots - source.start) % source.capacity
            at = source.scored.over(rows)
            ids[mine] = segment_ids(index, at + source.scored.first)
            within[mine] = rows - source.scored.rows[at]
        order = np.lexsort((within, ids))
        return ids[order], within[order]

    def _places(self) -> Slots:
        if self._slots is None:
            rows = self._store.rows
            sources = self._store.by_name()
            parts = [
                np.flatnonzero(np.isfinite(s.labels[: s.used])) + i * rows
                for i, s in enumerate(sources)
            ]
            slots = np.concatenate(parts) if parts else np.empty(0, np.int64)
            small = len(sources) * rows <= 2**32
            self._slots = slots.astype(np.uint32) if small else slots
        return self._slots
