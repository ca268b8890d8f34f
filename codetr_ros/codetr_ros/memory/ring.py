"""The steps of one source, in the arrays of the memory D."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codetr_ros.memory.batches import StepBatch
from codetr_ros.memory.table import SegmentTable
from codetr_ros.records import F32, F64, I64, Transitions

PROGRESS = 2
"""Numbers that say how far a segment has come: its worth so far, and the share that has passed."""


@dataclass(frozen=True, eq=False, slots=True)
class Rollout:
    """Steps in the order in which they were taken; T of them."""

    observations: F32  # (T, O)
    actions: F32  # (T, A)
    # (T,) the composite reward on the last step of a segment, NaN if it has none; 0 elsewhere
    rewards: F64
    next_observations: F32  # (T, O)
    terminated: NDArray[np.bool_]  # (T,)
    last: NDArray[np.bool_]  # (T,) the next step, if any, does not follow on this one


@dataclass(slots=True)
class StoredEpisode:
    """The place of an episode's steps."""

    number: int
    start: int  # row of its first step
    order: int  # episodes leave the memory in the order in which they came
    steps: int = 0
    ended: bool = False
    terminal: bool = False  # it ended in a terminal state


class SourceRing:
    """The steps of one source, in a ring: row r lies in slot r % capacity, rows only grow."""

    def __init__(
        self,
        name: str,
        observation_size: int,
        action_size: int,
        capacity: int,
        true_rewards: bool,
        progress: bool = False,
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
        # before and after a step: what its segment is worth so far, and how much of it has passed
        self.progress = np.empty((capacity, 2, PROGRESS), np.float32) if progress else None
        self.finals: dict[int, F32] = {}
        self.start = 0
        self.end = 0
        self.episodes: deque[StoredEpisode] = deque()
        # kept when it is evicted: the next steps follow on it
        self.newest: StoredEpisode | None = None
        self.by_number: dict[int, StoredEpisode] = {}
        self.scored = SegmentTable(capacity)

    @property
    def steps(self) -> int:
        """Steps held."""
        return self.end - self.start

    @property
    def used(self) -> int:
        """Rows that have ever held a step: only these take memory."""
        return min(self.end, self.capacity)

    # ------------------------------------------------------------------------------------------
    # changing

    def begin(self, number: int, order: int) -> StoredEpisode:
        """Open the next episode, which has no steps yet."""
        episode = StoredEpisode(number, self.end, order)
        self.newest = episode
        self.episodes.append(episode)
        self.by_number[number] = episode
        return episode

    def append(self, chunk: Transitions, episode: StoredEpisode) -> None:
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
        episode.terminal = chunk.terminated
        self.finals[self.end - 1] = chunk.observations[-1].copy()
        self.last[rows[-1]] = True
        self.terminated[rows[-1]] = chunk.terminated

    def evict_oldest(self) -> int:
        """Drop the oldest episode with its segments, and return its number of steps."""
        episode = self.episodes.popleft()
        del self.by_number[episode.number]
        rows = np.arange(episode.start, episode.start + episode.steps)
        slots = rows % self.capacity
        self.labels[slots] = np.nan
        del self.finals[int(rows[-1])]
        self.scored.drop(slots)
        self.start = episode.start + episode.steps
        return episode.steps

    # ------------------------------------------------------------------------------------------
    # reading

    def slots_from(self, row: int, most: int) -> Iterator[I64]:
        """Slots of the steps held from a row on, in order, at most `most` at a time."""
        for start in range(max(row, self.start), self.end, most):
            yield np.arange(start, min(start + most, self.end)) % self.capacity

    def steps_in(self, slots: I64) -> StepBatch:
        """The steps in some slots (B,); their rewards are NaN where there is no label."""
        following = self.observations.take((slots + 1) % self.capacity, 0)
        for i in np.flatnonzero(self.last[slots]):
            row = self.start + (int(slots[i]) - self.start) % self.capacity
            following[i] = self.finals[row]
        observations = self.observations.take(slots, 0)
        if self.progress is not None:
            before, after = self.progress[slots].swapaxes(0, 1)
            observations = np.concatenate([observations, before], 1)
            following = np.concatenate([following, after], 1)
        return StepBatch(
            observations,
            self.actions.take(slots, 0),
            self.labels.take(slots),
            following,
            self.terminated.take(slots),
        )

    def windows(self, rows: I64, lengths: I64, steps: int) -> tuple[F32, F32, F32 | None]:
        """Steps that follow on each other, padded with zeros on the right.

        Args:
            rows: of each window's first step (B,).
            lengths: each window's steps (B,).
            steps: L that windows are padded to.

        Returns:
            Observations (B, L+1, O), the one after a window's last step included, actions
            (B, L, A) and, where they are held, true rewards (B, L).
        """
        padding = np.arange(steps + 1) > lengths[:, None]
        slots = (rows[:, None] + np.arange(steps + 1)) % self.capacity  # (B, L+1)
        observations = self.observations[slots]
        ends = rows + lengths - 1
        for i in np.flatnonzero(self.last[ends % self.capacity]):
            observations[i, lengths[i]] = self.finals[int(ends[i])]
        observations[padding] = 0
        actions = self.actions[slots[:, :-1]]
        actions[padding[:, 1:]] = 0
        if self.true_rewards is None:
            return observations, actions, None
        rewards = self.true_rewards[slots[:, :-1]]
        rewards[padding[:, 1:]] = 0
        return observations, actions, rewards

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
        scored = slice(0, self.scored.count)
        ends = self.scored.rows[scored] + self.scored.lengths[scored] - 1 - first
        new = self.scored.alive[scored] & (ends >= 0)
        rewards[ends[new]] = self.scored.values[scored][new]
        return Rollout(
            self.observations[slots],
            self.actions[slots],
            rewards,
            following,
            self.terminated[slots],
            last,
        )


def ranges(starts: I64, lengths: I64) -> I64:
    """Concatenate start, start + 1, ... of each (start, length)."""
    offsets = np.repeat(starts - np.concatenate([[0], np.cumsum(lengths)[:-1]]), lengths)
    return offsets + np.arange(int(lengths.sum()))
