"""The desk of a person who scores: what waits to be judged, what was, and what became of it.

A core like the others: it takes the records of a run in and yields judgements. A page, or a
service, gives it judgements: `score` and `compare` may be called by any thread, and return at
once. What they refuse they refuse before anything is published.
"""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.cores.core import Part
from codetr_ros.cores.seen import KINDS, Seen, Segment
from codetr_ros.records import (
    OUTCOMES,
    Commit,
    CompositeReward,
    Preference,
    Record,
    RunSpec,
)
from codetr_ros.records.checks import check_score
from codetr_ros.records.numbering import Judgement
from codetr_ros.runs.reports import CoreReport

MOST_HISTORY = 200
"""Judgements that are shown; older ones can still be corrected by scoring the segment again."""


class ScoringError(ValueError):
    """A judgement that cannot be given: the message names the value and what is allowed."""


@dataclass
class Given:
    """A judgement that was given here."""

    record: Judgement
    after: int  # the phase that was committed last when it was given
    phase: int | None = None  # whose commit took it; None: none yet

    def document(self) -> dict[str, Any]:
        """For people."""
        record = self.record
        known: dict[str, Any] = {
            'sequence': record.sequence,
            'phase': self.phase,
            'segment': list(segment_of(record)),
        }
        if isinstance(record, Preference):
            other = (record.other_source, record.other_episode)
            other_steps = (record.other_first_step, record.other_length)
            return known | {'other': [*other, *other_steps], 'outcome': record.outcome}
        return known | {'value': record.value}


