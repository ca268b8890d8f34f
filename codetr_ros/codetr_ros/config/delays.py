"""The delay: how many steps a score is of, and where episodes are cut into segments.

25          n = 25 steps; the last segment of an episode may be shorter
10:50       lengths from 10 to 50 steps, each as likely, drawn by the run's seed
episode     one score for each episode, at its end

In a table: docs/methods.md#segments.
"""

import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
from pydantic import BeforeValidator
from pydantic_core import PydanticCustomError

from codetr_ros.config.base import SettingsError, Whole
from codetr_ros.records import I64

LONGEST = 100_000
"""The most steps of a segment that a delay may name."""
EPISODE = 'episode'


@dataclass(frozen=True)
class Lengths:
    """How long segments are; the last of an episode is cut short by its end."""

    least: int  # steps
    most: int | None  # steps; None: as many as the episode has

    @classmethod
    def of(cls, delay: int | str) -> 'Lengths':
        """Those that a delay names.

        Raises:
            ValueError: it names none; says what is allowed.
        """
        if delay == EPISODE:
            return cls(1, None)
        if isinstance(delay, int) and not isinstance(delay, bool):
            least, most = delay, delay
        else:
            found = re.fullmatch(r'(\d{1,6}):(\d{1,6})', delay) if isinstance(delay, str) else None
            if not found:
                raise ValueError(
                    'a delay is a number of steps (25), two of them between which lengths are '
                    f'drawn (10:50), or {EPISODE}'
                )
            least, most = int(found[1]), int(found[2])
            if least >= most:
                raise ValueError(
                    f'lengths are drawn from {least} to {most} steps: the second number must be '
                    'the larger one; a single number makes all segments as long'
                )
        if not 1 <= least <= most <= LONGEST:
            raise ValueError(f'a segment has 1 to {LONGEST} steps')
        return cls(least, most)

    @property
    def drawn(self) -> bool:
        """Whether lengths differ and are drawn by the seed."""
        return self.most is not None and self.least < self.most

    def ends(self, seed: int, source: str, episode: int, steps: int) -> I64:
        """The ends of the whole segments within the first `steps` steps of an episode, ascending.

        They depend on nothing else: neither on phases nor on how long the episode lasts.
        """
        if self.most is None:
            return np.empty(0, np.int64)
        if not self.drawn:
            return np.arange(self.most, steps + 1, self.most)
        from codetr_ros.seeding import generator  # takes seconds to import, with torch

        rng = generator(seed, 'delay', source, episode)
        ends = np.cumsum(rng.integers(self.least, self.most + 1, steps // self.least + 1))
        within: I64 = ends[ends <= steps]
        return within


def checked(value: Any) -> int | str:
    """A delay as settings hold it: a number, `least:most` or `episode`.

    Raises:
        PydanticCustomError: it is none.
    """
    delay: int | str = int(value) if isinstance(value, str) and value.isdecimal() else value
    try:
        lengths = Lengths.of(delay)
    except ValueError as error:
        raise PydanticCustomError('delay', '{why}', {'why': str(error)}) from None
    return f'{lengths.least}:{lengths.most}' if lengths.drawn else delay


def delay_in_words(delay: int | str) -> str:
    """A delay for titles: `25 steps`, `10 to 50 steps`, `whole episodes`."""
    lengths = Lengths.of(delay)
    if lengths.most is None:
        return 'whole episodes'
    return f'{lengths.least} to {lengths.most} steps' if lengths.drawn else f'{delay} steps'


Delay = Annotated[int | str, BeforeValidator(checked), Whole(1, LONGEST)]
"""A delay in settings."""


class Delayed:
    """What follows from the delay of a run, mixed into its settings."""

    if TYPE_CHECKING:  # fields of `Settings`; with annotations at run time they would come first
        delay: int | str

    @property
    def lengths(self) -> Lengths:
        """How long segments are."""
        return Lengths.of(self.delay)

    @property
    def longest(self) -> int:
        """The steps n of the longest segment; for `episode` only after `Settings.within`.

        Raises:
            SettingsError: that is for the task to say.
        """
        most = self.lengths.most
        if most is None:
            raise SettingsError(
                f'delay = {self.delay}: how long segments are depends on the task; give a number '
                'of steps'
            )
        return most

    @property
    def scored_at_most(self) -> int:
        """The most steps of a score, as far as that is known without the task."""
        return self.lengths.most or LONGEST
