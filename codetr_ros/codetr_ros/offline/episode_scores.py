"""Scores of an episode that is being converted: find the steps of each, and keep or drop it.

A score is of steps that began before it or with it. It belongs to the current episode, or to the
last one while no new one has begun. A score of all steps since the last score loses a step where
the last step was dropped. Everything that is dropped is counted.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from codetr_ros.bags.reader import Message
from codetr_ros.offline import mapping
from codetr_ros.offline.errors import FitError
from codetr_ros.offline.mapping import Mapping
from codetr_ros.records import CompositeReward

SCORE_NOT_FINITE = 'scores that are not finite'
SCORE_OF_NOTHING = 'scores of no step, or of fewer than are asked for'
SCORE_AGAIN = 'scores of steps that were scored before'
SCORE_DROPPED = 'scores of steps that were dropped'
SCORE_TRIMMED = 'scores whose last step was dropped, taken as of those before it'


@dataclass
class Conversion:
    """The counts of a conversion."""

    messages: Counter[str] = field(default_factory=Counter)  # read, by topic
    episodes: int = 0
    steps: int = 0
    scores: int = 0
    scored_steps: int = 0
    dropped: Counter[str] = field(default_factory=Counter)
    sizes: tuple[int, int] = (0, 0)  # of observations and actions
    shortest: float = float('inf')  # [s] between the begins of two steps
    longest: float = 0.0


class EpisodeScores:
    """Holds the scores of an episode until no more can come.

    Args:
        rules: the mapping.
        run_id: of the records.
        conversion: counts scores, and those that are dropped.
    """

    def __init__(self, rules: Mapping, run_id: str, conversion: Conversion) -> None:
        self._rules = rules
        self._run_id = run_id
        self._conversion = conversion
        self._begun = 0  # steps of the episode that have begun, without dropped ones
        self._scored = 0  # its steps before this one have had their score
        self._held: list[tuple[int, int, float]] = []  # first step, length, value

    def begin_episode(self) -> None:
        """Begin an episode; the scores of the one before must have been given."""
        self._begun = self._scored = 0

    def step_begun(self) -> None:
        """Count a step of the episode that begins."""
        self._begun += 1

    def step_dropped(self) -> None:
        """Drop the step that began last."""
        self._begun -= 1

    def take(self, message: Message) -> None:
        """Take the score that a message carries.

        Raises:
            FitError: its field holds no number.
        """
        rule = self._rules.score
        value = mapping.field(message.message, rule.field, rule.topic)
        try:
            number = float(value)
        except (TypeError, ValueError):
            raise FitError(f'{rule.topic}: field {rule.field!r} holds no number') from None
        length = self._begun - self._scored if rule.steps is None else rule.steps
        first = self._begun - length
        if not np.isfinite(number):
            self._conversion.dropped[SCORE_NOT_FINITE] += 1
        elif length < 1 or first < 0:
            self._conversion.dropped[SCORE_OF_NOTHING] += 1
        elif first < self._scored:
            self._conversion.dropped[SCORE_AGAIN] += 1
        else:
            self._held.append((first, length, number))
            self._scored = self._begun

    def give(self, episode: int, written: int) -> Iterator[CompositeReward]:
        """Yield the scores of an episode that has ended.

        Args:
            episode: its number.
            written: the number of its steps.
        """
        scores, self._held = self._held, []
        for first, length, value in scores:
            there = min(length, written - first)
            if there < length:
                trimmed = self._rules.score.of == 'since_last' and there > 0
                self._conversion.dropped[SCORE_TRIMMED if trimmed else SCORE_DROPPED] += 1
                if not trimmed:
                    continue
            yield CompositeReward(
                run_id=self._run_id,
                source=self._rules.source,
                scorer=self._rules.source,
                sequence=self._conversion.scores,
                episode=episode,
                first_step=first,
                length=there,
                value=value,
            )
            self._conversion.scores += 1
            self._conversion.scored_steps += there
