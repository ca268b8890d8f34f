"""The steps of the memory D: a ring for each source, and the rules by which steps come and go."""

from collections.abc import Iterable, Iterator, Sequence

import numpy as np

from codetr_ros.memory.ring import PROGRESS, Rollout, SourceRing, StoredEpisode
from codetr_ros.records import F64, RecordError, Transitions, TrueRewards

PART_ROWS = 1 << 16
"""Rows converted to double precision at a time."""


class Store:
    """The steps of all sources, whole episodes one after the other.

    Args:
        observation_size: O.
        action_size: A.
        capacity: steps, of all sources together, that `evict` leaves at the most.
        rows: steps that each source has room for.
        true_rewards: keep the environment's own rewards too.
        progress: keep how far each step's segment had come.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        capacity: int,
        rows: int,
        true_rewards: bool,
        progress: bool = False,
    ) -> None:
        self.observation_size = observation_size
        self.action_size = action_size
        self.capacity = capacity
        self.rows = rows
        self.true_rewards = true_rewards
        self.progress = progress
        self._sources: dict[str, SourceRing] = {}
        self._episodes = 0  # that have begun: the number of the next one in the order of age

    # ------------------------------------------------------------------------------------------
    # changing

    def append(self, chunk: Transitions) -> None:
        """Add consecutive steps that go on where their source's last ones ended.

        Raises:
            RecordError: they do not follow on what is here, or exceed the source's room; nothing
                has changed then.
        """
        source = self._sources.get(chunk.source)
        if source is None:
            source = SourceRing(
                chunk.source,
                self.observation_size,
                self.action_size,
                self.rows,
                self.true_rewards,
                self.progress,
            )
        if source.steps + chunk.steps > source.capacity:
            raise RecordError(
                f'{chunk.steps} steps of {chunk.source!r} exceed the memory: {source.steps} of '
                f'{source.capacity} rows are taken. Raise memory_steps ({self.capacity})'
            )
        source.append(chunk, self._episode_of(source, chunk))
        self._sources[chunk.source] = source

    def _episode_of(self, source: SourceRing, chunk: Transitions) -> StoredEpisode:
        """The episode that these steps go on with or begin."""
        last = source.newest
        expected = (0, 0)
        if last is not None and (chunk.episode, chunk.first_step) == (last.number + 1, 0):
            # its source could not go on with the one before, which ends as truncated
            last.ended = True
        if last is not None:
            expected = (last.number + 1, 0) if last.ended else (last.number, last.steps)
        if (chunk.episode, chunk.first_step) != expected:
            raise RecordError(
                f'transitions out of sequence: {chunk.source!r} sent episode {chunk.episode} '
                f'step {chunk.first_step} (sequence {chunk.sequence}); episode {expected[0]} '
                f'step {expected[1]} follows on what is here. Restart the source, or send what '
                'lies between'
            )
        if last is not None and not last.ended:
            if not np.array_equal(source.finals[source.end - 1], chunk.observations[0]):
                raise RecordError(
                    f'transitions of {chunk.source!r}, episode {chunk.episode}, step '
                    f'{chunk.first_step}: the first observation is not the one that the steps '
                    'before ended with'
                )
            return last
        episode = source.begin(chunk.episode, self._episodes)
        self._episodes += 1
        return episode

    def append_true_rewards(self, record: TrueRewards) -> None:
        """Add the environment's own rewards of steps that are here."""
        source = self._sources[record.source]
        assert source.true_rewards is not None, 'this memory was made without true rewards'
        start = source.by_number[record.episode].start + record.first_step
        rows = np.arange(start, start + len(record.rewards))
        source.true_rewards[rows % source.capacity] = record.rewards

    def evict(self) -> int:
        """Drop whole episodes, oldest first, until at most `capacity` steps are held.

        The last episode of all is kept however long it is: an empty memory teaches nothing.

        Returns:
            The number of steps dropped.
        """
        dropped = 0
        while self.steps > self.capacity and sum(len(s.episodes) for s in self.sources) > 1:
            ended = [s for s in self.sources if s.episodes and s.episodes[0].ended]
            if not ended:
                break  # only unfinished episodes are left, which must not be cut
            oldest = min(ended, key=lambda s: s.episodes[0].order)
            dropped += oldest.evict_oldest()
        return dropped

    # ------------------------------------------------------------------------------------------
    # reading

    @property
    def terminates(self) -> bool:
        """Whether an episode that it holds has ended in a terminal state."""
        return any(each.terminal for source in self._sources.values() for each in source.episodes)

    @property
    def sources(self) -> list[SourceRing]:
        """Each source's steps, in the order in which the sources sent the first of them."""
        return list(self._sources.values())

    def by_name(self) -> list[SourceRing]:
        """Each source's steps, in the order of the sources' names."""
        return [self._sources[name] for name in sorted(self._sources)]

    def source(self, name: str) -> SourceRing | None:
        """A source's steps; None if it sent none."""
        return self._sources.get(name)

    def awaits(self, name: str, episode: int, steps: int) -> bool:
        """Whether an episode has not come, or has fewer than so many steps so far and goes on."""
        source = self._sources.get(name)
        newest = source.newest if source else None
        if newest is None or episode > newest.number:
            return True
        return episode == newest.number and not newest.ended and newest.steps < steps

    @property
    def steps(self) -> int:
        """Steps held."""
        return sum(s.steps for s in self._sources.values())

    @property
    def bytes_per_step(self) -> int:
        """Bytes of a row: observation, action, label, its model version, two flags."""
        per_row = 4 * self.observation_size + 4 * self.action_size + 4 + 4 + 1 + 1
        per_row += 4 if self.true_rewards else 0
        return per_row + (2 * PROGRESS * 4 if self.progress else 0)

    @property
    def nbytes(self) -> int:
        """Bytes of the rows in use, with each episode's final observation."""
        rows = sum(s.used for s in self._sources.values())
        finals = sum(len(s.finals) for s in self._sources.values())
        return rows * self.bytes_per_step + finals * 4 * self.observation_size

    def newest(self, counts: Sequence[int]) -> Rollout:
        """The last steps of each source, in the order of names.

        Args:
            counts: how many of each source; fewer where fewer are held.
        """
        # a source without any step yet is not among them
        parts = [s.newest_steps(n) for s, n in zip(self.by_name(), counts, strict=False)]
        fields = Rollout.__dataclass_fields__
        return Rollout(*(np.concatenate([getattr(p, name) for p in parts]) for name in fields))

    def observation_moments(self) -> tuple[F64, F64]:
        """Mean (O,) and standard deviation (O,) of the observations of all steps held."""
        if not self.steps:
            return np.zeros(self.observation_size), np.ones(self.observation_size)
        mean = _sum(self._observations()) / self.steps
        squares = _sum((rows - mean) ** 2 for rows in self._observations())
        return mean, np.sqrt(squares / self.steps)

    def _observations(self) -> Iterator[F64]:
        """The observations of all steps held, part by part: (rows, O)."""
        for source in self._sources.values():
            for first in range(source.start, source.end, PART_ROWS):
                rows = np.arange(first, min(first + PART_ROWS, source.end))
                yield source.observations[rows % source.capacity].astype(np.float64)


def _sum(parts: Iterable[F64]) -> F64:
    """The sum of all rows, one after the other, as if the parts were one array."""
    total: F64 | None = None
    for part in parts:
        rows = part if total is None else np.concatenate([total[None], part])
        total = rows.sum(0)
    assert total is not None
    return total
