"""Scores of episodes that are being converted: keep each until its steps are sure.

An ended episode is held for as long as a score of it may come, which the mapping defines. Which
steps a score is of is found in `score_booking`. Everything that is dropped is counted.
"""

from collections import Counter
from collections.abc import Iterator

import numpy as np

from codetr_ros.records import CompositeReward
from codetr_ros.records.checks import usable_score
from codetr_ros.robots import conversion
from codetr_ros.robots.conversion import Conversion
from codetr_ros.robots.mapping import Mapping
from codetr_ros.robots.message_fields import NS, Message, moment, name_in, number
from codetr_ros.robots.score_booking import Booking, Held, Verdict
from codetr_ros.robots.score_rules import Score
from codetr_ros.robots.scored_episode import ScoredEpisode


class EpisodeScores:
    """Holds episodes and their scores until no more can come.

    Args:
        rules: the mapping.
        run_id: of the records.
        made: counts scores, and those that are dropped.
        longest: seconds after its end that an episode is held, at the most.
    """

    def __init__(
        self, rules: Mapping, run_id: str, made: Conversion, longest: float = np.inf
    ) -> None:
        self._rules = rules
        assert rules.score is not None  # who books scores has a rule for them
        self._rule = rules.score
        self._run_id = run_id
        self._made = made
        # [ns] after its end that an episode is held
        self._horizon = min(_horizon(rules.score), longest * NS)
        self._held = Held()
        self._booking = Booking(rules.score, self._held)
        self._ahead: list[Verdict] = []  # whose time has not come yet
        self._named: dict[str | None, list[Verdict]] = {}  # until their episode closes
        self._names: Counter[str | None] = Counter()  # of the episodes that are held
        self._nameless: ScoredEpisode | None = None  # the one that the next message would name
        self._next_name: str | None = None
        self._shift = 0  # [ns] from a stamp to the time of steps
        self._forgotten = False  # whether no step is left of the last episode
        self.booked = 0
        """Scores that were looked at so far, to see of which steps they are."""

    @property
    def episodes(self) -> list[ScoredEpisode]:
        """The episodes that are held, in the order of their steps."""
        return self._held.episodes

    @property
    def running(self) -> ScoredEpisode | None:
        """The episode under way."""
        return self._held.running

    # ------------------------------------------------------------------------------------------
    # episodes

    def begin_episode(
        self, number: int, now: int, continues: bool = False
    ) -> Iterator[CompositeReward]:
        """Begin an episode; yields the scores of those of which no more can come.

        Args:
            number: of the episode.
            now: the time of its first step [ns].
            continues: whether it goes on with the last one, after steps that were lost.
        """
        held, before = self._held, self._held.ended
        unanswered = before is not None and before.answered < before.steps
        if before is not None and continues:
            before.whole = False
        held.either |= unanswered and not continues
        kept = 1 if self._rule.of == 'last_episode' else 0
        while len(held.episodes) > kept and now > held.episodes[0].end_or(now) + self._horizon:
            yield from self._close(held.episodes.pop(0))
        held.running = ScoredEpisode(
            number,
            now,
            whole=not continues,
            lacks_begin=continues and (unanswered or self._forgotten),
            name=self._next_name,
        )
        held.episodes.append(held.running)
        self._next_name = self._nameless = None
        self._forgotten = False

    def step_begun(self, now: int) -> None:
        """Count a step of the running episode, which begins now [ns]."""
        assert self._held.running is not None
        self._held.running.begin_step(now, self._rule.timed)
        self._book_waiting()

    def step_dropped(self) -> None:
        """Drop the step that began last."""
        assert self._held.running is not None
        self._held.running.drop_step()

    def end_episode(self, now: int | None) -> None:
        """End the running episode; one without steps is forgotten.

        Args:
            now: when it ends [ns]; when its last step began, if None.
        """
        ended = self._held.running
        if ended is None:
            return
        self._held.running = None
        ended.end = ended.last if now is None else now
        if ended.steps:
            self._held.ended = self._nameless = ended
            self._names[ended.name] += 1
        else:
            self._forgotten = True
            self._held.episodes.remove(ended)
            self._drop(conversion.SCORE_DROPPED, len(ended.segments))
        self._book_waiting()

    def name_episode(self, message: Message) -> None:
        """Name the episode that ended last, or the next one, by a message that ends episodes.

        Raises:
            MessageError: its field holds no name.
        """
        rule = self._rules.episode
        if rule.id is None:
            return
        name = name_in(message.message, rule.id, message.topic)
        if rule.id_is_of == 'next':
            self._next_name = name
        elif self._nameless is not None:
            self._names[self._nameless.name] -= 1
            self._nameless.name = name
            self._names[name] += 1
        self._nameless = None

    # ------------------------------------------------------------------------------------------
    # scores

    def take(self, message: Message, now: int) -> None:
        """Take the score that a message carries, received now [ns].

        Raises:
            MessageError: a field that the mapping names is not there, or holds something else.
        """
        rule, topic, content = self._rule, message.topic, message.message
        value = number(content, rule.field, topic)
        if not usable_score(value):
            finite = np.isfinite(value)
            self._drop(conversion.SCORE_TOO_LARGE if finite else conversion.SCORE_NOT_FINITE)
            value = float('nan')  # yet its steps have had their score
        at = now if rule.stamp is None else moment(content, rule.stamp, topic) + self._shift
        begin = at - round((rule.seconds or 0.0) * NS)
        if rule.begin is not None:
            begin = moment(content, rule.begin, topic) + self._shift
        name = None if rule.id is None else name_in(content, rule.id, topic)
        verdict = Verdict(value, at, now, begin, name)
        if name is not None:
            self._named.setdefault(name, []).append(verdict)
        elif at > now and self._shift:  # stamped before the clock went back, most likely
            self._count(conversion.SCORE_OF_EITHER, verdict)
        elif at > now:
            self._ahead.append(verdict)
        else:
            self._book(verdict)

    def advance(self, now: int) -> None:
        """Book the scores whose time has come before now [ns]."""
        if self._ahead:
            due = sorted((v for v in self._ahead if v.at < now), key=lambda v: v.at)
            self._ahead = [v for v in self._ahead if v.at >= now]
            for verdict in due:
                self._book(verdict)

    def clock_back(self, shift: int) -> None:
        """Note that the clock of the bag went back; no episode runs.

        Args:
            shift: what to add to the new times [ns], so that they follow those before.
        """
        self._shift = shift
        self._forget_ahead()

    def finish(self) -> Iterator[CompositeReward]:
        """Yield the scores that are still held: no more can come."""
        self._forget_ahead()
        for episode in self._held.episodes:
            yield from self._close(episode)
        for verdicts in self._named.values():
            for verdict in verdicts:
                self._count(conversion.SCORE_WITHOUT_EPISODE, verdict)

    def _forget_ahead(self) -> None:
        for verdict in self._ahead:
            self._count(conversion.SCORE_AHEAD, verdict)
        self._ahead = []

    def _book(self, verdict: Verdict) -> None:
        self.booked += 1
        self._count(self._booking.book(verdict), verdict)

    def _count(self, fault: str | None, verdict: Verdict) -> None:
        if fault is not None and not np.isnan(verdict.value):  # NaN was counted
            self._drop(fault)

    def _book_waiting(self) -> None:
        for verdict in self._booking.waiting():
            self._book(verdict)

    def _drop(self, what: str, times: int = 1) -> None:
        if times:
            self._made.dropped[what] += times

    # ------------------------------------------------------------------------------------------
    # giving them out

    def _close(self, episode: ScoredEpisode) -> Iterator[CompositeReward]:
        """Yield the scores of an ended episode that is not held any more."""
        assert episode.end is not None
        self._held.closed = episode.end
        self._take_named(episode)
        self._names[episode.name] -= 1
        for segment in episode.sound(self._rule.of != 'last_steps', self._made.dropped):
            yield CompositeReward(
                run_id=self._run_id,
                source=self._rules.source,
                scorer=self._rules.source,
                sequence=self._made.scores,
                episode=episode.number,
                first_step=segment.first,
                length=segment.length,
                value=segment.value,
            )
            made = self._made
            made.fewest = min(made.fewest, segment.length) if made.scores else segment.length
            made.most = max(made.most, segment.length)
            made.scores += 1
            made.scored_steps += segment.length

    def _take_named(self, episode: ScoredEpisode) -> None:
        """Book the scores that name an episode."""
        verdicts = self._named.pop(episode.name, []) if episode.name is not None else []
        for verdict in verdicts:
            fault: str | None = conversion.SCORE_OF_NAMESAKES
            if self._names[episode.name] == 1:
                fault = self._booking.book_whole(episode, verdict)
            self._count(fault, verdict)


def _horizon(rule: Score) -> float:
    """How long after its end [ns] an episode is held, because a score of it may come."""
    late = 0.0 if rule.by_arrival and rule.late is None else rule.late
    if rule.stamp is None:
        if rule.of == 'last_episode':
            late = 0.0  # the one that ended last is held anyway
        elif rule.seconds is not None:
            late = 0.0  # a window ends when its score comes
    if late is None:
        return float('inf')
    return (late + (rule.seconds or 0.0) + rule.again_within) * NS
