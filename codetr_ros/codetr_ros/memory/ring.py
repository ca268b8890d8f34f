"""The steps and segments of one source: where the memory D keeps its arrays."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codetr_ros.records import F32, F64, I64, Transitions

COLUMNS = ('rows', 'lengths', 'offsets', 'episodes', 'values')
"""What is known of each scored segment."""


@dataclass(frozen=True, eq=False, slots=True)
class Rollout:
    """Steps in the order in which they were taken; T of them."""

    observations: F32  # (T, O)
    actions: F32  # (T, A)
    rewards: F64  # (T,) the composite reward on the last step of a scored segment, 0 elsewhere
    next_observations: F32  # (T, O)
    terminated: NDArray[np.bool_]  # (T,)
    last: NDArray[np.bool_]  # (T,) the next step, if any, does not follow on this one


@dataclass(slots=True)
class Episode:
    """Where an episode's steps lie."""

    number: int
    start: int  # row of its first step
    order: int  # episodes leave the memory in the order in which they came
    steps: int = 0
    ended: bool = False


class SourceRing:
    """The steps of one source, in a ring: row r lies in slot r % capacity, rows only grow."""

    def __init__(
        self, name: str, observation_size: int, action_size: int, capacity: int, true_rewards: bool
    ) -> None:
        self.name = name
        self.capacity = capacity
        # np.empty takes memory page by page as steps arrive, not at once
        self.observations = np.empty((capacity, observation_size), np.float32)
        self.actions = np.empty((capacity, action_size), np.float32)
        self.labels = np.empty(capacity, np.float32)  # NaN: not labelled
        self.versions = np.empty(capacity, np.uint32)
        self.terminated = np.empty(capacity, np.bool_)
        # the last step so far of its episode, whose next observation is in `finals`
        self.last = np.empty(capacity, np.bool_)
        self.true_rewards = np.empty(capacity, np.float32) if true_rewards else None
        self.finals: dict[int, F32] = {}
        self.start = 0
        self.end = 0
        self.episodes: deque[Episode] = deque()
        # kept when it is evicted: the next steps follow on it
        self.newest: Episode | None = None
        self.by_number: dict[int, Episode] = {}
        # segments, grown by a quarter; number n lies at n - first_segment
        self.first_segment = 0
        self.segments = 0
        self.segment_rows = np.empty(64, np.int64)
        self.segment_lengths = np.empty(64, np.int32)
        self.segment_offsets = np.empty(64, np.uint32)  # first step within the episode
        self.segment_episodes = np.empty(64, np.uint32)
        self.segment_values = np.empty(64, np.float64)
        self.alive = np.empty(64, np.bool_)
        # of each slot: 1 + the number of the segment that begins there, or 0; takes memory only
        # where there are scores
        self._beginning = np.zeros(capacity, np.uint32)

    @property
    def steps(self) -> int:
        """Steps held."""
        return self.end - self.start

    @property
    def segments_nbytes(self) -> int:
        """Bytes of what is known of scored segments."""
        table = [getattr(self, f'segment_{name}') for name in COLUMNS]
        each: int = sum(column.itemsize for column in table) + self.alive.itemsize
        rows = min(self.end, self.capacity) if self.segments else 0
        return self.segments * each + rows * 4

    def segment_from(self, row: int) -> int | None:
        """The number of the scored segment whose first step lies in a row that is held."""
        number = int(self._beginning[row % self.capacity])
        return number - 1 if number else None

    def slots_from(self, row: int, most: int) -> Iterator[I64]:
        """Slots of the steps held from a row on, in order, at most so many at a time."""
        for start in range(max(row, self.start), self.end, most):
            yield np.arange(start, min(start + most, self.end)) % self.capacity

    def segments_over(self, rows: I64) -> I64:
        """Where in the table the scored segments stand that rows (B,) lie in; each lies in one."""
        table = np.flatnonzero(self.alive[: self.segments])
        table = table[np.argsort(self.segment_rows[table], kind='stable')]
        return table[np.searchsorted(self.segment_rows[table], rows, side='right') - 1]

    def append(self, chunk: Transitions, episode: Episode) -> None:
        """Add steps that follow on those of the episode."""
        rows = np.arange(self.end, self.end + chunk.steps) % self.capacity
        self.observations[rows] = chunk.observations[:-1]
        self.actions[rows] = chunk.actions
        self.labels[rows] = np.nan
        self.versions[rows] = 0
        if self.true_rewards is not None:
            self.true_rewards[rows] = np.nan
        self.terminated[rows] = False
        self.last[rows] = False
        if episode.steps:
            del self.finals[self.end - 1]
            self.last[(self.end - 1) % self.capacity] = False
        self.end += chunk.steps
        episode.steps += chunk.steps
        episode.ended = chunk.terminated or chunk.truncated
        self.finals[self.end - 1] = chunk.observations[-1].copy()
        self.last[rows[-1]] = True
        self.terminated[rows[-1]] = chunk.terminated

    def newest_steps(self, count: int) -> Rollout:
        """The last `count` steps, or as many as are held."""
        first = max(self.start, self.end - count)
        rows = np.arange(first, self.end)
        slots = rows % self.capacity
        following = self.observations[(slots + 1) % self.capacity]
        last = self.last[slots]
        for i in np.flatnonzero(last):
            following[i] = self.finals[int(rows[i])]
        rewards = np.zeros(len(rows), np.float64)
        scored = slice(0, self.segments)
        ends = self.segment_rows[scored] + self.segment_lengths[scored] - 1 - first
        new = self.alive[scored] & (ends >= 0)
        rewards[ends[new]] = self.segment_values[scored][new]
        return Rollout(
            self.observations[slots],
            self.actions[slots],
            rewards,
            following,
            self.terminated[slots],
            last,
        )

    def evict_oldest(self) -> int:
        """Drop the oldest episode with its segments; how many steps went."""
        episode = self.episodes.popleft()
        del self.by_number[episode.number]
        rows = np.arange(episode.start, episode.start + episode.steps)
        self.labels[rows % self.capacity] = np.nan
        del self.finals[int(rows[-1])]
        self._drop_segments(episode)
        self.start = episode.start + episode.steps
        return episode.steps

    def add_segment(self, row: int, length: int, offset: int, episode: int, value: float) -> int:
        """Add a scored segment; its number."""
        at = self.segments
        for name in COLUMNS:
            self._grow(f'segment_{name}', at)
        self._grow('alive', at)
        self.segment_rows[at], self.segment_lengths[at], self.segment_offsets[at] = (
            row,
            length,
            offset,
        )
        self.segment_episodes[at], self.segment_values[at], self.alive[at] = episode, value, True
        self.segments += 1
        self._beginning[row % self.capacity] = self.first_segment + at + 1
        return self.first_segment + at

    def _grow(self, name: str, needed: int) -> None:
        array = getattr(self, name)
        if needed >= len(array):
            more = np.empty(max(64, len(array) // 4), array.dtype)
            setattr(self, name, np.concatenate([array, more]))

    def _drop_segments(self, episode: Episode) -> None:
        slots = np.arange(episode.start, episode.start + episode.steps) % self.capacity
        numbers = self._beginning[slots].astype(np.int64)
        self.alive[numbers[numbers > 0] - 1 - self.first_segment] = False
        self._beginning[slots] = 0
        dead = (
            int(np.argmax(self.alive[: self.segments]))
            if self.alive[: self.segments].any()
            else self.segments
        )
        if dead > self.segments // 2 and dead >= 64:
            for name in COLUMNS:
                array = getattr(self, f'segment_{name}')
                array[: self.segments - dead] = array[dead : self.segments].copy()
            self.alive[: self.segments - dead] = self.alive[dead : self.segments].copy()
            self.first_segment += dead
            self.segments -= dead
