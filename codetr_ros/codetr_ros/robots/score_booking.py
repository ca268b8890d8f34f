"""Find the steps of a score: by the time of its reception, or by a time that it carries.

Reception alone cannot show which episode a score is of when it comes after the end of an earlier
one had no score: such a score is dropped, unless the mapping defines how late scores may be.
"""

import math
from bisect import bisect_left, bisect_right
from dataclasses import dataclass, field
from typing import NamedTuple

from codetr_ros.robots import conversion
from codetr_ros.robots.message_fields import NS
from codetr_ros.robots.score_rules import Score
from codetr_ros.robots.scored_episode import WHOLE, ScoredEpisode, ScoredSteps


class Verdict(NamedTuple):
    """A score, as a message carries it."""

    value: float  # NaN: one that cannot be used
    at: int  # its time [ns]: of its stamp, or of its reception
    received: int  # [ns]
    begin: int = 0  # of its window [ns]
    name: str | None = None  # of its episode


class _Latest(NamedTuple):
    """The score that was booked or dropped last."""

    at: int  # [ns]
    segment: ScoredSteps | None  # that it was booked on
    fault: str | None = None  # why it was dropped


@dataclass
class Held:
    """The episodes of which scores may come, in the order of their steps."""

    episodes: list[ScoredEpisode] = field(default_factory=list)
    running: ScoredEpisode | None = None
    ended: ScoredEpisode | None = None  # the one that ended last
    closed: int | None = None  # when the last of those ended that are not held any more [ns]
    either: bool = False  # whether an episode before the last one ended without a score

    def begun_by(self, at: int) -> int:
        """The number of episodes that had begun at a time [ns]."""
        return bisect_right(self.episodes, at, key=lambda episode: episode.begin)


