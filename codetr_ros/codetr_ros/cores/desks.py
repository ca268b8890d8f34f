"""The desks of all who score through services: one for each, by name.

A core: it takes the records of a run in, and yields what the scorers state. What they send is
checked here like a message; whom the run does not admit gets no desk.
"""

import hmac
import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.cores.core import Part
from codetr_ros.cores.scoring import Desk, Given, ScoringError
from codetr_ros.cores.seen import KINDS, Seen, Segment
from codetr_ros.records import F32, Commit, Record, RunSpec
from codetr_ros.records.numbering import Judgement
from codetr_ros.records.shown import shown
from codetr_ros.runs.reports import CoreReport

NAME = re.compile('[A-Za-z0-9_-]{1,64}')
"""The name of a scorer."""
MOST_SCORERS = 64
"""Desks that are opened where the run admits anybody."""
LONGEST_REASON = 255
ASKS_WITHIN = 30.0
"""Seconds in which a scorer asks again, as long as it scores."""
MOST_STEPS = 10_000
"""Steps that an answer holds at most, unless a single segment has more."""


@dataclass(frozen=True)
class Wanted:
    """Segments that a scorer should score next, and their steps.

    Attributes:
        segments: (S,) the most valuable first.
        observations: (sum of lengths, O) what the robot saw before each action.
        actions: (sum of lengths, A) what it did.
    """

    segments: list[Segment]
    observations: F32
    actions: F32


class Desks(Part):
    """Takes the judgements of several scorers.

    Args:
        run: the run.
        settings: its settings.

    Attributes:
        token: what a request must name; empty: anything will do.
    """

    subscribes: tuple[type, ...] = KINDS

    def __init__(self, run: RunSpec, settings: Settings) -> None:
        super().__init__()
        self._run = run
        self._settings = settings
        self.token = ''
        self.seen = Seen(run, settings)
        self._desks: dict[str, Desk] = {}
        self._asked: dict[str, float] = {}  # before the end: when each asked last [s, monotonic]

    @property
    def finished(self) -> bool:  # type: ignore[override]
        """Whether the last phase is committed."""
        return self.seen.finished

    def receive(self, record: Record) -> None:
        """Note a record.

        Raises:
            RecordError: it is of another run; nothing has changed then.
        """
        self.seen.receive(record)
        if isinstance(record, Commit):
            for desk in self._desks.values():
                desk.note(record)

    def work(self) -> Iterator[list[Judgement] | None]:
        """Yield judgements as soon as they are given."""
        while True:
            given = [each for desk in self._desks.values() for each in desk.published()]
            yield given or None

    # ---- scorers

    def inform(self, desk: Desk, now: float) -> bool:
        """Whether the run has ended, for the answer to a scorer.

        Args:
            desk: that of the scorer.
            now: monotonic time [s].
        """
        if self.finished:
            self._asked.pop(desk.scorer, None)
        else:
            self._asked[desk.scorer] = now
        return self.finished

    def awaits(self, now: float) -> bool:
        """Whether a scorer that has asked lately has not received that the run has ended.

        Args:
            now: monotonic time [s].
        """
        return any(now - at < ASKS_WITHIN for at in self._asked.values())

    def desk(self, scorer: str, token: str) -> Desk:
        """The desk of a scorer.

        Raises:
            ScoringError: the token is wrong, or nobody of this name may score.
        """
        if self.token and not hmac.compare_digest(token.encode(), self.token.encode()):
            raise ScoringError(
                f'the token {shown(repr(token))} is wrong: take the one that `codetr score '
                '--service` (or `codetr train --score-service`) has printed'
                if token
                else 'token is empty: this run has a key, so take the token that `codetr score '
                '--service` (or `codetr train --score-service`) has printed'
            )
        if (known := self._desks.get(scorer)) is not None:
            return known
        if reason := unadmitted(scorer, self._settings):
            raise ScoringError(f'scorer: {reason}')
        if self.seen.knows(scorer):
            raise ScoringError(f'scorer: {scorer!r} is a source of this run: take another name')
        if len(self._desks) >= MOST_SCORERS:
            raise ScoringError(
                f'scorer {scorer!r} would be one more than the {MOST_SCORERS} that score here '
                'already: give each scorer one name and keep it'
            )
        desk = self._desks[scorer] = Desk(self._run, self._settings, scorer, self.seen)
        return desk

    def score(
        self, desk: Desk, segment: Segment, value: float, scale: tuple[float, float]
    ) -> Given:
        """Score a segment; NaN: cannot tell.

        Args:
            desk: that of the scorer.
            segment: the segment; of length 0: the one that begins at its first step.
            value: the score.
            scale: its lowest and highest value; both 0: any number.

        Raises:
            ScoringError: there is no such segment, or the value is not on the scale.
        """
        lowest, highest = scale
        bounded = (lowest, highest) != (0.0, 0.0)
        if bounded and not (math.isfinite(lowest) and lowest < highest < math.inf):
            raise ScoringError(
                f'lowest {lowest:g} and highest {highest:g} are no scale: give two finite '
                'numbers, the lower one first, or 0 twice for any number'
            )
        if bounded and not math.isnan(value) and not lowest <= value <= highest:
            raise ScoringError(f'value {value:g} is not on the scale {lowest:g} to {highest:g}')
        if not segment[3]:
            found = self.seen.cut_at(*segment[:3])
            if found is None:
                raise ScoringError(
                    f'{shown(repr(segment[0]))}, episode {segment[1]}: no segment begins at step '
                    f'{segment[2]}, or not all of its steps are there yet (any more): take one '
                    'that `wanted_segments` answers'
                )
            segment = found
        return desk.score(segment, value)

    def wanted(self, desk: Desk, most: int, steps: bool) -> Wanted:
        """What a scorer should score next.

        Args:
            desk: that of the scorer.
            most: segments at most; 0: all.
            steps: with their steps.
        """
        with self.seen.lock:
            segments = desk.waiting()
            segments = segments[:most] if most else segments
            if not steps:
                return Wanted(segments, _none(), _none())
            shown_ones, held = _as_many_as_fit(segments), []
            for segment in shown_ones:
                curves = self.seen.curves(segment)
                assert curves is not None  # the lock is held
                held.append(curves)
        if not held:
            return Wanted([], _none(), _none())
        observations, actions = (np.concatenate(each) for each in zip(*held, strict=True))
        return Wanted(shown_ones, observations, actions)

    # ---- the node

    def waiting_for(self) -> str:
        """What the next slice waits for, in words."""
        return 'judgements by service'

    def close(self) -> None:
        """Nothing to save: what was stated is in the bag."""

    def report(self) -> CoreReport:
        """Counts for the run's summary, of all scorers together."""
        counters: dict[str, int] = {}
        for desk in self._desks.values():
            for name, count in desk.report().counters.items():
                counters[name] = counters.get(name, 0) + count
        return CoreReport(
            duplicated=dict(self.duplicated), refused=dict(self.refused), counters=counters
        )