class Desk(Part):
    """Offers segments to one scorer, and yields what it states of them.

    Args:
        run: the run.
        settings: its settings.
        scorer: the name of the scorer, which the run must admit.
        seen: what is seen of the run, where several share it; None: seen by this desk alone.

    Attributes:
        problem: why the run would take nothing of what is stated here, so that nothing is
            published; None: it may take it.
    """

    subscribes: tuple[type, ...] = KINDS

    def __init__(
        self, run: RunSpec, settings: Settings, scorer: str, seen: Seen | None = None
    ) -> None:
        super().__init__()
        self._run = run
        self._settings = settings
        self.scorer = scorer
        self.seen = Seen(run, settings) if seen is None else seen
        self.problem: str | None = None
        self._lock = self.seen.lock
        self._judged: dict[Segment, Given] = {}  # the newest score of each
        self._given: deque[Given] = deque(maxlen=MOST_HISTORY)
        self._outbox: deque[Judgement] = deque()
        self._next = self.taken + 1  # as this scorer did before it came back
        self._published = False
        self._changes = 0

    # ------------------------------------------------------------------------------------------
    # the run

    @property
    def finished(self) -> bool:  # type: ignore[override]
        """Whether the last phase is committed."""
        return self.seen.finished

    @property
    def taken(self) -> int:
        """Number of the last judgement of this scorer that a commit took; -1: none."""
        return self.seen.taken.get(self.scorer, -1)

    @property
    def count(self) -> int:
        """How many judgements this scorer has given: those with a number below that."""
        return self._next

    @property
    def changes(self) -> int:
        """How often what there is to show has changed."""
        return self._changes + self.seen.changes

    def receive(self, record: Record) -> None:
        """Note a record.

        Raises:
            RecordError: it is of another run; nothing has changed then.
        """
        self.seen.receive(record)
        if isinstance(record, Commit):
            self.note(record)

    def refuse(self, problem: str) -> None:
        """Take nothing from now on.

        Args:
            problem: why the run would take nothing of what is stated here, and what to do.
        """
        self.problem = problem
        self._changes += 1

    def note(self, commit: Commit) -> None:
        """Note which judgements a commit took that has been seen."""
        with self._lock:
            if not self._published:
                self._next = max(self._next, self.taken + 1)
            for given in self._given:
                if given.phase is None and given.record.sequence <= self.taken:
                    given.phase = commit.phase

    def work(self) -> Iterator[list[Record] | None]:
        """Yield judgements as soon as they are given."""
        while True:
            yield self.published() or None  # type: ignore[misc]

    def published(self) -> list[Judgement]:
        """The judgements that were given since this was called before."""
        with self._lock:
            given = list(self._outbox)
            self._outbox.clear()
            return given

    # ------------------------------------------------------------------------------------------
    # the person

    def waiting(self) -> list[Segment]:
        """Segments that wait to be judged, the most valuable first; where nobody asks, the newest
        first.
        """
        with self._lock:
            return [segment for segment in self.seen.offered() if segment not in self._judged]

    def score(self, segment: Segment, value: float) -> Given:
        """Score a segment, or correct its score; NaN: cannot tell.

        Raises:
            ScoringError: there is no such segment, or no such score.
        """
        with self._lock:
            self._require(segment)
            source, episode, first, length = segment
            reward = CompositeReward(
                run_id=self._run.run_id,
                source=source,
                scorer=self.scorer,
                sequence=self._next,
                episode=episode,
                first_step=first,
                length=length,
                value=float(value),
            )
            try:
                check_score(reward, self._settings.scored_at_most, missing=True)
            except ValueError as error:
                raise ScoringError(str(error)) from None
            given = self._give(reward)
            self._judged[segment] = given
            return given

    def compare(self, first: Segment, second: Segment, outcome: float) -> Given:
        """State which of two segments is better: one of `OUTCOMES`, or NaN: cannot decide.

        Raises:
            ScoringError: there is no such segment, or no such outcome.
        """
        with self._lock:
            self._require(first)
            self._require(second)
            if first == second:
                raise ScoringError('a segment cannot be compared with itself: choose two')
            if outcome not in OUTCOMES and not np.isnan(outcome):
                raise ScoringError(f'outcome {outcome}: must be 1, 0.5, 0 or none')
            names = ('source', 'episode', 'first_step', 'length')
            preference = Preference(
                run_id=self._run.run_id,
                scorer=self.scorer,
                sequence=self._next,
                outcome=float(outcome),
                **dict(zip(names, first, strict=True)),  # type: ignore[arg-type]
                **dict(  # type: ignore[arg-type]
                    zip((f'other_{name}' for name in names), second, strict=True)
                ),
            )
            given = self._give(preference)
            for each in (first, second):
                self._judged.setdefault(each, given)
            return given

    def _require(self, segment: Segment) -> None:
        if self.problem:
            raise ScoringError(self.problem)
        if self.finished:
            raise ScoringError('the run has ended: nothing is learnt from what is stated now')
        most = self._settings.judgements_ahead
        if self._next - self.taken > most:
            raise ScoringError(
                f'{most} judgements of {self.scorer!r} wait for a commit, more are not taken: '
                'wait until a phase is done'
            )
        if segment in self._judged:
            return  # it was there once
        source, episode, first, length = segment
        if not self.seen.holds(segment):
            raise ScoringError(
                f'{source!r}, episode {episode}, steps {first} to {first + length - 1}: there is '
                'no such segment (any more): judge one that is shown'
            )

    def _give(self, record: Judgement) -> Given:
        self._next += 1
        self._published = True
        given = Given(record, self.seen.phase)
        self._given.append(given)
        self._outbox.append(record)
        self._changes += 1
        return given

    def _passed_over(self) -> int:
        """Judgements that none of some later commits took: no other reason is left than that the
        run refuses them, or that they were lost.
        """
        late = self.seen.phase - self._settings.ahead - 1
        return sum(given.phase is None and given.after < late for given in self._given)

    def document(self) -> dict[str, Any]:
        """What there is to show: segments that wait, judgements given, and the last commit."""
        with self._lock:
            return {
                'scorer': self.scorer,
                'task': self._settings.task,
                'problem': self.problem,
                'phase': self.seen.phase,
                'phases': self._settings.phases,
                'finished': self.finished,
                'asked_after': self.seen.asked_after,
                'passed_over': self._passed_over(),
                'waiting': [list(segment) for segment in self.waiting()],
                'given': [given.document() for given in list(self._given)[-20:]],
                'count': self._next,
            }

    # ------------------------------------------------------------------------------------------

    def waiting_for(self) -> str:
        """What the next slice waits for, in words."""
        return f'a judgement of {self.scorer!r}'

    def close(self) -> None:
        """Nothing to save: what was stated is in the bag."""

    def report(self) -> CoreReport:
        """Counts for the run's summary."""
        left = sum(given.phase is None for given in self._given)
        counts = {'judgements': self._next, 'judgements that no commit took': left}
        return CoreReport(
            duplicated=dict(self.duplicated), refused=dict(self.refused), counters=counts
        )


def segment_of(record: Judgement) -> Segment:
    """The segment that a judgement is of; the first one of a preference."""
    return record.source, record.episode, record.first_step, record.length
