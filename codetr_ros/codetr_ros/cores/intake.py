"""How both consumers treat records: they check each once, hold the early ones, and take in those
that a commit names, once they have the digests that it states.
"""

import logging
from collections import Counter
from collections.abc import Callable
from typing import Any

from codetr_ros.config import Settings
from codetr_ros.cores.announced import Tasks
from codetr_ros.cores.commits import Commits
from codetr_ros.cores.held import SHOWN, Held, Named, nbytes
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

    What it holds is compared with the digests of the commit first. Where they differ, the phase is
    `missing` and fetched again, and what has the commit's digest is taken. If nothing has it even
    then (`fetched`), the run cannot go on.

    Args:
        run: the run to which everything must belong.
        settings: its settings.
        scores: whether composite rewards are taken in too.
        true_rewards: whether the environment's own rewards are taken in: in-process oracle only.
        permitted: returns the newest phase that can have been permitted; None: any.

    Attributes:
        tasks: the sources.
        commits: the chain of commits.
        policies: digests of the policies with which this node has permitted phases, by phase.
        labels: digests of the labels that it has published or learnt from, by phase.
        doubt: what differs from a commit, in words; empty if nothing does.
    """

    def __init__(
        self,
        run: RunSpec,
        settings: Settings,
        scores: bool,
        true_rewards: bool = False,
        permitted: Callable[[], int] | None = None,
    ) -> None:
        self._run = run
        self._settings = settings
        self._scores = scores
        self._true_rewards = true_rewards
        self.tasks = Tasks(run, settings)
        # judgements committed before all of their steps are, with the phase of that commit
        self._early: list[tuple[int, Judgement]] = []
        self.duplicated: Counter[str] = Counter()
        self.refused = self.tasks.refused
        self.absent = Absent(settings)
        self.dropped: Counter[str] = Counter()  # of sources that were left out of a phase
        newest = permitted or (lambda: settings.phases - 1)
        self.commits = Commits(settings, self.tasks, self.absent, newest, self.refused)
        self._transitions = Held(Transitions)
        self._rewards = Held(CompositeReward)
        self._true: dict[tuple[str, int], TrueRewards] = {}
        self.policies: dict[int, str] = {}
        self.labels: dict[int, str] = {}
        self.doubt = ''
        self._incomplete: int | None = None
        self._fetched: int | None = None  # the phase that was sent again last

    @property
    def missing(self) -> int | None:
        """A committed phase that is incomplete or differs from its commit; None if none is."""
        return self.commits.lacking if self._incomplete is None else self._incomplete

    @property
    def due(self) -> int:
        """The next phase to be taken in."""
        return self.commits.next

    def waiting_for(self) -> str:
        """What the next phase still lacks, for people."""
        if not self.tasks.known:
            return 'the tasks of all sources'
        if self._incomplete is None:
            return f'the commit of phase {self.commits.next} from the recorder'
        differs = f', which differs from its commit: {self.doubt}' if self.doubt else ''
        return f'the rest of phase {self._incomplete}{differs}'

    def receive(self, record: Record) -> None:
        """Check a record and hold it.

        Raises:
            RecordError: it must be refused; nothing has changed then.
        """
        check_run(record, self._run)
        if isinstance(record, TaskSpec):
            self.tasks.announce(record, self.receive)
        elif isinstance(record, Transitions):
            if self.tasks.admit(record):
                self._hold_steps(record)
        elif isinstance(record, CompositeReward):
            check_score(record, self._settings.scored_at_most, self._settings.may_lack_scores)
            self._hold(record, self._rewards)
        elif isinstance(record, Preference):
            check_preference(record, self._settings.scored_at_most)
            self._hold(record, self._rewards)
        elif isinstance(record, TrueRewards):
            self._true[record.source, record.sequence] = record
        elif isinstance(record, Commit) and not self.commits.receive(record):
            self.duplicated[TOPICS[Commit]] += 1

    def _hold_steps(self, chunk: Transitions) -> None:
        size, held = nbytes(chunk), self._transitions.nbytes
        spec = self.tasks.specs[chunk.source]
        row = 4 * (2 * spec.observation_size + spec.action_size)  # of a chunk of one step
        most = max(HELD_BYTES, (self._settings.ahead + 1) * self._settings.phase_steps * row)
        if held + size > most:
            raise RecordError(
                f'{describe(chunk)}: {held} bytes wait for their commits already, of at most '
                f'{most}: restart the recorder, which commits'
            )
        self._hold(chunk, self._transitions)

    def _hold(self, record: Any, held: Held) -> None:
        ahead = self._settings.judgements_ahead
        name, due = held.due(record)
        if record.sequence >= due + ahead:
            raise RecordError(
                f'{describe(record)} is out of sequence: the permitted phases hold fewer than '
                f'{ahead} records, and {due} is the next of {name!r} to be taken in'
            )
        if not held.add(record, in_doubt=bool(self.doubt)):
            self.duplicated[TOPICS[type(record)]] += 1

    def fetched(self, phase: int) -> None:
        """Note that everything of a phase has been sent again by the recorder."""
        # of a phase that only lacked something, second records of a number were not looked at
        if self.doubt:
            self._fetched = phase

    def take(self, phase: int, memory: Trajectories) -> bool:
        """Add all records that the phase's commit names to the memory, ordered by source and
        number.

        Returns:
            Whether all of them were there, as the commit states. If not, nothing was added, and
            `missing` is the phase if its commit is known.

        Raises:
            RecordError: the records contradict each other or, fetched again, their commit: the run
                cannot go on.
        """
        self._incomplete, wrong = None, []
        for commit in self.commits.of(phase):
            if text := self.commits.contradiction(commit):
                self.commits.refuse(commit, text)
                continue
            steps = self._transitions.named(
                commit.sources, commit.transitions, commit.transition_digests, commit.dropped
            )
            scores = self._rewards.named(
                commit.scorers, commit.scores, commit.score_digests, commit.dropped
            )
            named = [*steps, *scores] if self._scores else steps
            differing = [*self._differing(commit), *(n.difference for n in named if n.difference)]
            lacks = any(one.lacks for one in named) or self._lacks_true(steps)
            if not lacks and not differing:
                if text := self._contradiction(commit, steps, scores):
                    self.commits.refuse(commit, text)
                    continue
                self._add(commit, steps, scores if self._scores else [], memory)
                return True
            self._incomplete = phase
            wrong += differing or [f'{describe(commit)} names records that did not come']
            self._doubt(phase, differing)
        if self._incomplete is not None and self._fetched == phase:
            raise RecordError(
                f'phase {phase} was sent again by the recorder, and its commit cannot be right: '
                f'{"; ".join(wrong)}. Nothing was learnt from it. Look for a second recorder, '
                'learner or reward node in the namespace of the run, then start the run again'
            )
        return False

    def _doubt(self, phase: int, differing: list[str]) -> None:
        text = '; '.join(differing)
        if text and not self.doubt:
            _log.error('phase %s differs from its commit, and is asked for again: %s', phase, text)
        self.doubt = text or self.doubt

    def _differing(self, commit: Commit) -> list[str]:
        """What a commit states of policy and labels that differs from this node's own."""
        before = self._settings.labels_named(commit.phase)
        own = '' if before is None else self.labels.get(before, commit.labels_digest)
        pairs = (
            (
                f'the policy that permitted phase {commit.phase}',
                self.policies.get(commit.phase, commit.policy_digest),
                commit.policy_digest,
            ),
            (
                f'the labels of phase {commit.phase - self._settings.lag}',
                own,
                commit.labels_digest,
            ),
        )
        return [
            f'{what} has the digest {ours[:SHOWN] or "none"} here; the commit states '
            f'{theirs[:SHOWN] or "none"}'
            for what, ours, theirs in pairs
            if ours != theirs
        ]

    def _lacks_true(self, steps: list[Named]) -> bool:
        return self._true_rewards and any(
            (chunk.source, chunk.sequence) not in self._true
            for one in steps
            for chunk in one.records
        )

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
        for names, last, held, what in (
            (commit.sources, commit.transitions, self._transitions, 'steps'),
            (commit.scorers, commit.scores, self._rewards, 'scores'),
        ):
            for name, number in zip(names, last.tolist(), strict=True):
                if name in commit.dropped and (count := held.void(name, number)):
                    self.dropped[f'{what} dropped'] += count

    def _contradiction(self, commit: Commit, steps: list[Named], scores: list[Named]) -> str:
        """Why a commit whose digests the records have cannot be right, in words: it ends elsewhere
        than the phase does. Empty if it can be.
        """
        shares = dict(zip(self.tasks.sources, self._settings.shares_of(commit.phase), strict=True))
        for one in steps:
            due, taken = shares[one.name], sum(chunk.steps for chunk in one.records)
            ends = [chunk.phase_end for chunk in one.records]
            other = [chunk.phase for chunk in one.records if chunk.phase != commit.phase]
            if taken != due or other:
                return (
                    f'names {taken} steps of {one.name!r}, of {due} that were permitted'
                    + (f', some of them of phase {other[0]}' if other else '')
                    + ': stop what publishes it'
                )
            if not ends[-1] or sum(ends) != 1:
                marked = [c.sequence for c in one.records if c.phase_end] or 'none'
                return (
                    f'names all {due} steps of {one.name!r}, of which the last must have '
                    f'phase_end and no other; these chunks have it: {marked}. Let the simulator '
                    'mark the end of each phase, or stop what publishes the commit'
                )
        if not self._scores or self._settings.scored_elsewhere:
            return ''
        scored = {one.name: len(one.records) for one in scores}
        for one in steps:
            due = one.records[-1].scores_due
            if scored.get(one.name, 0) != due:
                return (
                    f'names {scored.get(one.name, 0)} new scores of {one.name!r}, of {due} that '
                    'are due: stop what publishes it'
                )
        return ''

    def _add(
        self, commit: Commit, steps: list[Named], scores: list[Named], memory: Trajectories
    ) -> None:
        for one in steps:
            for chunk in one.records:
                memory.append(chunk)
        for one in steps if self._true_rewards else ():
            for chunk in one.records:
                memory.append_true_rewards(self._true.pop((chunk.source, chunk.sequence)))
        given = [(commit.phase, each) for one in scores for each in one.records]
        judgements, self._early = [*self._early, *given], []
        for since, judgement in judgements:
            self._judge(judgement, memory, since, commit.phase)
        for held, all_named in ((self._transitions, steps), (self._rewards, scores)):
            for one in all_named:
                held.take(one)
                if one.replaced:
                    _log.error(
                        'phase %s: %s records of %r were not those that the recorder has, and '
                        'are replaced by them', commit.phase, one.replaced, one.name,
                    )  # fmt: skip
        self._drop(commit)
        self.absent.follow(commit)
        self.commits.take(commit)
        for known in (self.policies, self.labels):
            for phase in [phase for phase in known if phase <= commit.phase - self._settings.lag]:
                del known[phase]
        self.doubt, self._fetched = '', None
        memory.evict()
