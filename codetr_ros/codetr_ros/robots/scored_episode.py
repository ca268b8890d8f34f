"""An episode that is being converted, with the scores of its steps."""

import math
from array import array
from bisect import bisect_left, bisect_right
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field

from codetr_ros.robots import conversion

WHOLE = 1 << 62
"""The length of a segment that ends with its episode."""


@dataclass(slots=True)
class ScoredSteps:
    """Steps of an episode, and their score."""

    first: int
    length: int
    value: float  # NaN: it had a score that cannot be used


@dataclass(eq=False)
class ScoredEpisode:
    """The begins of an episode's steps, and its scores until no more can come.

    Args:
        number: of the episode.
        begin: of its first step [ns].
        whole: whether no step of it is known to be lost.
        lacks_begin: whether its first score is of lost steps too.
    """

    number: int
    begin: int
    whole: bool = True
    lacks_begin: bool = False
    end: int | None = None  # [ns]
    last: int = 0  # begin of its last step [ns]
    name: str | None = None
    steps: int = 0  # that have begun, without dropped ones
    answered: int = 0  # its steps before this one have had their score
    # the begins of its steps, where scores need them: these are 8 bytes a step
    times: 'array[int]' = field(default_factory=lambda: array('q'))
    segments: list[ScoredSteps] = field(default_factory=list)  # in the order of their steps

    def begin_step(self, now: int, timed: bool) -> None:
        """Begin a step.

        Args:
            now: its time [ns].
            timed: whether to hold it.
        """
        self.steps += 1
        self.last = now
        if timed:
            self.times.append(now)

    def drop_step(self) -> None:
        """Drop the step that began last."""
        self.steps -= 1
        self.answered = min(self.answered, self.steps)
        if self.times:
            self.times.pop()

    def begun(self, at: int) -> int:
        """The number of its steps that had begun at a time: before it, or with it."""
        return bisect_right(self.times, at)

    def had_ended(self, at: int) -> bool:
        """Whether it had ended at a time [ns]."""
        return self.end is not None and self.end <= at

    def end_or(self, now: int) -> int:
        """When it ended [ns]; now, while it runs."""
        return now if self.end is None else self.end

    def between(self, begin: int, end: int) -> tuple[int, int]:
        """The first of its steps that began at `begin` or later, and the first at `end` or
        later.
        """
        return bisect_left(self.times, begin), bisect_left(self.times, end)

    def segment(self, first: int, length: int) -> ScoredSteps | None:
        """Its score of exactly these steps."""
        at = bisect_left(self.segments, first, key=lambda s: s.first)
        mine = self.segments[at : at + 1]
        return mine[0] if mine and (mine[0].first, mine[0].length) == (first, length) else None

    def add(self, first: int, length: int, value: float) -> ScoredSteps | None:
        """Add a score; None where a step of it has one already."""
        at = bisect_left(self.segments, first, key=lambda s: s.first)
        before = self.segments[at - 1] if at else None
        after = self.segments[at] if at < len(self.segments) else None
        if (before and before.first + before.length > first) or (
            after and first + length > after.first
        ):
            return None
        made = ScoredSteps(first, length, value)
        self.segments.insert(at, made)
        self.answered = max(self.answered, first + length)
        return made

    def sound(self, trim: bool, dropped: 'Counter[str]') -> Iterator[ScoredSteps]:
        """Its scores, when it has ended.

        Args:
            trim: take a score whose last steps are not there as of the others; else drop it.
            dropped: counts both.
        """
        for segment in self.segments:
            if math.isnan(segment.value):
                continue  # it was counted
            there = min(segment.length, self.steps - segment.first)
            whole = segment.length == WHOLE
            if whole and not self.whole:
                dropped[conversion.SCORE_OF_PART] += 1
            elif there == segment.length or (whole and there > 0):
                yield ScoredSteps(segment.first, there, segment.value)
            elif trim and there > 0:
                dropped[conversion.SCORE_TRIMMED] += 1
                yield ScoredSteps(segment.first, there, segment.value)
            else:
                dropped[conversion.SCORE_DROPPED] += 1
