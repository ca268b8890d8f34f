"""The desk of a person who scores: what waits to be judged, what was, and what became of it.

A core like the others: it takes the records of a run in and yields judgements. A page, or a
service, gives it judgements: `score` and `compare` may be called by any thread, and return at
once. What they refuse they refuse before anything is published.
"""

import threading
from collections import OrderedDict, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.cores.core import Part
from codetr_ros.records import (
    OUTCOMES,
    Commit,
    CompositeReward,
    Preference,
    Record,
    RunSpec,
    ScoreRequest,
    Transitions,
)
from codetr_ros.records.checks import check_run, check_score
from codetr_ros.records.numbering import Judgement
from codetr_ros.runs.reports import CoreReport

Segment = tuple[str, int, int, int]
"""Source, episode, first step, length."""

MOST_STEPS = 100_000
"""Steps whose observations and actions are held for the curves; the oldest episodes go first."""
MOST_HISTORY = 200
"""Judgements that are shown; older ones can still be corrected by scoring the segment again."""
NEWEST = 16
"""Segments that are offered where nobody asks for any."""


class ScoringError(ValueError):
    """A judgement that cannot be given: the message names the value and what is allowed."""


@dataclass
class Given:
    """A judgement that was given here."""

    record: Judgement
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


@dataclass
class _Episode:
    """The steps of an episode that have come."""

    observations: list[Any] = field(default_factory=list)
    actions: list[Any] = field(default_factory=list)
    steps: int = 0


class Desk(Part):
    """Offers segments to one scorer, and yields what it states of them.

    Args:
        run: the run.
        settings: its settings.
        scorer: the name of the scorer, which the run must admit.
    """

    subscribes: tuple[type, ...] = (Transitions, ScoreRequest, Commit)

    def __init__(self, run: RunSpec, settings: Settings, scorer: str) -> None:
        super().__init__()
        self._run = run
        self._settings = settings
        self.scorer = scorer
        self._lock = threading.Lock()
        self._episodes: OrderedDict[tuple[str, int], _Episode] = OrderedDict()
        self._held = 0  # steps
        self._cut: deque[Segment] = deque(maxlen=NEWEST)  # the newest, where nobody asks
        self._asked: list[Segment] = []  # the most valuable first
        self._request: int | None = None  # phase of the newest request
        self._judged: dict[Segment, Given] = {}  # the newest score of each
        self._given: deque[Given] = deque(maxlen=MOST_HISTORY)
        self._outbox: deque[Judgement] = deque()
        self._next = 0
        self._published = False
        self.phase = -1  # the last that was committed
        self.changes = 0

    # ------------------------------------------------------------------------------------------
    # the run

    def receive(self, record: Record) -> None:
        """Note a record.

        Raises:
            RecordError: it is of another run; nothing has changed then.
        """
        check_run(record, self._run)
        with self._lock:
            self.changes += 1
            if isinstance(record, Transitions):
                self._append(record)
            elif isinstance(record, ScoreRequest):
                self._ask(record)
            elif isinstance(record, Commit):
                self._commit(record)

    def _append(self, chunk: Transitions) -> None:
        episode = self._episodes.setdefault((chunk.source, chunk.episode), _Episode())
        episode.observations.append(chunk.observations[:-1])
        episode.actions.append(chunk.actions)
        episode.steps += chunk.steps
        self._held += chunk.steps
        while self._held > MOST_STEPS and len(self._episodes) > 1:
            self._held -= self._episodes.popitem(last=False)[1].steps
        ended = chunk.terminated or chunk.truncated
        after = chunk.first_step + chunk.steps
        cut = self._settings.cuts.segments(
            chunk.source, chunk.episode, chunk.first_step, after, ended
        )
        for first, length in cut:
            self._cut.append((chunk.source, chunk.episode, first, length))

    def _ask(self, request: ScoreRequest) -> None:
        if self._request is not None and request.phase < self._request:
            return
        columns = (request.episodes, request.first_steps, request.lengths)
        rows = [column.tolist() for column in columns]
        self._request = request.phase
        self._asked = list(zip(request.sources, *rows, strict=True))

    def _commit(self, commit: Commit) -> None:
        self.phase = max(self.phase, commit.phase)
        last = dict(zip(commit.scorers, commit.scores.tolist(), strict=True)).get(self.scorer, -1)
        if not self._published:
            self._next = max(self._next, last + 1)  # as this scorer did before it came back
        for given in self._given:
            if given.phase is None and given.record.sequence <= last:
                given.phase = commit.phase
        if commit.phase >= self._settings.phases - 1:
            self.finished = True

    def work(self) -> Iterator[list[Record] | None]:
        """Yield judgements as soon as they are given."""
        while True:
            with self._lock:
                given = list(self._outbox)
                self._outbox.clear()
            yield given or None  # type: ignore[misc]

    # ------------------------------------------------------------------------------------------
    # the person

    def waiting(self) -> list[Segment]:
        """Segments that wait to be judged, the most valuable first; where nobody asks, the newest
        first.
        """
        with self._lock:
            return self._waiting()

    def _waiting(self) -> list[Segment]:
        asked = self._asked or list(reversed(self._cut))
        held = [segment for segment in asked if self._whole(segment)]
        return [segment for segment in held if segment not in self._judged]

    def _whole(self, segment: Segment) -> bool:
        source, episode, first, length = segment
        known = self._episodes.get((source, episode))
        return known is not None and known.steps >= first + length

    def curves(self, segment: Segment) -> tuple[Any, Any] | None:
        """Observations (m, O) and actions (m, A) of a segment; None if they are not held."""
        source, episode, first, length = segment
        with self._lock:
            if not self._whole(segment):
                return None
            known = self._episodes[source, episode]
            part = slice(first, first + length)
            observations = np.concatenate(known.observations)[part]
            return observations, np.concatenate(known.actions)[part]

    def actions_before(self, segment: Segment) -> Any:
        """The actions (n, A) of its episode up to a segment's end; None if they are not held."""
        source, episode, first, length = segment
        with self._lock:
            if not self._whole(segment):
                return None
            return np.concatenate(self._episodes[source, episode].actions)[: first + length]

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
        if self.finished:
            raise ScoringError('the run has ended: nothing is learnt from what is stated now')
        if segment in self._judged:
            return  # it was there once
        source, episode, first, length = segment
        cut = self._settings.cuts.segments(source, episode, first, first + length, True)
        if not self._whole(segment) or next(cut, None) != (first, length):
            raise ScoringError(
                f'{source!r}, episode {episode}, steps {first} to {first + length - 1}: there is '
                'no such segment (any more): judge one that is shown'
            )

    def _give(self, record: Judgement) -> Given:
        self._next += 1
        self._published = True
        given = Given(record)
        self._given.append(given)
        self._outbox.append(record)
        self.changes += 1
        return given

    def document(self) -> dict[str, Any]:
        """What there is to show: segments that wait, judgements given, and the last commit."""
        with self._lock:
            return {
                'scorer': self.scorer,
                'task': self._settings.task,
                'phase': self.phase,
                'phases': self._settings.phases,
                'finished': self.finished,
                'asked_after': self._request,
                'waiting': [list(segment) for segment in self._waiting()],
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
