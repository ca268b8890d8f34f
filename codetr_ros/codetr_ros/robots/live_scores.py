"""Scores that a robot publishes itself, live: which segment of the run each is of.

`episode_scores` finds the steps of a score, as for a recording. A run cuts its episodes into
segments by its own setting (`delay`), so that these steps are then matched with a segment: the one
that shares more than half of both. A score is given out as soon as its steps are sure; one that
comes late, or is corrected, later. Everything that is dropped is counted and logged.
"""

import logging
import math
from collections import Counter
from collections.abc import Callable, Iterable
from typing import Any, NamedTuple

from codetr_ros.config import Settings, SettingsError
from codetr_ros.config.cuts import Cuts
from codetr_ros.records import CompositeReward
from codetr_ros.records.shown import worth_a_line
from codetr_ros.robots import conversion
from codetr_ros.robots.conversion import Conversion
from codetr_ros.robots.episode_scores import EpisodeScores
from codetr_ros.robots.errors import MessageError
from codetr_ros.robots.mapping import Mapping
from codetr_ros.robots.message_fields import NS
from codetr_ros.robots.score_rules import Score
from codetr_ros.robots.scored_episode import WHOLE, ScoredEpisode

_log = logging.getLogger(__name__)

HELD = 3600.0
"""Seconds for which an episode is held after its end, at the most, for scores that come late."""

GIVEN = 'scores given'
LATE = 'scores given after the phase of their steps, which join a later commit'
WITHOUT = 'segments without a score'
INEXACT = 'scores of nearly the steps of a segment, taken as of it'
NO_SEGMENT = 'scores of no one segment of the run'
UNREADABLE = 'scores without the fields of the mapping'
HINTS = conversion.HINTS | {
    NO_SEGMENT: 'the setting `delay` cuts episodes into segments, and a score must be of more '
    'than half of one, and of little else. Let `delay` be as long as what a score is of, or '
    '`episode`',
}
"""What to do about some of the counts."""

Key = tuple[int, int]
"""Episode and first step."""


class _Message(NamedTuple):
    topic: str
    message: Any


class _Segment(NamedTuple):
    """A segment of the run whose steps are whole."""

    first: int
    length: int
    phase: int  # to which its last step belongs

    def matches(self, first: int, length: int) -> bool:
        """Whether it shares more than half of its steps with these, and they with it."""
        end = min(self.first + self.length, first + length)
        return 2 * (end - max(self.first, first)) > max(self.length, length)


def scoring(rules: Mapping, settings: Settings, name: str) -> Mapping:
    """The mapping, without its part `score` where the run takes no scores of this robot.

    Raises:
        SettingsError: the run has no place for the scores that the part defines.
    """
    rule, live = rules.score, rules.live
    assert live is not None
    if rule is None:
        return rules
    if not settings.scored_elsewhere:
        raise SettingsError(
            f'scorer = {settings.scorer}: the mapping has the score topic {rule.topic}, whose '
            'scores come when they come; start the learner with scorer:=topic, or leave `score` '
            'out of the mapping'
        )
    if settings.scorer != 'topic' or (settings.scorers and name not in settings.scorers):
        return rules.model_copy(update={'score': None})
    whole = rule.of in ('last_episode', 'episode')
    if whole and settings.scored_at_most < live.episode_steps:
        raise SettingsError(
            f'delay = {settings.delay}: scores on {rule.topic} are of whole episodes (score.of = '
            f'{rule.of}), which have up to {live.episode_steps} steps; start the learner with '
            'delay:=episode'
        )
    if rule.id is not None and rule.late is None:
        raise SettingsError(
            f'mapping: score.id = {rule.id} without score.late: a score that names its episode is '
            'given out once no other can come; give the seconds by which it may be late'
        )
    return rules


