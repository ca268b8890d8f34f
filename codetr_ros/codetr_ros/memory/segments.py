"""The scored segments of the memory D: their ids, their places, and batches of them.

A segment has an id, (place of its source in the order of names << 40) | its number within the
source. Arrays of ids (B,) may be in any order.
"""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from codetr_ros.config.cuts import Cuts
from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.ring import SourceRing, ranges
from codetr_ros.memory.scoring import anywhere, one_after_another, unscored
from codetr_ros.memory.store import Store
from codetr_ros.memory.table import SegmentTable
from codetr_ros.records import F64, I64, CompositeReward, RecordError, Transitions

SOURCE_SHIFT = 40
"""Bits of an id that hold the number of the segment within its source."""

Place = tuple[str, int]
"""A segment for as long as it is held: its source, and its number within the source."""

Spans = list[tuple[str, I64, I64, I64]]
"""For each source its name, and for each of its spans of steps the episode, the number of the
first step within it, and the number of steps."""


class Segments:
    """The scored segments of the steps in a store.

    Args:
        store: where the steps lie.
        delay: steps n of a segment.
        regular: segments follow on each other from an episode's first step on, and only its last
            is shorter. Else they may lie anywhere, have 1 to `delay` steps, and share none.
    """

    def __init__(self, store: Store, delay: int, regular: bool) -> None:
        self._store = store
        self._delay = delay
        self._rule = one_after_another if regular else anywhere
        self._ids: I64 | None = None
        self._all_ids: I64 | None = None

    # ------------------------------------------------------------------------------------------
    # changing

    def score(self, reward: CompositeReward) -> None:
        """Add a segment whose steps are here, with its composite reward: NaN if it has none.

        Raises:
            RecordError: there is no such segment, or it has its reward already.
        """
        source, row = unscored(reward, self._store, self._delay, self._rule)
        source.scored.add(row, reward.length, reward.first_step, reward.episode, reward.value)
        self.forget()

    def add_unscored(self, chunk: Transitions, cuts: Cuts) -> None:
        """Add the segments that end with steps that are here, without a score yet."""
        source = self._store.source(chunk.source)
        assert source is not None
        start = source.by_number[chunk.episode].start
        after = chunk.first_step + chunk.steps
        ended = chunk.terminated or chunk.truncated
        cut = cuts.segments(chunk.source, chunk.episode, chunk.first_step, after, ended)
        for first, length in cut:
            source.scored.add(start + first, length, first, chunk.episode, np.nan)
        self.forget()

    def value(self, values: Mapping[Place, float]) -> None:
        """Set the scores of segments that are held; NaN: none."""
        for (name, number), value in values.items():
            source = self._store.source(name)
            assert source is not None
            source.scored.values[number - source.scored.first] = value
        self.forget()

    def forget(self) -> None:
        """Drop the lists of ids: they are made anew when they are next needed."""
        self._ids = self._all_ids = None

    # ------------------------------------------------------------------------------------------
    # what there is

    def ids(self) -> I64:
        """Ids of all segments with a score, source by source in the order they were scored."""
        if self._ids is None:
            self._ids = self._joined(lambda table: table.scored())
        return self._ids

    def all_ids(self) -> I64:
        """The same with those that have no score: all whose steps are to be labelled."""
        if self._all_ids is None:
            self._all_ids = self._joined(lambda table: table.numbers())
        return self._all_ids

    def unscored_ids(self) -> I64:
        """Ids of those that have no score."""
        rest: I64 = np.setdiff1d(self.all_ids(), self.ids())
        return rest

    def digest(self) -> int:
        """A number by which the scores of other segments, or other scores, are told from these."""
        ids = self.ids()
        digest = hashlib.sha256(ids.tobytes() + self.scores(ids).tobytes()).digest()
        return int.from_bytes(digest[:8], 'little', signed=True)

    def newest_first(self, ids: I64) -> I64:
        """The same ids, the newest of each source first."""
        ends = np.searchsorted(ids >> SOURCE_SHIFT, ids >> SOURCE_SHIFT, side='right')
        ordered: I64 = ids[np.lexsort((ids, ends - np.arange(len(ids))))]
        return ordered

    def place(self, source: str, episode: int, first: int, length: int, scorer: str) -> Place:
        """The segment of these steps, which was added without a score.

        Raises:
            RecordError: there is none.
        """
        ring = self._store.source(source)
        stored = ring.by_number.get(episode) if ring else None
        named = f'{scorer!r} judges {source!r}, episode {episode}, steps {first} to '
        named += f'{first + length - 1}'
        if ring is None or stored is None:
            raise RecordError(
                f'{named}: no such episode is here (never sent, or evicted); judge segments of '
                'steps sent'
            )
        number = ring.scored.beginning_at(stored.start + first) if first < stored.steps else None
        if number is None or ring.scored.lengths[number - ring.scored.first] != length:
            raise RecordError(
                f'{named}: there is no such segment; judge those of a ScoreRequest, or cut '
                f'episodes as the setting delay does ({self._delay} steps at the most)'
            )
        return source, number

    def holds(self, place: Place) -> bool:
        """Whether a segment is still held."""
        source = self._store.source(place[0])
        if source is None:
            return False
        at = place[1] - source.scored.first
        return at >= 0 and bool(source.scored.alive[at])

    def ids_of(self, places: Sequence[Place]) -> I64:
        """Ids of segments that are held."""
        index = {ring.name: i for i, ring in enumerate(self._store.by_name())}
        return np.array([n | index[name] << SOURCE_SHIFT for name, n in places], np.int64)

    def _joined(self, numbers: Callable[[SegmentTable], I64]) -> I64:
        rings = enumerate(self._store.by_name())
        parts = [segment_ids(i, numbers(ring.scored)) for i, ring in rings]
        return np.concatenate(parts) if parts else np.empty(0, np.int64)

    @property
    def nbytes(self) -> int:
        """Bytes of the tables of segments."""
        return sum(s.scored.nbytes(s.used) for s in self._store.sources)

    def scores(self, ids: I64) -> F64:
        """Composite rewards (B,); NaN where there is none."""
        values = np.empty(len(ids), np.float64)
        for _, source, mine, at in self._by_source(ids):
            values[mine] = source.scored.values[at]
        return values

    def lengths(self, ids: I64) -> I64:
        """The segments' numbers of steps (B,)."""
        return self._table(ids)[1]

    def versions(self, ids: I64) -> I64:
        """The version (B,) of the model that labelled each segment's first step; -1: none."""
        versions = np.empty(len(ids), np.int64)
        for _, source, mine, at in self._by_source(ids):
            slots = source.scored.rows[at] % source.capacity
            versions[mine] = source.versions[slots]
            versions[mine[np.isnan(source.labels[slots])]] = -1
        return versions

    def terminal(self, ids: I64) -> NDArray[np.bool_]:
        """Which of the segments (B,) ended in a terminal state."""
        rows, lengths, _ = self._table(ids)
        terminal = np.empty(len(ids), np.bool_)
        for _, source, mine, _ in self._by_source(ids):
            ends = rows[mine] + lengths[mine] - 1
            terminal[mine] = source.terminated[ends % source.capacity]
        return terminal

    def target_scale(self, kind: str) -> float:
        """The unit c of composite rewards per step: positive, so that no sign ever changes.

        Args:
            kind: 'rms'; with any other the unit is 1.
        """
        return self.score_scale() if kind == 'rms' else 1.0

    def score_scale(self) -> float:
        """Root mean square of all composite rewards per step, the scale c; 1 where that is 0.

        The formula: docs/methods.md#scale.
        """
        squares = [s.scored.per_step() ** 2 for s in self._store.sources]
        values = np.concatenate(squares) if squares else np.empty(0)
        scale = float(np.sqrt(values.mean())) if len(values) else 0.0
        return scale if scale > 0 else self._tiny_scale()

    def _tiny_scale(self) -> float:
        """The scale of scores whose squares are too small for a float64; 1 where all are 0."""
        parts = [s.scored.per_step() for s in self._store.sources]
        values = np.concatenate(parts) if parts else np.empty(0)
        largest = float(np.abs(values).max(initial=0.0))
        if not largest:
            return 1.0
        return largest * float(np.sqrt(np.mean((values / largest) ** 2)))

    # ------------------------------------------------------------------------------------------
    # where they lie

    def places(self, ids: I64, context: int = 0) -> tuple[I64, I64, I64, I64]:
        """Where the steps of segments lie, with up to `context` steps of the episode before each.

        Returns:
            For each (B,): the place of its source in the order of names, the row of the first step
            in its ring, the number of steps, and the number of those that are context.
        """
        rows, lengths, offsets = self._table(ids)
        before = np.minimum(context, offsets)
        return ids >> SOURCE_SHIFT, rows - before, lengths + before, before

    def spans(self, ids: I64) -> Spans:
        """Where segments lie in their sources' episodes."""
        return [
            (
                source.name,
                source.scored.episodes[at].astype(np.int64),
                source.scored.offsets[at].astype(np.int64),
                source.scored.lengths[at].astype(np.int64),
            )
            for _, source, _, at in self._by_source(ids)
        ]

    def step_spans(self, ids: I64, within: I64) -> Spans:
        """Where single steps lie: one span for consecutive steps of a segment.

        Args:
            ids: each step's segment, by source.
            within: its number within the segment.
        """
        follows = (np.diff(ids, prepend=-1) == 0) & (np.diff(within, prepend=-1) == 1)
        begins = np.flatnonzero(~follows)
        lengths = np.diff(begins, append=len(ids))
        spans: Spans = []
        at = 0
        for source, episodes, firsts, _ in self.spans(ids[begins]):
            mine = slice(at, at + len(episodes))
            spans.append((source, episodes, firsts + within[begins[mine]], lengths[mine]))
            at += len(episodes)
        return spans

    def runs(self, ids: I64, longest: int) -> list[I64]:
        """Each segment with those right before it in its episode, in order.

        Args:
            ids: the segments with which the runs end.
            longest: segments in a run at the most.
        """
        runs = [ids[i : i + 1] for i in range(len(ids))]
        for index, source, mine, at in self._by_source(ids):
            for i, place in zip(mine.tolist(), at.tolist(), strict=True):
                before = source.scored.right_before(place, self._delay, longest - 1)
                runs[i] = np.append(segment_ids(index, np.array(before, np.int64)), ids[i])
        return runs

    # ------------------------------------------------------------------------------------------
    # batches

    def sample(self, rng: np.random.Generator, batch: int, context: int = 0) -> SegmentBatch:
        """Draw segments uniformly, with replacement.

        Raises:
            ValueError: no segment is scored.
        """
        ids = self.ids()
        if not len(ids):
            raise ValueError('no segment of the memory is scored: nothing to sample')
        return self.batch(ids[rng.integers(0, len(ids), batch)], context)

    def batch(self, ids: I64, context: int = 0) -> SegmentBatch:
        """Segments, each with up to `context` steps of its episode before it."""
        _, rows, lengths, before = self.places(ids, context)
        return self._gather(ids, rows, lengths, before, self.scores(ids))

    def windows(self, ids: I64, window: int, batch: int) -> Iterator[SegmentBatch]:
        """For each step of the segments, in order, the last `window` steps of its episode that end
        with it.

        `context` counts the steps of a window that precede the segment of its last step.
        """
        lengths = self.lengths(ids)
        steps = ranges(np.zeros_like(lengths), lengths)
        return self.step_windows(np.repeat(ids, lengths), steps, window, batch)

    def step_windows(
        self, ids: I64, within: I64, window: int, batch: int
    ) -> Iterator[SegmentBatch]:
        """The same for single steps, given by their segments' ids and their numbers in these."""
        firsts, _, offsets = self._table(ids)
        lengths = np.minimum(window, offsets + within + 1)
        rows = firsts + within + 1 - lengths
        context = np.maximum(0, lengths - within - 1)
        for i in range(0, len(ids), batch):
            part = slice(i, i + batch)
            no_score = np.full(len(ids[part]), np.nan)
            yield self._gather(ids[part], rows[part], lengths[part], context[part], no_score)

    def _by_source(self, ids: I64) -> Iterator[tuple[int, SourceRing, I64, I64]]:
        """For each source of some segments: its place in the order of names, its ring, the indices
        of its own segments, and their places in its table.
        """
        rings = self._store.by_name()
        sources = ids >> SOURCE_SHIFT
        for index in np.unique(sources).tolist():
            mine = np.flatnonzero(sources == index)
            numbers = ids[mine] & ((1 << SOURCE_SHIFT) - 1)
            yield index, rings[index], mine, numbers - rings[index].scored.first

    def _table(self, ids: I64) -> tuple[I64, I64, I64]:
        """For each segment: its first step's row, its steps, and its episode's steps before it."""
        rows, lengths, offsets = np.empty((3, len(ids)), np.int64)
        for _, source, mine, at in self._by_source(ids):
            rows[mine] = source.scored.rows[at]
            lengths[mine] = source.scored.lengths[at]
            offsets[mine] = source.scored.offsets[at]
        return rows, lengths, offsets

    def _gather(
        self, ids: I64, rows: I64, lengths: I64, context: I64, values: F64
    ) -> SegmentBatch:
        """The batch of the steps from these rows on, in the sources of these segments."""
        size, steps = len(ids), int(lengths.max())
        observations = np.empty((size, steps + 1, self._store.observation_size), np.float32)
        actions = np.empty((size, steps, self._store.action_size), np.float32)
        rewards = np.empty((size, steps), np.float32) if self._store.true_rewards else None
        terminated = np.empty(size, np.bool_)
        for _, source, mine, _ in self._by_source(ids):
            parts = source.windows(rows[mine], lengths[mine], steps)
            observations[mine], actions[mine] = parts[:2]
            if rewards is not None:
                rewards[mine] = parts[2]
            ends = rows[mine] + lengths[mine] - 1
            terminated[mine] = source.terminated[ends % source.capacity]
        return SegmentBatch(observations, actions, lengths, context, values, rewards, terminated)


def segment_ids(source: int, numbers: I64) -> I64:
    """Ids of segments: the place of their source in the order of names, and their numbers."""
    return numbers | source << SOURCE_SHIFT
