"""The episode that was under way when a source ended, as recorded, and how to be in it again.

A deterministic environment comes back by itself: reset with the episode's seed it takes the
recorded actions again, under the same global seeds as then, and must do the same to the bit. One
that does something else cannot be brought back.
"""

import math
from collections import Counter
from collections.abc import Iterator

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.records import CompositeReward, Record, Transitions, TrueRewards
from codetr_ros.seeding import generator, seed_global
from codetr_ros.simulation.episode import EpisodeRunner, Score
from codetr_ros.simulation.scorer import Scorer


class DiffersError(ValueError):
    """An environment that did something else than what is recorded: names what."""


class OpenEpisode:
    """Takes the records of a source, each kind in its order; holds those of the episode that is
    under way. True rewards and scores may come before their steps: topics overtake each other.

    Args:
        settings: of the run.
        name: of the source.
    """

    def __init__(self, settings: Settings, name: str) -> None:
        self._settings = settings
        self._name = name
        self._chunks: list[tuple[Transitions, int]] = []  # steps of the phase taken before each
        self._rewards: dict[int, TrueRewards] = {}  # by the number of their chunk
        self._scores: list[CompositeReward] = []
        self._taken: Counter[int] = Counter()  # steps of each phase
        self.counters: Counter[str] = Counter()
        """What the source had counted."""
        self.episode = -1
        """Number of the last episode."""
        self.sequence = 0
        """Number of the next chunk."""
        self.scores = 0
        """Number of the next score."""

    def take(self, record: Record) -> None:
        """Take the next record of this source."""
        if isinstance(record, Transitions):
            self._take_chunk(record)
        elif isinstance(record, TrueRewards):
            if self._open(record.episode):
                self._rewards[record.sequence] = record
        elif isinstance(record, CompositeReward):
            self.scores = record.sequence + 1
            self.counters.update({'scores': 1, 'scores missing': int(math.isnan(record.value))})
            if self._open(record.episode):
                self._scores.append(record)

    def _open(self, episode: int) -> bool:
        """Whether an episode is under way, or still to begin."""
        return episode > self.episode or (episode == self.episode and bool(self._chunks))

    def _take_chunk(self, chunk: Transitions) -> None:
        if chunk.first_step == 0:
            self._chunks = []
            self._forget(chunk.episode)
        self._chunks.append((chunk, self._taken[chunk.phase]))
        self._taken[chunk.phase] += chunk.steps
        self.episode, self.sequence = chunk.episode, chunk.sequence + 1
        self.counters.update(chunks=1, steps=chunk.steps)
        if chunk.terminated or chunk.truncated:
            self._chunks = []
            self._forget(chunk.episode + 1)
            self.counters['episodes'] += 1

    def _forget(self, episode: int) -> None:
        """Forget what is of episodes before one."""
        self._rewards = {n: r for n, r in self._rewards.items() if r.episode >= episode}
        self._scores = [score for score in self._scores if score.episode >= episode]

    @property
    def steps(self) -> int:
        """Steps that the open episode has so far; 0 if none is open."""
        return sum(chunk.steps for chunk, _ in self._chunks)

    def go_through(self, runner: EpisodeRunner, scorer: Scorer) -> None:
        """Bring environment and scorer to where the episode was.

        Raises:
            DiffersError: the environment did something else than recorded.
            TaskError: it is at fault.
        """
        settings, name = self._settings, self._name
        scorer.begin(self.episode)
        scores = iter(self._scores)
        for chunk, taken in self._chunks:
            seed_global(settings.seed, 'environment', name, chunk.phase, taken)
            if chunk.first_step == 0:
                seeds = generator(settings.seed, 'reset', name, self.episode)
                runner.reset(int(seeds.integers(2**31)), self.episode)
            self._compare('observation', 0, chunk, runner.observation, chunk.observations[0])
            true = self._rewards.get(chunk.sequence)
            for t in range(chunk.steps):
                reward, score = runner.step(chunk.actions[t])
                self._compare(
                    'observation', t + 1, chunk, runner.observation, chunk.observations[t + 1]
                )
                if true is not None:
                    self._compare('reward', t, chunk, np.float32(reward), true.rewards[t])
                if score is not None:
                    self._compare_score(score, scorer.given(score.value), next(scores, None))
                if runner.over:
                    raise DiffersError(
                        f'it ends after {runner.length} steps, and is recorded to go on'
                    )

    @staticmethod
    def _compare(what: str, step: int, chunk: Transitions, is_: object, was: object) -> None:
        if not np.array_equal(np.asarray(is_), np.asarray(was), equal_nan=True):
            raise DiffersError(
                f'the {what} of step {chunk.first_step + step} is {is_}, recorded is {was}'
            )

    @staticmethod
    def _compare_score(score: Score, given: float, was: CompositeReward | None) -> None:
        if was is None:
            raise DiffersError(
                f'the score of step {score.first_step} is {given}, recorded is none'
            )
        if given != was.value and not (math.isnan(given) and math.isnan(was.value)):
            raise DiffersError(
                f'the score of step {score.first_step} is {given}, recorded is {was.value}'
            )

    def abandon(self, runner: EpisodeRunner, scorer: Scorer) -> Iterator[tuple[Score, float]]:
        """End the episode as truncated where it was, by its recorded rewards.

        Yields:
            The score of the segment that is cut short, and what the scorer gives; nothing if none
            is, or if not all rewards are recorded.
        """
        if any(chunk.sequence not in self._rewards for chunk, _ in self._chunks):
            runner.length, runner.truncated = -1, True
            return
        parts = [self._rewards[chunk.sequence].rewards for chunk, _ in self._chunks]
        score = runner.abandon(np.concatenate(parts).tolist(), self.episode)
        scorer.begin(self.episode)
        for known in self._scores:
            scorer.given(known.value)
        if score is not None and all(s.first_step != score.first_step for s in self._scores):
            yield score, scorer.given(score.value)