class Booking:
    """Books scores on held episodes.

    Args:
        rule: the part of the mapping about scores.
        held: the episodes.
    """

    def __init__(self, rule: Score, held: Held) -> None:
        self._rule = rule
        self._held = held
        self._latest: _Latest | None = None
        self._waiting: list[Verdict] = []  # for whether the running episode goes on after them

    def book(self, verdict: Verdict) -> str | None:
        """Find the steps of a score; returns what to count if not every score is kept."""
        if self._rule.stamp is not None and self._late(verdict.at, verdict):
            return conversion.SCORE_LATE
        if self._rule.of == 'window':
            return self._window(verdict)
        if self._rule.of == 'last_episode':
            return self._last_episode(verdict)
        if self._rule.of == 'episode':
            return self.book_whole(self._stamped(verdict), verdict)
        return self._last(verdict)

    def waiting(self) -> list[Verdict]:
        """Return the scores that waited for a step or for the end of the running episode."""
        waiting, self._waiting = self._waiting, []
        return waiting

    def _last(self, verdict: Verdict) -> str | None:
        """Book a score of steps that end with it; returns what to count if it is dropped."""
        latest, within = self._latest, self._rule.again_within * NS
        if within and latest is not None and 0 <= verdict.at - latest.at <= within:
            self._latest = latest._replace(at=verdict.at)
            if latest.segment is None:
                return latest.fault
            return _again(latest.segment, verdict, self._rule.again)
        found = self._arrived(verdict) if self._rule.stamp is None else self._stamped(verdict)
        fault = found if isinstance(found, str) else self._up_to(found, verdict)
        if fault is not None:
            self._latest = _Latest(verdict.at, None, fault)
        return fault

    def _up_to(self, episode: ScoredEpisode, verdict: Verdict) -> str | None:
        """Book a score of the last steps of an episode up to its time."""
        by_stamp, steps = self._rule.stamp is not None, self._rule.steps
        begun = episode.begun(verdict.at) if by_stamp else episode.steps
        if steps is None and episode.lacks_begin:
            episode.lacks_begin = False
            episode.answered = begun
            return conversion.SCORE_OF_PART
        if begun == episode.answered:
            last = episode.segments[-1] if episode.segments else None
            if last is None or min(last.first + last.length, episode.steps) != begun:
                return conversion.SCORE_OF_NOTHING
            self._latest = _Latest(verdict.at, last)
            return _again(last, verdict, self._rule.again)
        first = episode.answered if steps is None else begun - steps
        if first < 0:
            return conversion.SCORE_OF_NOTHING
        if begun <= first:
            return conversion.SCORE_AGAIN
        return self._add(episode, first, begun - first, verdict)

    def _arrived(self, verdict: Verdict) -> ScoredEpisode | str:
        """The episode of a score by its reception; what to count if there is none."""
        late, last = self._rule.late, self._held.running or self._held.ended
        if last is None:
            return conversion.SCORE_WITHOUT_EPISODE
        if late is None:
            return conversion.SCORE_OF_EITHER if self._held.either else last
        if last.end is not None and self._late(last.end, verdict):
            return conversion.SCORE_LATE
        unanswered = [
            episode
            for episode in self._held.episodes
            if episode.end is not None and not self._late(episode.end, verdict)
            if episode.answered < episode.steps and late > 0
        ]
        if len(unanswered) > 1:
            return conversion.SCORE_OF_EITHER
        return unanswered[0] if unanswered else last

    def _stamped(self, verdict: Verdict) -> ScoredEpisode | str:
        """The episode that had begun last at the time of a score, or what to count."""
        at = self._held.begun_by(verdict.at)
        return self._held.episodes[at - 1] if at else conversion.SCORE_WITHOUT_EPISODE

    def _last_episode(self, verdict: Verdict) -> str | None:
        """Book a score of the episode that had ended last; returns what to count if it is dropped.

        A score after an episode's last step, and before the message that ends it, is of that
        episode, unless the one before has no score yet: then it may be of either.
        """
        if self._held.running is not None and verdict.at >= self._held.running.last:
            self._waiting.append(verdict)
            return None
        at = self._held.begun_by(verdict.at)
        ending = None
        while at and not self._held.episodes[at - 1].had_ended(verdict.at):
            at -= 1
            if verdict.at >= self._held.episodes[at].last:
                ending = self._held.episodes[at]
        ended = self._held.episodes[at - 1] if at else None
        if ending is None:
            return self.book_whole(ended or conversion.SCORE_WITHOUT_EPISODE, verdict)
        if ended is not None and not ended.segments and not self._late(ended.end, verdict):
            return conversion.SCORE_OF_EITHER
        return self.book_whole(ending, verdict)

    def book_whole(self, episode: ScoredEpisode | str, verdict: Verdict) -> str | None:
        """Book a score of a whole episode; returns what to count if it is dropped."""
        if isinstance(episode, str):
            return episode
        if self._late(episode.end, verdict):
            return conversion.SCORE_LATE
        return self._add(episode, 0, WHOLE, verdict)

    def _window(self, verdict: Verdict) -> str | None:
        """Book a score of the steps of a window; returns what to count if it is dropped."""
        if self._held.closed is not None and verdict.begin <= self._held.closed:
            return conversion.SCORE_LATE
        found = []
        at = bisect_left(self._held.episodes, verdict.at, key=lambda episode: episode.begin)
        for episode in reversed(self._held.episodes[:at]):
            first, end = episode.between(verdict.begin, verdict.at)
            if end > first:
                found.append((episode, first, end - first))
            elif episode.end is not None and episode.end < verdict.begin:
                break
        if len(found) != 1:
            return conversion.SCORE_ACROSS if found else conversion.SCORE_OF_NOTHING
        return self._add(*found[0], verdict)

    def _add(
        self, episode: ScoredEpisode, first: int, length: int, verdict: Verdict
    ) -> str | None:
        made = episode.add(first, length, verdict.value)
        if made is not None:
            self._latest = _Latest(verdict.at, made)
            return None
        same = episode.segment(first, length)
        return _again(same, verdict, self._rule.again) if same else conversion.SCORE_AGAIN

    def _late(self, end: int | None, verdict: Verdict) -> bool:
        """Whether a score comes too late for what ended at `end` [ns], if it has ended."""
        late = self._rule.late
        return late is not None and end is not None and verdict.received - end > late * NS


def _again(segment: ScoredSteps, verdict: Verdict, again: str) -> str | None:
    """Take a second score of the same steps; returns what to count."""
    if math.isnan(segment.value):
        segment.value = verdict.value
        return None
    if again == 'first' or math.isnan(verdict.value):
        return conversion.SCORE_SECOND
    segment.value = verdict.value
    return conversion.SCORE_REPLACED