class LiveScores:
    """Makes records of a robot's scores.

    Args:
        rules: the mapping. Without its part `score` there is nothing to do.
        run_id: of the records.
        source: whose steps are scored; also the name of the scorer.
        cuts: where the run cuts episodes into segments.
        phase: returns the phase to which the newest whole step belongs.
    """

    def __init__(
        self, rules: Mapping, run_id: str, source: str, cuts: Cuts, phase: Callable[[], int]
    ) -> None:
        self._run_id, self._source = run_id, source
        self._cuts, self._phase = cuts, phase
        self._sequence = 0
        self._made = Conversion()
        self._counts: Counter[str] = Counter()
        self._logged: Counter[str] = Counter()
        self._segments: dict[int, list[_Segment]] = {}  # of the episodes that are held
        self._given: dict[Key, float] = {}  # the newest score of each segment
        self._unmatched: set[Key] = set()
        self._running: ScoredEpisode | None = None
        self._sure = 0  # whole steps of it
        self._ending: _Message | None = None  # that ends it, and may name it
        self._booked = 0
        self._out: list[CompositeReward] = []
        self._books: EpisodeScores | None = None
        if rules.score is not None:
            rule = _by_stamp(rules.score, rules.stamped)
            made = rules.model_copy(update={'score': rule, 'source': source})
            self._books = EpisodeScores(made, run_id, self._made, HELD)

    def resume(self, sequence: int) -> None:
        """Go on with this number of the next score: a node before this one gave those below."""
        self._sequence = max(self._sequence, sequence)

    def taken(self) -> list[CompositeReward]:
        """The scores that have become sure since the last call."""
        out, self._out = self._out, []
        return out

    # ---- what the robot does

    def begin(self, number: int, now: float) -> None:
        """Begin an episode now [s]; scores of the oldest are given up waiting for."""
        if self._books is None:
            return
        self._sure, self._ending = 0, None
        self._close(self._books.begin_episode(number, round(now * NS)))
        self._running = self._books.running

    def step_begun(self, now: float) -> None:
        """Note that a step of the episode begins now [s]."""
        if self._books is not None:
            self._books.step_begun(round(now * NS))

    def step_dropped(self) -> None:
        """Note that the step that began last will never be whole."""
        if self._books is not None and self._running is not None:
            self._books.step_dropped()

    def step_whole(self, steps: int, now: float) -> None:
        """Note that the episode has so many whole steps now [s]."""
        if self._running is None:
            return
        self._cut(steps, False)
        self._sure = steps
        self._give_ready(self._running)
        self.look(now)

    def end(self, now: float) -> None:
        """End the episode now [s]: all of its steps are known."""
        episode, self._running = self._running, None
        if episode is None or self._books is None:
            return
        self._cut(episode.steps, True, episode)
        self._books.end_episode(round(now * NS))
        if self._ending is not None:
            self._name(self._ending)
        self._give_ready(episode)
        self.look(now)

    def _cut(self, steps: int, ended: bool, episode: ScoredEpisode | None = None) -> None:
        episode = episode or self._running
        assert episode is not None
        cut = self._cuts.segments(self._source, episode.number, self._sure, steps, ended)
        self._segments.setdefault(episode.number, []).extend(
            _Segment(first, length, self._phase()) for first, length in cut
        )

    # ---- what it publishes

    def take(self, topic: str, message: Any, now: float) -> None:
        """Take a message of the score topic, received now [s]."""
        assert self._books is not None
        try:
            self._books.take(_Message(topic, message), round(now * NS))
        except MessageError as error:
            self._made.dropped[UNREADABLE] += 1
            self._log_dropped(str(error))
        self.look(now)

    def end_message(self, topic: str, message: Any) -> None:
        """Take a message that ends the episode: it may name it, or the next one."""
        if self._books is None:
            return
        if self._running is None:
            self._name(_Message(topic, message))
        else:
            self._ending = _Message(topic, message)

    def _name(self, message: _Message) -> None:
        assert self._books is not None
        try:
            self._books.name_episode(message)
        except MessageError as error:
            self._made.dropped[UNREADABLE] += 1
            self._log_dropped(str(error))

    def look(self, now: float) -> None:
        """Give out the scores whose time has come now [s]."""
        if self._books is None:
            return
        self._books.advance(round(now * NS))
        if self._books.booked != self._booked:
            self._booked = self._books.booked
            for episode in self._books.episodes:
                self._give_ready(episode)
        self._log_dropped()

    # ---- giving them out

    def _give_ready(self, episode: ScoredEpisode) -> None:
        """Give out what is sure of an episode, and new or changed."""
        for segment in episode.segments:
            first, length = segment.first, segment.length
            if episode.end is None and (length == WHOLE or first + length > self._sure):
                continue
            self._give(episode.number, first, min(length, episode.steps - first), segment.value)

    def _close(self, scores: Iterable[CompositeReward]) -> None:
        """Give out what is left of episodes of which no more can come, and forget them."""
        for score in scores:
            self._give(score.episode, score.first_step, score.length, score.value)
        assert self._books is not None
        oldest = self._books.episodes[0].number
        for number in [number for number in self._segments if number < oldest]:
            self._counts[WITHOUT] += self._lacking(number)
            for segment in self._segments.pop(number):
                self._given.pop((number, segment.first), None)
        self._unmatched = {key for key in self._unmatched if key[0] >= oldest}

    def _lacking(self, number: int) -> int:
        """Segments of an episode without a score."""
        return sum((number, each.first) not in self._given for each in self._segments[number])

    def _give(self, number: int, first: int, length: int, value: float) -> None:
        if math.isnan(value) or length < 1:
            return  # such scores are counted by those who book them
        found = [s for s in self._segments.get(number, ()) if s.matches(first, length)]
        if not found:
            running = self._running is not None and self._running.number == number
            if not running and (number, first) not in self._unmatched:
                self._unmatched.add((number, first))
                self._made.dropped[NO_SEGMENT] += 1
            return
        (segment,) = found  # no two segments share a step
        if self._given.get((number, segment.first)) == value:
            return
        self._given[number, segment.first] = value
        self._counts[GIVEN] += 1
        self._counts[LATE] += segment.phase < self._phase()
        self._counts[INEXACT] += (segment.first, segment.length) != (first, length)
        self._out.append(
            CompositeReward(
                run_id=self._run_id,
                source=self._source,
                scorer=self._source,
                sequence=self._sequence,
                episode=number,
                first_step=segment.first,
                length=segment.length,
                value=value,
            )
        )
        self._sequence += 1

    # ---- reports

    def _log_dropped(self, why: str = '') -> None:
        """Log what was dropped: the first ten of a kind, then every thousandth."""
        for what, count in self._made.dropped.items():
            if count > self._logged[what] and worth_a_line(count):
                hint = why or HINTS.get(what, '')
                _log.warning('dropped: %s (%d so far)%s', what, count, hint and f': {hint}')
            self._logged[what] = count

    def report(self) -> Counter[str]:
        """Counts: of scores given, of those that were dropped, of segments without one."""
        counts = self._counts + self._made.dropped
        counts[WITHOUT] += sum(self._lacking(number) for number in self._segments)
        return counts if self._books is not None else Counter()


def _by_stamp(rule: Score, stamped: set[str]) -> Score:
    """The rule of a score whose messages have the time of their header.

    Messages of a recording are sorted by that time. Live, they come when they come.
    """
    if rule.stamp is not None or rule.topic not in stamped:
        return rule
    return rule.model_copy(update={'stamp': 'header.stamp'})
