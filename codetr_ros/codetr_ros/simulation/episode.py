"""Runs episodes step by step, cut into segments that are scored on the way.

Simulators and the evaluator share this code, so that a score means the same in both.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.records import F32, EpisodeResult
from codetr_ros.simulation.composite import composite, perfect_score
from codetr_ros.simulation.tasks import Environment, check, r_max


@dataclass(frozen=True)
class Score:
    """The composite reward of the `length` steps that begin at `first_step` of their episode."""

    first_step: int
    length: int
    value: float


class EpisodeRunner:
    """Runs one episode after another in an environment, each cut into segments from its start.

    An episode ends in a terminal state (`terminated`), or is cut off (`truncated`) at the horizon
    or before, where the environment itself does so. One that reaches a terminal state at that very
    step is terminated only. Its last segment may be shorter and is scored too.

    Args:
        environment: the environment; this object steps it and nothing else may.
        settings: composite, beta, delay, r_max and seed.
        name: whose episodes these are: lengths of segments are drawn by seed, name and episode.

    Raises:
        SettingsError: the delay exceeds the horizon.
    """

    def __init__(self, environment: Environment, settings: Settings, name: str) -> None:
        check(settings, environment)
        self._environment = environment
        self._settings = settings = settings.within(environment.horizon)
        self._name = name
        self._perfect = perfect_score(
            settings.composite,
            settings.beta,
            settings.longest,
            environment.horizon,
            r_max(settings, environment),
            settings.lengths.least,
        )
        self._rewards = np.zeros(environment.horizon, np.float64)
        self.terminated = False
        self.truncated = True  # there is no episode yet: begin with `reset`
        self.observation: F32 = np.zeros(environment.observation_size, np.float32)
        self.length = 0
        self._first_step = 0  # of the present segment
        # lengths at which a segment is to be scored, unless the episode ends before
        self._ends: Iterator[int] = iter(())
        self._due = 0
        self._composite_return = 0.0

    @property
    def over(self) -> bool:
        """Whether the episode has ended, so that `reset` is due."""
        return self.terminated or self.truncated

    @property
    def place(self) -> int:
        """Steps of the present segment so far."""
        return self.length - self._first_step

    def reset(self, seed: int, number: int) -> None:
        """Start episode `number`, from the start that `seed` determines."""
        self.observation = self._environment.reset(seed)
        self._begin(number)

    def _begin(self, number: int) -> None:
        settings, horizon = self._settings, self._environment.horizon
        self.terminated = self.truncated = False
        self.length = self._first_step = 0
        ends = settings.lengths.ends(settings.seed, self._name, number, horizon)
        self._ends = iter(ends.tolist())
        self._due = next(self._ends, horizon)
        self._composite_return = 0.0

    def step(self, action: F32) -> tuple[float, Score | None]:
        """Take an action (A,) in [-1, 1].

        Returns:
            The environment's reward, and the score of the segment that the step completed or cut
            short, if any.

        Raises:
            TaskError: the environment returned a number that is not finite, or is at fault.
            CompositeError: the segment's composite reward is not finite.
        """
        self.observation, reward, self.terminated = self._environment.step(action)
        return reward, self._note(reward, self._environment.truncated)

    def abandon(self, rewards: Sequence[float], number: int) -> Score | None:
        """End episode `number` as truncated after steps of these rewards, as if they had been
        taken here: for an environment that cannot be brought back to where they led.

        Returns:
            The score of the segment that is cut short, if one is.
        """
        self._begin(number)
        for reward in rewards[:-1]:
            self._note(reward, False)
        return self._note(rewards[-1], True)

    def _note(self, reward: float, cut: bool) -> Score | None:
        """Note a step's reward; the score of the segment that it completed or cut short."""
        self._rewards[self.length] = reward
        self.length += 1
        if self.length < self._due and not self.terminated and not cut:
            return None
        ends = cut or self.length == self._environment.horizon
        self.truncated = ends and not self.terminated
        first, settings = self._first_step, self._settings
        segment = self._rewards[first : self.length]
        value = composite(settings.composite, segment, settings.beta, settings.longest)
        score = Score(first, len(segment), value)
        self._first_step = self.length
        self._due = next(self._ends, self._environment.horizon)
        self._composite_return += score.value
        return score

    def result(
        self, run_id: str, source: str, purpose: str, step: int, version: int, episode: int
    ) -> EpisodeResult:
        """The result of the episode. `source` to `episode` are the fields of the record."""
        return EpisodeResult(
            run_id=run_id,
            source=source,
            purpose=purpose,
            step=step,
            version=version,
            episode=episode,
            length=self.length,
            true_return=float(self._rewards[: self.length].sum()),
            composite_return=self._composite_return,
            score=self._composite_return / self._perfect,
            terminated=self.terminated,
        )