def unadmitted(scorer: str, settings: Settings) -> str | None:
    """Why a run takes nothing of a scorer, in words; None if it does."""
    if reason := misnamed(scorer) or not_by_others(settings):
        return reason
    if settings.scorers and scorer not in settings.scorers:
        return (
            f'{scorer!r} is no scorer of this run, which takes the scores of '
            f'{", ".join(settings.scorers)} (setting scorers): take one of these names'
        )
    return None


def misnamed(scorer: str) -> str | None:
    """Why a scorer cannot have a name, in words; None if it can."""
    if NAME.fullmatch(scorer):
        return None
    return (
        f'{shown(repr(scorer))}: a scorer is named by 1 to 64 letters, digits, underscores and '
        'hyphens'
    )


def not_by_others(settings: Settings) -> str | None:
    """Why nobody but the simulator can score in a run, in words; None if others can."""
    if settings.scored_elsewhere:
        return None
    return (
        f'the scores of this run come from scorer = {settings.scorer!r}: start a run with '
        '--scorer person'
    )


def _none() -> F32:
    return np.zeros((0, 0), np.float32)


def _as_many_as_fit(segments: Sequence[Segment]) -> list[Segment]:
    """The first segments that have no more than `MOST_STEPS` together; one at least."""
    ends = np.cumsum([segment[3] for segment in segments])
    count = max(1, int(np.searchsorted(ends, MOST_STEPS, 'right')))
    return list(segments[:count])
