"""What has arrived of the steps and scores of each source and scorer, number by number."""

import logging
from collections import Counter, defaultdict
from collections.abc import Iterable
from typing import Any

from codetr_ros.config import Settings
from codetr_ros.cores.left_out import voided
from codetr_ros.records import TOPICS, CompositeReward, Record, RecordError, Transitions, describe
from codetr_ros.records.chain import Chain, publisher
from codetr_ros.records.numbering import Judgement, Numbering

_log = logging.getLogger(__name__)


class Arrived:
    """The numbers that have arrived, and how many of them are committed.

    Args:
        settings: of the run.
        chain: has the digests of what has arrived.
        duplicated: counts of records that arrive again, by topic.

    Attributes:
        counters: what was dropped, by its name in the report.
    """

    def __init__(self, settings: Settings, chain: Chain, duplicated: 'Counter[str]') -> None:
        self._settings = settings
        self._chain = chain
        self._duplicated = duplicated
        self._steps: Counter[tuple[int, str]] = Counter()  # (phase, source)
        self._ended: dict[tuple[int, str], tuple[int, int]] = {}  # -> last sequence, scores due
        self._transitions: Counter[str] = Counter()  # next sequence number of each source
        self._scores: Counter[str] = Counter()  # next sequence number of each scorer
        self._numbers: defaultdict[str, Numbering] = defaultdict(Numbering)
        self._committed_scores: Counter[str] = Counter()
        self.counters: Counter[str] = Counter()

    # ------------------------------------------------------------------------------------------
    # records that arrive

    def transitions(self, record: Transitions) -> None:
        """Note steps.

        Raises:
            RecordError: they are out of sequence, or others of that number have come.
        """
        if not self._next(record, self._transitions, record.source):
            return
        self._chain.note(record)
        self._steps[record.phase, record.source] += record.steps
        if record.phase_end:
            self._ended[record.phase, record.source] = (record.sequence, record.scores_due)

    def score(self, record: CompositeReward) -> None:
        """Note a score of a simulator, which come in order.

        Raises:
            RecordError: it is out of sequence, or another of that number has come.
        """
        if self._next(record, self._scores, record.scorer):
            self._chain.note(record)

    def judgement(self, record: Judgement) -> None:
        """Note a judgement of another scorer; its earlier ones may still be on their way.

        Raises:
            RecordError: it is too far ahead, or another of that number has come.
        """
        name, numbers = record.scorer, self._numbers[record.scorer]
        most = self._committed_scores[name] + self._settings.judgements_ahead
        if record.sequence >= most:
            raise RecordError(
                f'{describe(record)} is out of sequence: {numbers.next} is the next of {name!r}, '
                f'and a scorer may give {self._settings.judgements_ahead} judgements between two '
                'commits. Number them from 0 on, without gaps'
            )
        if not numbers.take(record.sequence):
            self._repeated(record)
            return
        self._chain.note(record)
        if len(numbers.early) == 1 and record.sequence in numbers.early:
            _log.warning(
                '%s of %r waits for number %s, which has not arrived: nothing is learnt from it '
                'before', describe(record), name, numbers.next,
            )  # fmt: skip
        self._scores[name] = numbers.next

    def due(self, record: Record) -> tuple[int, int] | None:
        """The number that must come next from its publisher, and that of the record; None if they
        may come in any order.
        """
        if isinstance(record, Transitions):
            return self._transitions[record.source], record.sequence
        if isinstance(record, CompositeReward) and not self._settings.scored_elsewhere:
            return self._scores[record.scorer], record.sequence
        return None

    def _next(self, record: Any, due: 'Counter[str]', name: str) -> bool:
        if record.sequence > due[name]:
            raise RecordError(
                f'{describe(record)} is out of sequence: {due[name]} is the next of {name!r}. '
                f'What lies between never arrived: restart {name!r}'
            )
        if record.sequence < due[name]:
            self._repeated(record)
            return False
        due[name] += 1
        return True

    def _repeated(self, record: Transitions | Judgement) -> None:
        """Count a record that arrives again.

        Raises:
            RecordError: it is not the one that has come before.
        """
        if self._chain.contradicts(record):
            _, name = publisher(record)
            raise RecordError(
                f'{describe(record)} is not the record of that number that has come from {name!r} '
                'already: stop the second one of that name'
            )
        self._duplicated[TOPICS[type(record)]] += 1

    # ------------------------------------------------------------------------------------------
    # phases

    def all_of(self, phase: int, source: str, steps: int) -> bool:
        """Whether all steps of a source in a phase are there, and their scores."""
        end = self._ended.get((phase, source))
        if end is None or self._steps[phase, source] != steps:
            return False
        return self._scores[source] >= self._committed_scores[source] + end[1]

    def lacks(self, phase: int, source: str, steps: int) -> str | None:
        """What is lacking of a source in a phase, for people; None: nothing."""
        have = self._steps[phase, source]
        if have < steps:
            return f'{steps - have} of {steps} steps of {source!r}'
        if (phase, source) in self._ended:
            scores = self._committed_scores[source] + self._ended[phase, source][1]
            if scores > self._scores[source]:
                return f'{scores - self._scores[source]} composite rewards of {source!r}'
        return None

    def commit(self, phase: int, source: str) -> int:
        """Commit a source's part of a phase, all of which is there; the number of its last
        transitions.
        """
        sequence, due = self._ended.pop((phase, source))
        del self._steps[phase, source]
        self._committed_scores[source] += due
        return sequence

    def drop(self, phase: int, source: str) -> int:
        """Drop what came of a source in a phase, and void the numbers of what may still come; the
        last of those of its transitions.
        """
        self.counters['steps dropped'] += self._steps.pop((phase, source), 0)
        self.counters['phases of a source dropped'] += 1
        self._ended.pop((phase, source), None)
        last = voided(self._settings, self._transitions[source])
        self._transitions[source] = last + 1
        if not self._settings.scored_elsewhere:
            self._scores[source] = voided(self._settings, self._scores[source]) + 1
            self._committed_scores[source] = self._scores[source]
        return last

    def committed_scores(self, members: Iterable[str]) -> dict[str, int]:
        """The last number that is committed of each scorer, by name. Of those whose scores nobody
        waits for, a person or a robot itself, these are all so far.

        Args:
            members: the sources of the phase that is being committed.
        """
        waited_for = () if self._settings.scored_elsewhere else members
        for scorer in set(self._scores).difference(waited_for):
            self._committed_scores[scorer] = self._scores[scorer]
        return {name: n - 1 for name, n in sorted(self._committed_scores.items()) if n}

    def left_over(self) -> dict[str, int]:
        """Judgements that no commit has named: they came too late, or after a gap."""
        gaps = sum(len(numbers.early) for numbers in self._numbers.values())
        late = sum(n.next - self._committed_scores[name] for name, n in self._numbers.items())
        counts = {'judgements after the last commit': late, 'judgements after a gap': gaps}
        return {name: count for name, count in counts.items() if count}
