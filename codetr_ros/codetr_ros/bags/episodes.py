"""Checks of the steps and scores of one source in a bag, one after the other.

Memory: twelve bytes for each episode, and whatever still waits for its counterpart.
"""

from array import array
from collections import OrderedDict
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np

from codetr_ros.bags.findings import Findings
from codetr_ros.config.cuts import Cuts
from codetr_ros.records import (
    CompositeReward,
    RecordError,
    TaskSpec,
    Transitions,
    TrueRewards,
    describe,
)
from codetr_ros.records.checks import check_transitions
from codetr_ros.records.numbering import Numbering

_MOST_SKIPPED = 1_000_000  # episodes
_MOST_EARLY = 10_000  # scores
_MOST_AHEAD = 10_000  # chunks kept for their true rewards while none have come yet
_U32 = 2**32 - 1
Span = tuple[int, int, int]
"""Episode, first step, length."""


class Numbers:
    """The sequence numbers of one source or scorer."""

    def __init__(self, whose: str, findings: Findings) -> None:
        self.whose = whose
        self.next = 0
        self.whole = 0  # no number below this one is missing
        self.committed = -1  # last one that a commit has named
        self._findings = findings

    def take(self, sequence: int, place: Any) -> bool:
        """Note a number and return whether it is new."""
        if sequence < self.next:
            self._findings.add(
                'duplicate', place, f'{self.whose}: number {sequence} comes again or out of order'
            )
            return False
        if sequence > self.next:
            missing = missing_numbers(self.next, sequence - 1)
            self._findings.add('gap', place, f'{self.whose}: {missing} missing before {sequence}')
        elif self.whole == sequence:
            self.whole = sequence + 1
        self.next = sequence + 1
        return True

    def skip(self, last: int) -> None:
        """Go on behind a number: those up to there are voided, and will not come."""
        if self.whole == self.next:
            self.whole = max(self.whole, last + 1)
        self.next = max(self.next, last + 1)

    def commit(self, last: int) -> None:
        """Everything up to this number belongs to the phases committed so far."""
        self.committed = max(self.committed, last)

    def finish(self, place: Any) -> None:
        """Report what never came."""


class SharedNumbers(Numbers):
    """The numbers of a scorer whose scores and preferences come on two topics: a number may come
    before one below it.
    """

    def __init__(self, whose: str, findings: Findings) -> None:
        super().__init__(whose, findings)
        self._numbering = Numbering()

    def take(self, sequence: int, place: Any) -> bool:
        """Note a number and return whether it is new."""
        if not self._numbering.take(sequence):
            self._findings.add('duplicate', place, f'{self.whose}: number {sequence} comes again')
            return False
        self.next = self.whole = self._numbering.next
        return True

    def skip(self, last: int) -> None:
        """Go on behind a number: those up to there are voided, and will not come."""
        self._numbering.skip(last)
        self.next = self.whole = self._numbering.next

    def finish(self, place: Any) -> None:
        """Report what never came."""
        if early := sorted(self._numbering.early):
            missing = missing_numbers(self.next, early[0] - 1)
            self._findings.add('gap', place, f'{self.whose}: {missing} missing before {early[0]}')


def missing_numbers(first: int, last: int) -> str:
    """`number 3 is` or `numbers 3 to 5 are`, before the word 'missing'."""
    return f'number {first} is' if first == last else f'numbers {first} to {last} are'


