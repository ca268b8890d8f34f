"""How both consumers treat records: they check each once, hold the early ones, and take in those
that a commit names.
"""

import logging
from collections import Counter
from typing import Any

from codetr_ros.config import Settings
from codetr_ros.cores.announced import Tasks
from codetr_ros.cores.left_out import Absent
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import (
    TOPICS,
    Commit,
    CompositeReward,
    Preference,
    Record,
    RecordError,
    RunSpec,
    TaskSpec,
    Transitions,
    TrueRewards,
    describe,
)
from codetr_ros.records.checks import check_preference, check_run, check_score
from codetr_ros.records.numbering import Judgement

HELD_BYTES = 64 << 20
"""The least bytes of steps that may wait for their commits; more where the permitted phases have
more."""

_log = logging.getLogger(__name__)


class Intake:
    """Holds records until a commit names their phase, then adds them to the memory in order.

    Args:
        run: the run to which everything must belong.
        settings: its settings.
        scores: whether composite rewards are taken in too.
        true_rewards: whether the environment's own rewards are taken in: in-process oracle only.
    """

    def __init__(
        self, run: RunSpec, settings: Settings, scores: bool, true_rewards: bool = False
    ) -> None:
        self._run = run
        self._settings = settings
        self._scores = scores
        self._true_rewards = true_rewards
        self.tasks = Tasks(run, settings)
        self._transitions: dict[tuple[str, int], Transitions] = {}
        self._rewards: dict[tuple[str, int], Judgement] = {}
        # judgements committed before all of their steps are, with the phase of that commit
        self._early: list[tuple[int, Judgement]] = []
        self._true: dict[tuple[str, int], TrueRewards] = {}
        self._commits: dict[int, Commit] = {}
        self._taken = {
            'transitions': Counter[str](),
            'scores': Counter[str](),
        }  # next sequence number due
        self.duplicated: Counter[str] = Counter()
        self.refused = self.tasks.refused
        self.absent = Absent()
        self.dropped: Counter[str] = Counter()  # of sources that were left out of a phase
        self.missing: int | None = None  # a committed phase that is incomplete
        self._due = 0  # the next phase to be taken in
        self._bytes = 0  # of the steps that are held

    def receive(self, record: Record) -> None:
        """Check a record and hold it.

        Raises:
            RecordError: it must be refused; nothing has changed then.
        """
        check_run(record, self._run)
        if isinstance(record, TaskSpec):
            self.tasks.announce(record, self.receive)
            self.absent.announced(record.source)
        elif isinstance(record, Transitions):
            if self.tasks.admit(record):
                self._hold_steps(record)
        elif isinstance(record, CompositeReward):
            check_score(record, self._settings.scored_at_most, self._settings.may_lack_scores)
            self._hold_judgement(record)
        elif isinstance(record, Preference):
            check_preference(record, self._settings.scored_at_most)
            self._hold_judgement(record)
        elif isinstance(record, TrueRewards):
            self._true[record.source, record.sequence] = record
        elif isinstance(record, Commit) and self._due <= record.phase < self._settings.phases:
            self._commits.setdefault(record.phase, record)

    def _hold_judgement(self, record: Judgement) -> None:
        key = (record.scorer, record.sequence)
        self._hold(record, self._rewards, key, self._taken['scores'])

    def _hold_steps(self, chunk: Transitions) -> None:
        size = _bytes(chunk)
        spec = self.tasks.specs[chunk.source]
        row = 4 * (2 * spec.observation_size + spec.action_size)  # of a chunk of one step
        most = max(HELD_BYTES, (self._settings.ahead + 1) * self._settings.phase_steps * row)
        if self._bytes + size > most:
            raise RecordError(
                f'{describe(chunk)}: {self._bytes} bytes wait for their commits already, of at '
                f'most {most}: restart the recorder, which commits'
            )
        key = (chunk.source, chunk.sequence)
        if self._hold(chunk, self._transitions, key, self._taken['transitions']):
            self._bytes += size

    def _hold(
        self,
        record: Any,
        held: dict[tuple[str, int], Any],
        key: tuple[str, int],
        taken: 'Counter[str]',
    ) -> bool:
        """Hold a record until its commit; returns whether it is new."""
        ahead = self._settings.judgements_ahead
        if key[1] >= taken[key[0]] + ahead:
            raise RecordError(
                f'{describe(record)} is out of sequence: the permitted phases hold fewer than '
                f'{ahead} records, and {taken[key[0]]} is the next of {key[0]!r} to be taken in'
            )
        if key in held or key[1] < taken[key[0]]:
            self.duplicated[TOPICS[type(record)]] += 1
            return False
        held[key] = record
        return True

    def take(self, phase: int, memory: Trajectories) -> bool:
        """Add all records that the phase's commit names to the memory, ordered by source and
        number.

        Returns:
            Whether all of them were there. If not, nothing was added; `missing` is the phase if
            its commit is known.

        Raises:
            RecordError: the committed records contradict each other: the run cannot go on.
        """
        commit = self._commits.get(phase)
        if commit is None:
            return False
        self._drop(commit)
        chunks = self._named(commit.sources, commit.transitions, self._transitions, 'transitions')
        scores = (
            self._named(commit.scorers, commit.scores, self._rewards, 'scores')
            if self._scores
            else []
        )
        true = [(c.source, c.sequence) for c in chunks or () if self._true_rewards]
        if chunks is None or scores is None or any(key not in self._true for key in true):
            self.missing = phase
            return False
        self.missing = None
        del self._commits[phase]
        for chunk in chunks:
            self._bytes -= _bytes(chunk)
            memory.append(self._transitions.pop((chunk.source, chunk.sequence)))
        for key in true:
            memory.append_true_rewards(self._true.pop(key))
        for reward in scores:
            del self._rewards[reward.scorer, reward.sequence]
        judgements, self._early = [*self._early, *((phase, each) for each in scores)], []
        for since, judgement in judgements:
            self._judge(judgement, memory, since, phase)
        for names, last, kind in (
            (commit.sources, commit.transitions, 'transitions'),
            (commit.scorers, commit.scores, 'scores'),
        ):
            for name, number in zip(names, last.tolist(), strict=True):
                self._taken[kind][name] = number + 1
        self.absent.follow(commit)
        memory.evict()
        self._due = phase + 1
        return True

    def _judge(self, judgement: Judgement, memory: Trajectories, since: int, phase: int) -> None:
        """Add a judgement to the memory, or keep it until its steps are there.

        They are of a phase that is permitted, and so are there with a commit soon.
        """
        if memory.awaited(judgement) and phase < since + self._settings.ahead + 1:
            self._early.append((since, judgement))
            return
        try:
            memory.judge(judgement)
        except RecordError as error:  # a wrong score is logged, counted and left out
            self.refused[TOPICS[type(judgement)]] += 1
            _log.error('%s', error)

    def _drop(self, commit: Commit) -> None:
        """Drop what has come of the sources that are left out of a phase, and void the numbers of
        what may still come.
        """
        for names, last, held, kind, counter in (
            (commit.sources, commit.transitions, self._transitions, 'transitions', 'steps'),
            (commit.scorers, commit.scores, self._rewards, 'scores', 'scores'),
        ):
            for name, number in zip(names, last.tolist(), strict=True):
                if name not in commit.dropped:
                    continue
                for key in [key for key in held if key[0] == name and key[1] <= number]:
                    record: Any = held.pop(key)
                    self.dropped[f'{counter} dropped'] += getattr(record, 'steps', 1)
                self._taken[kind][name] = max(self._taken[kind][name], number + 1)

    def _named(
        self, names: tuple[str, ...], last: Any, held: dict[tuple[str, int], Any], kind: str
    ) -> list[Any] | None:
        named = []
        for name, number in sorted(zip(names, last.tolist(), strict=True)):
            for sequence in range(self._taken[kind][name], number + 1):
                if (name, sequence) not in held:
                    return None
                named.append(held[name, sequence])
        return named


def _bytes(chunk: Transitions) -> int:
    return chunk.observations.nbytes + chunk.actions.nbytes
