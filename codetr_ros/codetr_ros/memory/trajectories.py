"""The memory D: whole trajectories, their scored segments and their step rewards.

Both the reward side and the learner keep one. Each observation is stored once; a step costs
`Trajectories.bytes_per_step` bytes. What is added is checked against what is there, so that a
wrong record is refused and changes nothing.
"""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from codetr_ros.memory.batches import SegmentBatch, StepBatch
from codetr_ros.memory.ring import Episode, Rollout, SourceRing
from codetr_ros.records import (
    F32,
    F64,
    I64,
    CompositeReward,
    RecordError,
    StepRewards,
    Transitions,
    TrueRewards,
)

Slots = NDArray[np.uint32] | NDArray[np.int64]


_SOURCE_SHIFT = 40
"""A segment id is (source index << 40) | number of the segment within its source."""


_PART_ROWS = 1 << 16
"""Rows that are looked at in double precision at a time."""


class Trajectories:
    """What has been simulated, scored and labelled, bounded by a number of steps.

    Args:
        observation_size: O.
        action_size: A.
        delay: steps n of a segment.
        capacity: steps, of all sources together, after which `evict` drops the oldest episodes.
            Each source has rows for as many, which take memory when they are first used.
        margin: steps that may be held beyond the capacity before `evict` is called: a phase and an
            episode.
        true_rewards: keep the environment's own rewards too, for the oracle.
        regular: segments have `delay` steps and follow on each other from an episode's first step
            on, only its last is shorter. Else they may lie anywhere and have 1 to `delay` steps:
            that no two share a step is for the caller to see to.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        delay: int,
        capacity: int,
        margin: int,
        true_rewards: bool = False,
        regular: bool = True,
    ) -> None:
        self.observation_size = observation_size
        self.action_size = action_size
        self.delay = delay
        self.capacity = capacity
        self.evicted = 0
        self._margin = margin
        self._true_rewards = true_rewards
        self._regular = regular
        self._sources: dict[str, SourceRing] = {}
        self._order = 0
        self._sampleable: tuple[Slots, list[SourceRing]] | None = None
        self._ids: I64 | None = None

    # ------------------------------------------------------------------------------------------
    # adding

    def append(self, chunk: Transitions) -> None:
        """Add consecutive steps that go on where their source's last ones ended.

        Raises:
            RecordError: they do not follow on what is here.
        """
        source = self._sources.get(chunk.source)
        if source is None:
            source = SourceRing(
                chunk.source,
                self.observation_size,
                self.action_size,
                self.capacity + self._margin,
                self._true_rewards,
            )
            self._sources[chunk.source] = source
        if source.steps + chunk.steps > source.capacity:
            raise RecordError(
                f'{chunk.steps} steps of {chunk.source!r} exceed the memory: {source.steps} of '
                f'{source.capacity} rows are '
                f'taken. Raise memory_steps ({self.capacity})'
            )
        episode = self._episode_of(source, chunk)
        source.append(chunk, episode)
        self._sampleable = None

    def _episode_of(self, source: SourceRing, chunk: Transitions) -> Episode:
        last = source.newest
        expected = (0, 0)
        if last is not None:
            expected = (last.number + 1, 0) if last.ended else (last.number, last.steps)
        if (chunk.episode, chunk.first_step) != expected:
            raise RecordError(
                f'transitions out of sequence: {chunk.source!r} sent episode {chunk.episode} step '
                f'{chunk.first_step} '
                f'(sequence {chunk.sequence}); episode {expected[0]} step {expected[1]} follows '
                'on what is here. '
                f'Restart the source, or send what lies between'
            )
        if last is not None and not last.ended:
            if not np.array_equal(source.finals[source.end - 1], chunk.observations[0]):
                raise RecordError(
                    f'transitions of {chunk.source!r}, episode {chunk.episode}, step '
                    f'{chunk.first_step}: the first '
                    f'observation is not the one that the steps before ended with'
                )
            return last
        episode = Episode(chunk.episode, source.end, self._order)
        self._order += 1
        source.newest = episode
        source.episodes.append(episode)
        source.by_number[chunk.episode] = episode
        return episode

    def append_true_rewards(self, record: TrueRewards) -> None:
        """Add the environment's own rewards of steps that are here: for the oracle, never in a
        node.
        """
        source = self._sources[record.source]
        assert source.true_rewards is not None, 'this memory was made without true rewards'
        start = source.by_number[record.episode].start + record.first_step
        source.true_rewards[np.arange(start, start + len(record.rewards)) % source.capacity] = (
            record.rewards
        )

    def score(self, reward: CompositeReward) -> None:
        """Add the composite reward of a segment whose steps are here.

        Raises:
            RecordError: there is no such segment, or it has its reward already.
        """
        named = (
            f'composite reward {reward.value} of {reward.scorer!r} for {reward.source!r}, episode '
            f'{reward.episode}, '
            f'first_step {reward.first_step}, length {reward.length}'
        )
        source = self._sources.get(reward.source)
        episode = source.by_number.get(reward.episode) if source else None
        if source is None or episode is None:
            raise RecordError(
                f'{named}: no such episode is here (never sent, or evicted); score segments of '
                'steps sent'
            )
        if fault := (self._off_grid if self._regular else self._amiss)(reward, episode):
            ended = ' and ended' if episode.ended else ''
            raise RecordError(
                f'{named}: there is no such segment. {fault}; this episode has {episode.steps} '
                f'steps{ended}'
            )
        first = episode.start + reward.first_step
        if source.segment_from(first) is not None:
            raise RecordError(
                f'{named}: the segment has its composite reward already; the first one is kept'
            )
        source.add_segment(first, reward.length, reward.first_step, reward.episode, reward.value)
        self._ids = None

    def _off_grid(self, reward: CompositeReward, episode: Episode) -> str | None:
        """What is wrong with a segment, where all segments are regular."""
        last = reward.first_step + reward.length
        whole = reward.length == self.delay
        cut_short = episode.ended and last == episode.steps and 0 < reward.length < self.delay
        if reward.first_step % self.delay == 0 and last <= episode.steps and (whole or cut_short):
            return None
        return (
            f'Segments have {self.delay} steps, start at multiples of {self.delay} and only the '
            'last of an ended episode is shorter'
        )

    def _amiss(self, reward: CompositeReward, episode: Episode) -> str | None:
        """What is wrong with a segment, where they may lie anywhere."""
        inside = reward.first_step + reward.length <= episode.steps
        if inside and 0 < reward.length <= self.delay:
            return None
        return f'Segments have 1 to {self.delay} steps of those sent'

    def evict(self) -> int:
        """Drop whole episodes, oldest first, until at most `capacity` steps are held; how many
        steps went.

        The last episode of all is kept however long it is: an empty memory teaches nothing.
        """
        gone = 0
        while (
            self.steps > self.capacity and sum(len(s.episodes) for s in self._sources.values()) > 1
        ):
            ended = [s for s in self._sources.values() if s.episodes and s.episodes[0].ended]
            if not ended:
                break  # unfinished episodes are all there is: they must not be cut
            source = min(ended, key=lambda s: s.episodes[0].order)
            gone += source.evict_oldest()
        self._ids = self._sampleable = None
        self.evicted += gone
        return gone

    def apply(self, rewards: StepRewards) -> int:
        """Store labels; how many of them belong to episodes that are gone and were passed over.

        Raises:
            RecordError: a label is for steps that are not here; nothing is stored then.
        """
        if len(rewards.lengths) == 0:
            return 0
        source = self._sources.get(rewards.source)
        if source is None:
            raise RecordError(
                f'step rewards for {rewards.source!r}, which sent no steps; sources: '
                f'{list(self._sources)}'
            )
        starts = np.empty(len(rewards.lengths), np.int64)
        newest = source.newest.number if source.newest else -1
        known = source.by_number
        gone = np.zeros(len(starts), np.bool_)
        triples = zip(
            rewards.episodes.tolist(),
            rewards.first_steps.tolist(),
            rewards.lengths.tolist(),
            strict=True,
        )
        for i, (number, first, length) in enumerate(triples):
            episode = known.get(number)
            if episode is None and number <= newest:
                gone[i] = True
                starts[i] = 0
            elif episode is None or first + length > episode.steps:
                raise RecordError(
                    f'step rewards of phase {rewards.phase} for {rewards.source!r}, episode '
                    f'{number}, first_step {first}, '
                    f'length {length}: these steps are not here'
                )
            else:
                starts[i] = episode.start + first
        rows = _ranges(starts, rewards.lengths.astype(np.int64))
        keep = np.repeat(~gone, rewards.lengths)
        rows = rows[keep] % source.capacity
        source.labels[rows] = rewards.labels[keep]
        source.versions[rows] = rewards.version
        self._sampleable = None
        return int(np.count_nonzero(~keep))

    # ------------------------------------------------------------------------------------------
    # asking

    @property
    def steps(self) -> int:
        """Steps held."""
        return sum(s.steps for s in self._sources.values())

    @property
    def sources(self) -> list[SourceRing]:
        """Where each source's steps lie, in the order in which they sent the first of them."""
        return list(self._sources.values())

    @property
    def labelled_steps(self) -> int:
        """Steps that have a step reward."""
        return len(self._labelled()[0])

    @property
    def bytes_per_step(self) -> int:
        """Bytes that one stored step takes: observation, action, label, its model version, two
        flags.
        """
        per_row = 4 * self.observation_size + 4 * self.action_size + 4 + 4 + 1 + 1
        return per_row + (4 if self._true_rewards else 0)

    @property
    def nbytes(self) -> int:
        """Bytes of the rows in use, with each episode's final observation and the table of
        segments.
        """
        total = 0
        for s in self._sources.values():
            total += min(s.end, s.capacity) * self.bytes_per_step
            total += len(s.finals) * 4 * self.observation_size + s.segments_nbytes
        return total

    def report(self) -> dict[str, int]:
        """What is held and what it takes, for a run's summary."""
        return {
            'steps': self.steps,
            'evicted': self.evicted,
            'bytes_per_step': self.bytes_per_step,
            'bytes': self.nbytes,
        }

    def labels(self) -> dict[str, F32]:
        """The labels of each source's steps, in order; NaN where there is none."""
        return {
            s.name: s.labels[np.arange(s.start, s.end) % s.capacity]
            for s in self._sources.values()
        }

    def draw(self, rng: np.random.Generator, batch: int) -> I64:
        """Places (B,) among the labelled steps, drawn uniformly, with replacement.

        What is drawn one after the other is the same in batches of any size.

        Raises:
            ValueError: no step is labelled.
        """
        count = self.labelled_steps
        if not count:
            raise ValueError('no step of the memory is labelled: nothing to sample')
        return rng.integers(0, count, batch)

    def sample_steps(self, rng: np.random.Generator, batch: int) -> StepBatch:
        """Draw labelled steps uniformly, with replacement.

        Raises:
            ValueError: no step is labelled.
        """
        slots, sources = self._labelled()
        drawn = slots[self.draw(rng, batch)].astype(np.int64)
        if len(sources) == 1:
            return self.steps_in(sources[0], drawn)
        width = self.capacity + self._margin
        parts = np.empty((batch, self.observation_size), np.float32)
        result = StepBatch(
            parts,
            np.empty((batch, self.action_size), np.float32),
            np.empty(batch, np.float32),
            np.empty_like(parts),
            np.empty(batch, np.bool_),
        )
        for index, source in enumerate(sources):
            mine = np.flatnonzero(drawn // width == index)
            some = self.steps_in(source, drawn[mine] % width)
            for name in StepBatch.__dataclass_fields__:
                getattr(result, name)[mine] = getattr(some, name)
        return result

    def _labelled(self) -> tuple[Slots, list[SourceRing]]:
        if self._sampleable is None:
            sources = [self._sources[name] for name in sorted(self._sources)]
            width = self.capacity + self._margin
            parts = [
                np.flatnonzero(np.isfinite(s.labels[: min(s.end, s.capacity)])) + i * width
                for i, s in enumerate(sources)
            ]
            slots = np.concatenate(parts) if parts else np.empty(0, np.int64)
            small = len(sources) * width <= 2**32
            self._sampleable = (slots.astype(np.uint32) if small else slots, sources)
        return self._sampleable

    def label_versions(self) -> I64:
        """The version of the model that gave each labelled step its label."""
        held = ((s, slice(min(s.end, s.capacity))) for s in self._labelled()[1])
        parts = [s.versions[rows][np.isfinite(s.labels[rows])] for s, rows in held]
        return np.concatenate([np.empty(0, np.int64), *parts])

    def versions(self, ids: I64) -> I64:
        """The version of the model that labelled the first step of segments by id; -1: none."""
        found = np.empty(len(ids), np.int64)
        for _, source, mine, at in self._by_source(ids):
            slots = source.segment_rows[at] % source.capacity
            found[mine] = source.versions[slots]
            found[mine[np.isnan(source.labels[slots])]] = -1
        return found

    def located(self, places: I64) -> tuple[I64, I64]:
        """Where labelled steps lie, given by their places among them.

        Returns:
            The id of each one's segment (B,), and its number within the segment (B,), ordered by
            the one and then by the other.
        """
        slots, sources = self._labelled()
        chosen = slots[places].astype(np.int64)
        width = self.capacity + self._margin
        ids, within = np.empty_like(chosen), np.empty_like(chosen)
        for index, source in enumerate(sources):
            mine = np.flatnonzero(chosen // width == index)
            rows = source.start + (chosen[mine] % width - source.start) % source.capacity
            at = source.segments_over(rows)
            ids[mine] = (at + source.first_segment) | (index << _SOURCE_SHIFT)
            within[mine] = rows - source.segment_rows[at]
        order = np.lexsort((within, ids))
        return ids[order], within[order]

    @staticmethod
    def steps_in(source: SourceRing, slots: NDArray[np.int64]) -> StepBatch:
        """The steps that lie in some slots of a source; NaN for a reward that is not there."""
        following = source.observations.take((slots + 1) % source.capacity, 0)
        for i in np.flatnonzero(source.last[slots]):
            row = source.start + (int(slots[i]) - source.start) % source.capacity
            following[i] = source.finals[row]
        return StepBatch(
            source.observations.take(slots, 0),
            source.actions.take(slots, 0),
            source.labels.take(slots),
            following,
            source.terminated.take(slots),
        )

    def segment_ids(self) -> I64:
        """Ids of all scored segments, source by source in the order they were scored."""
        if self._ids is None:
            parts = [
                (np.flatnonzero(s.alive[: s.segments]) + s.first_segment) | (i << _SOURCE_SHIFT)
                for i, (_, s) in enumerate(sorted(self._sources.items()))
            ]
            self._ids = np.concatenate(parts) if parts else np.empty(0, np.int64)
        return self._ids

    def sample_segments(
        self, rng: np.random.Generator, batch: int, context: int = 0
    ) -> SegmentBatch:
        """Draw scored segments uniformly, with replacement.

        Raises:
            ValueError: no segment is scored.
        """
        ids = self.segment_ids()
        if not len(ids):
            raise ValueError('no segment of the memory is scored: nothing to sample')
        return self.segment_batch(ids[rng.integers(0, len(ids), batch)], context)

    def segment_batch(self, ids: I64, context: int = 0) -> SegmentBatch:
        """Segments by id, each with up to `context` steps of its episode before it."""
        _, rows, lengths, before = self.places(ids, context)
        return self._windows(ids, rows, lengths, before, self.scores(ids))

    def places(self, ids: I64, context: int = 0) -> tuple[I64, I64, I64, I64]:
        """Where the steps of such segments lie.

        Returns:
            Of each (B,): the place of its source in the order of names, the row of the first step
            in its ring, the number of steps, and how many of them are context.
        """
        spans = self._spans(ids)
        before = np.minimum(context, spans[:, 2])
        return ids >> _SOURCE_SHIFT, spans[:, 0] - before, spans[:, 1] + before, before

    def scores(self, ids: I64) -> F64:
        """Composite rewards of segments by id."""
        values = np.empty(len(ids), np.float64)
        for _, source, mine, at in self._by_source(ids):
            values[mine] = source.segment_values[at]
        return values

    def runs(self, ids: I64, longest: int) -> list[I64]:
        """Each segment with the whole ones right before it in its episode, in order.

        Args:
            ids: the segments with which the runs end.
            longest: segments in a run at the most; those before the last have `delay` steps.
        """
        found = [ids[i : i + 1] for i in range(len(ids))]
        for index, source, mine, at in self._by_source(ids):
            for i, place in zip(mine.tolist(), at.tolist(), strict=True):
                row, first = int(source.segment_rows[place]), int(source.segment_offsets[place])
                run: list[int] = []
                while len(run) < longest - 1:
                    back = (len(run) + 1) * self.delay
                    number = source.segment_from(row - back) if back <= first else None
                    if number is None:
                        break
                    if source.segment_lengths[number - source.first_segment] < self.delay:
                        break
                    run.append(number | index << _SOURCE_SHIFT)
                found[i] = np.array([*reversed(run), ids[i]], np.int64)
        return found

    def lengths(self, ids: I64) -> I64:
        """Steps of segments by id."""
        return self._spans(ids)[:, 1]

    def windows(self, ids: I64, window: int, batch: int) -> Iterator[SegmentBatch]:
        """For each step of the segments, in order, the last `window` steps of its episode that end
        with it.

        `context` counts the steps of a window that precede the segment of its last step.
        """
        lengths = self.lengths(ids)
        steps = _ranges(np.zeros_like(lengths), lengths)
        return self.step_windows(np.repeat(ids, lengths), steps, window, batch)

    def step_windows(
        self, ids: I64, within: I64, window: int, batch: int
    ) -> Iterator[SegmentBatch]:
        """The same for single steps: each has its segment's id and its number within it."""
        spans = self._spans(ids)
        lengths = np.minimum(window, spans[:, 2] + within + 1)
        rows = spans[:, 0] + within + 1 - lengths
        context = np.maximum(0, lengths - within - 1)
        for i in range(0, len(ids), batch):
            part = slice(i, i + batch)
            nothing = np.full(len(ids[part]), np.nan)
            yield self._windows(ids[part], rows[part], lengths[part], context[part], nothing)

    def segments(self, ids: I64) -> list[tuple[str, I64, I64, I64]]:
        """Where segments lie: for each source its name, and the episodes, first steps and lengths
        of its ids.
        """
        return [
            (
                source.name,
                source.segment_episodes[at].astype(np.int64),
                source.segment_offsets[at].astype(np.int64),
                source.segment_lengths[at].astype(np.int64),
            )
            for _, source, _, at in self._by_source(ids)
        ]

    def pieces(self, ids: I64, within: I64) -> list[tuple[str, I64, I64, I64]]:
        """Where single steps lie, as `segments` says it: one run for those of a segment that
        follow on each other.

        Args:
            ids: each step's segment, by source.
            within: its number within the segment.
        """
        follows = (np.diff(ids, prepend=-1) == 0) & (np.diff(within, prepend=-1) == 1)
        begins = np.flatnonzero(~follows)
        lengths = np.diff(begins, append=len(ids))
        found = []
        at = 0
        for source, episodes, firsts, _ in self.segments(ids[begins]):
            mine = slice(at, at + len(episodes))
            found.append((source, episodes, firsts + within[begins[mine]], lengths[mine]))
            at += len(episodes)
        return found

    def newest(self, counts: Sequence[int]) -> Rollout:
        """The last steps of each source, in order of names: as many as `counts` says, or as are
        held.
        """
        sources = [self._sources[name] for name in sorted(self._sources)]
        # a source that has not taken any step yet is not among them
        parts = [s.newest_steps(count) for s, count in zip(sources, counts, strict=False)]
        fields = Rollout.__dataclass_fields__
        return Rollout(*(np.concatenate([getattr(p, name) for p in parts]) for name in fields))

    def terminal(self, ids: I64) -> NDArray[np.bool_]:
        """Which segments (B,) ended in a terminal state."""
        spans = self._spans(ids)
        found = np.empty(len(ids), np.bool_)
        for _, source, mine, _ in self._by_source(ids):
            ends = spans[mine, 0] + spans[mine, 1] - 1
            found[mine] = source.terminated[ends % source.capacity]
        return found

    def score_scale(self) -> float:
        """Root mean square of the composite reward per step over all scored segments; 1 where that
        is 0.
        """
        squares = [
            (s.segment_values[: s.segments] / s.segment_lengths[: s.segments])[
                s.alive[: s.segments]
            ]
            ** 2
            for s in self._sources.values()
        ]
        values = np.concatenate(squares) if squares else np.empty(0)
        scale = float(np.sqrt(values.mean())) if len(values) else 0.0
        return scale if scale > 0 else 1.0

    def observation_moments(self) -> tuple[F64, F64]:
        """Mean and standard deviation of each observation component over all steps held, in
        float64.
        """
        if not self.steps:
            return np.zeros(self.observation_size), np.ones(self.observation_size)
        mean = _sum(self._observations()) / self.steps
        squares = _sum((rows - mean) ** 2 for rows in self._observations())
        return mean, np.sqrt(squares / self.steps)

    def _observations(self) -> Iterator[F64]:
        """The observations of all steps held, part by part: (rows, O)."""
        for source in self._sources.values():
            for first in range(source.start, source.end, _PART_ROWS):
                rows = np.arange(first, min(first + _PART_ROWS, source.end))
                yield source.observations[rows % source.capacity].astype(np.float64)

    def _by_source(self, ids: I64) -> Iterator[tuple[int, SourceRing, NDArray[np.int64], I64]]:
        names = sorted(self._sources)
        for index in np.unique(ids >> _SOURCE_SHIFT).tolist():
            source = self._sources[names[index]]
            mine = np.flatnonzero(ids >> _SOURCE_SHIFT == index)
            yield (
                index,
                source,
                mine,
                (ids[mine] & ((1 << _SOURCE_SHIFT) - 1)) - source.first_segment,
            )

    def _spans(self, ids: I64) -> I64:
        spans = np.empty((len(ids), 3), np.int64)
        for _, source, mine, at in self._by_source(ids):
            spans[mine, 0], spans[mine, 1] = source.segment_rows[at], source.segment_lengths[at]
            spans[mine, 2] = source.segment_offsets[at]
        return spans

    def _windows(
        self, ids: I64, rows: I64, lengths: I64, context: I64, values: F64
    ) -> SegmentBatch:
        steps = int(lengths.max())
        grid = rows[:, None] + np.arange(steps + 1)  # (B, L+1)
        inside = np.arange(steps + 1) <= lengths[:, None]
        observations = np.zeros((len(ids), steps + 1, self.observation_size), np.float32)
        actions = np.zeros((len(ids), steps, self.action_size), np.float32)
        rewards = np.zeros((len(ids), steps), np.float32) if self._true_rewards else None
        for _, source, mine, _ in self._by_source(ids):
            slots = grid[mine] % source.capacity
            some = source.observations[slots]
            ends = rows[mine] + lengths[mine] - 1
            for i in np.flatnonzero(source.last[ends % source.capacity]):
                some[i, lengths[mine[i]]] = source.finals[int(ends[i])]
            some[~inside[mine]] = 0
            observations[mine] = some
            taken = source.actions[slots[:, :-1]]
            taken[~inside[mine][:, 1:]] = 0
            actions[mine] = taken
            if rewards is not None and source.true_rewards is not None:
                known = source.true_rewards[slots[:, :-1]]
                known[~inside[mine][:, 1:]] = 0
                rewards[mine] = known
        return SegmentBatch(observations, actions, lengths, context, values, rewards)


def _sum(parts: Iterable[F64]) -> F64:
    """The sum of all rows, one after the other, as if the parts were one array."""
    total: F64 | None = None
    for part in parts:
        rows = part if total is None else np.concatenate([total[None], part])
        total = rows.sum(0)
    assert total is not None
    return total


def _ranges(starts: I64, lengths: I64) -> I64:
    """Concatenate start, start + 1, ... of each (start, length)."""
    offsets = np.repeat(starts - np.concatenate([[0], np.cumsum(lengths)[:-1]]), lengths)
    return offsets + np.arange(int(lengths.sum()))


def measure_scale(target_scale: str, memory: Trajectories) -> float:
    """The unit c of composite rewards per step: positive, so that no sign ever changes."""
    return memory.score_scale() if target_scale == 'rms' else 1.0