class SourceChecks:
    """Checks of what one simulator or robot did.

    Args:
        name: its name.
        cuts: where the run's settings cut episodes; None where the bag has no settings.
        findings: where faults are added.
        elsewhere: others than the simulator score: a segment may have no score, or several.
    """

    def __init__(
        self, name: str, cuts: Cuts | None, findings: Findings, elsewhere: bool = False
    ) -> None:
        self.name = name
        self.cuts = cuts
        self.elsewhere = elsewhere
        self.spec: TaskSpec | None = None
        self.numbers = Numbers(f'transitions of {name!r}', findings)
        # phase -> sequence number of its last chunk, until committed
        self.ends: dict[int, int] = {}
        self.steps = 0
        self.steps_dropped = 0
        self.phases_dropped = 0
        self.scored = 0
        self.ahead = 0  # scores and true rewards whose steps were to be committed later
        self._findings = findings
        self._lengths = array('I')  # steps of each episode so far
        self._until = array('I')  # steps of each episode up to the end of its last scored segment
        self._ended = array('B')
        self.abandoned = 0  # episodes that their source could not go on with
        self._may_be_scored: set[tuple[int, int, int]] = set()  # the segments that they cut short
        self._last: tuple[int, int, bytes] | None = None  # episode, next step, its observation
        self._due: dict[Span, tuple[int, Any]] = {}  # segments without score -> sequence, place
        # scores whose steps have not come, chunks without true rewards, true rewards without chunk
        self._early: list[tuple[CompositeReward, Any]] = []
        self._chunks: OrderedDict[int, Span] = OrderedDict()
        self._true: dict[int, tuple[Span, Any]] = {}
        self._has_true = False
        self._passed = -1  # true rewards of chunks up to this number are not compared

    def transitions(self, chunk: Transitions, place: Any) -> None:
        """Check the next steps."""
        if not self.numbers.take(chunk.sequence, place):
            return
        self._values(chunk, place)
        self._follow(chunk, place)
        if chunk.phase_end:
            self.ends[chunk.phase] = chunk.sequence
        self.steps += chunk.steps
        self._lengthen(chunk, place)
        span = chunk.episode, chunk.first_step, chunk.steps
        if chunk.sequence in self._true:
            self._compare(span, *self._true.pop(chunk.sequence))
        else:
            self._chunks[chunk.sequence] = span
            if not self._has_true and len(self._chunks) > _MOST_AHEAD:
                self._passed, _ = self._chunks.popitem(last=False)
        early, self._early = self._early, []
        for reward, where in early:
            self.score(reward, where)

    def dropped(self, chunk: Transitions, place: Any) -> None:
        """Check steps that were dropped, because their source was left out of the phase."""
        if chunk.sequence >= self.numbers.next:  # else they came after the commit
            self.numbers.take(chunk.sequence, place)
        self.steps_dropped += chunk.steps
        self._values(chunk, place)

    def _values(self, chunk: Transitions, place: Any) -> None:
        if self.spec is not None:
            try:
                check_transitions(chunk, self.spec)
            except RecordError as error:
                self._findings.add('value', place, str(error))
        else:
            for name, values in (('observations', chunk.observations), ('actions', chunk.actions)):
                if not np.isfinite(values).all():
                    self._findings.add('value', place, f'{describe(chunk)}: {name} not finite')
        if chunk.terminated and chunk.truncated:
            self._findings.add('value', place, f'{describe(chunk)}: both terminated and truncated')

    def _follow(self, chunk: Transitions, place: Any) -> None:
        """Check that the steps go on where the last ones ended."""
        expected: tuple[int, int] = (0, 0) if self._last is None else self._last[:2]
        ended = chunk.terminated or chunk.truncated
        if (chunk.episode, chunk.first_step) == (expected[0] + 1, 0) and expected[1]:
            self._abandon(*expected)
            expected = chunk.episode, 0
        if (chunk.episode, chunk.first_step) != expected:
            self._findings.add(
                'gap',
                place,
                f'{describe(chunk)}: episode {chunk.episode} step {chunk.first_step} where '
                f'episode {expected[0]} step {expected[1]} is next',
            )
        elif chunk.first_step and self._last and chunk.observations[0].tobytes() != self._last[2]:
            self._findings.add(
                'value', place, f'{describe(chunk)}: begins with another observation than the one '
                'that the steps before ended with'
            )  # fmt: skip
        after = chunk.first_step + chunk.steps
        next_ = (chunk.episode + 1, 0) if ended else (chunk.episode, after)
        self._last = (*next_, chunk.observations[-1].tobytes())

    def _abandon(self, episode: int, after: int) -> None:
        """Note that an episode ends where it is: its source could not go on with it, and begins
        the next one. The segment that is cut short may have a score.
        """
        self.abandoned += 1
        if self.cuts is not None:
            for first, length in self.cuts.segments(self.name, episode, after, after, True):
                self._may_be_scored.add((episode, first, length))

    def _lengthen(self, chunk: Transitions, place: Any) -> None:
        """Note the segments that end with these steps."""
        episode, after = chunk.episode, chunk.first_step + chunk.steps
        if episode > len(self._lengths) + _MOST_SKIPPED:
            return  # already reported as a gap; a wild number must not take memory
        for known in (self._lengths, self._until, self._ended):
            known.extend([0] * (episode + 1 - len(known)))
        before = self._lengths[episode]
        self._lengths[episode] = max(before, min(after, _U32))
        ended = chunk.terminated or chunk.truncated
        self._ended[episode] |= ended
        if self.cuts is None:
            return
        before = max(before, chunk.first_step)  # not what is missing
        for first, length in self.cuts.segments(self.name, episode, before, after, ended):
            if self.elsewhere:
                break  # nobody owes a score
            self._due[episode, first, length] = chunk.sequence, place

    def score(self, reward: CompositeReward, place: Any) -> None:
        """Check that a score is that of a segment that has none yet."""
        episode, after = reward.episode, reward.first_step + reward.length
        if episode >= len(self._lengths) or self._lengths[episode] < after:
            if len(self._early) < _MOST_EARLY:  # its steps come on another topic
                self._early.append((reward, place))
            else:
                self._homeless(reward, place)
            return
        self.scored += reward.length
        if self.cuts is not None:
            span = episode, reward.first_step, reward.length
            if self.elsewhere:
                self._judged(span, reward, place)
            elif self._due.pop(span, None) is None and span not in self._may_be_scored:
                self._findings.add(
                    'segment',
                    place,
                    f'{describe(reward)} scores what is no segment of {self.cuts}, or has its '
                    'score already',
                )
            self._may_be_scored.discard(span)
        elif reward.first_step < self._until[episode]:
            self._findings.add(
                'segment', place, f'{describe(reward)} scores steps that have their score already'
            )
        self._until[episode] = max(self._until[episode], after)

    def _judged(self, span: Span, reward: CompositeReward, place: Any) -> None:
        """Check that what somebody judges is a segment."""
        assert self.cuts is not None
        episode, first, length = span
        after = self._lengths[episode]
        ended = bool(self._ended[episode])
        cut = self.cuts.segments(self.name, episode, first, after, ended)
        if next(cut, None) != (first, length):
            self._findings.add(
                'segment', place, f'{describe(reward)} scores what is no segment of {self.cuts}'
            )

    def _homeless(self, reward: CompositeReward, place: Any) -> None:
        self._findings.add(
            'segment', place, f'{describe(reward)} scores steps that the bag does not have'
        )

    def true_rewards(self, record: TrueRewards, place: Any) -> None:
        """Check that true rewards are those of a chunk of transitions."""
        self._has_true = True
        if not np.isfinite(record.rewards).all():
            self._findings.add('value', place, f'{describe(record)}: rewards not finite')
        span = record.episode, record.first_step, len(record.rewards)
        if record.sequence in self._chunks:
            self._compare(self._chunks.pop(record.sequence), span, place)
        elif record.sequence > self._passed:
            self._true[record.sequence] = span, place

    def _compare(self, chunk: Span, true: Span, place: Any) -> None:
        if chunk != true:
            self._findings.add(
                'record',
                place,
                f'true rewards of {self.name!r} for episode, step, steps {true}: the transitions '
                f'of that number have {chunk}',
            )

    @property
    def committed(self) -> int:
        """The last sequence number that a commit has named; -1 before."""
        return self.numbers.committed

    def commit(self, last: int) -> None:
        """Everything up to this sequence number belongs to the phases committed so far."""
        self.numbers.commit(last)
        if not self._has_true:
            for sequence in [n for n in self._chunks if n <= last]:
                del self._chunks[sequence]
            self._passed = max(self._passed, last)

    def labelled(self, span: Span) -> bool:
        """Whether the bag has these steps."""
        episode, first, length = span
        return episode < len(self._lengths) and first + length <= self._lengths[episode]

    def finish(self, scorers: Mapping[str, Numbers] | None, place: Any) -> None:
        """Report what never came. Where a recorder commits phases, only what commits name counts:
        a bag may end anywhere behind the last of them.

        Args:
            scorers: the numbers of each scorer, by its name; None: nothing is ever committed.
            place: of the bag.
        """
        commits = scorers is not None
        for (episode, first, length), (sequence, where) in self._due.items():
            if not commits or sequence <= self.committed:
                self._findings.add(
                    'segment',
                    where,
                    f'{self.name!r}: the segment of episode {episode}, steps {first} to '
                    f'{first + length - 1}, has no composite reward',
                )
        for reward, where in self._early:
            if scorers and reward.sequence > scorers[reward.scorer].committed:
                self.ahead += 1
            else:
                self._homeless(reward, where)
        for sequence in self._without_true(commits):
            self._findings.add(
                'record', place, f'transitions {sequence} of {self.name!r} have no true rewards'
            )
        for sequence, (_, where) in self._true.items():
            if commits and sequence > self.committed:
                self.ahead += 1
                continue
            self._findings.add(
                'record', where, f'true rewards {sequence} of {self.name!r} have no transitions'
            )

    def _without_true(self, commits: bool) -> Iterator[int]:
        if self._has_true:
            yield from (n for n in self._chunks if not commits or n <= self.committed)

    @property
    def tail(self) -> int:
        """Chunks that no commit has named."""
        return max(0, self.numbers.next - 1 - self.committed)
