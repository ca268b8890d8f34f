"""The recorder decides when a phase is whole, and commits it.

Each commit has the digests of all that it names, of the policy that permitted the phase, of the
labels that this policy was learnt with, and of the commit before. Labels of phase k are published
before phase k + lag is permitted, so that to wait for them here keeps nobody waiting.

The core knows nothing of bags. Its wiring writes every received record to disk before it publishes
a `Commit`. So no record that a node learns from is ever lost.
"""

import time
from collections.abc import Collection, Iterator
from typing import Any

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.cores.announced import Tasks
from codetr_ros.cores.arrived import Arrived
from codetr_ros.cores.core import Part
from codetr_ros.cores.left_out import LeftOut
from codetr_ros.cores.recorded_labels import RecordedLabels
from codetr_ros.records import (
    TOPICS,
    Commit,
    CompositeReward,
    Policy,
    Preference,
    Record,
    RecordError,
    RunSpec,
    StepRewards,
    TaskSpec,
    Transitions,
    describe,
    metrics,
)
from codetr_ros.records.chain import Chain
from codetr_ros.records.checks import (
    check_labels,
    check_preference,
    check_run,
    check_score,
    check_scorer,
)
from codetr_ros.records.digests import digest
from codetr_ros.runs.reports import CoreReport

STATED = ('transition_digests', 'score_digests', 'policy_digest', 'previous')
"""Digests that a commit in a bag states, and that its records must have."""


class Recorder(Part):
    """Commits a phase once every permitted step, every due composite reward and the labels that
    its policy was learnt with have arrived.

    Only a simulator's scores are due. Where another scores (setting `scorer`), a commit names the
    judgements that are there, and late ones join a later commit.

    Args:
        run: the run.
        settings: its settings.
        name: node name.
    """

    subscribes: tuple[type, ...] = (
        *(TaskSpec, Policy, Transitions, CompositeReward, Preference, StepRewards),
    )

    def __init__(self, run: RunSpec, settings: Settings, name: str) -> None:
        super().__init__()
        self._run = run
        self._settings = settings
        self._name = name
        self._tasks = Tasks(run, settings)
        self._permitted: dict[int, dict[str, int]] = {}
        self._permission = 0  # the phase of the next policy
        self._chain = Chain(None if settings.free else settings.lag)
        self._labels = RecordedLabels(settings, self._chain)
        self._arrived = Arrived(settings, self._chain, self.duplicated)
        self._left_out = LeftOut(settings)
        self._absent = set(settings.joining_sources)  # not there yet, or left out
        self.refused = self._tasks.refused
        self.phase = 0  # the next to be committed

    def receive(self, record: Record) -> None:
        """Note a record that arrived.

        Raises:
            RecordError: it is no part of this run, impossible, or out of sequence; nothing has
                changed then.
        """
        check_run(record, self._run)
        if isinstance(record, TaskSpec):
            self._tasks.announce(record, self.receive)
            self._absent.discard(record.source)
        elif isinstance(record, Policy):
            if self._settings.free:
                return  # nothing waits for a permission
            self._check_permission(record)
            self._permit(record)
        elif isinstance(record, Transitions):
            if self._tasks.admit(record):
                self._arrived.transitions(record)
        elif isinstance(record, CompositeReward):
            check_score(record, self._settings.scored_at_most, self._settings.may_lack_scores)
            check_scorer(record, self._settings)
            if self._settings.scored_elsewhere:
                self._arrived.judgement(record)
            else:
                self._arrived.score(record)
        elif isinstance(record, Preference):
            check_preference(record, self._settings.scored_at_most)
            # no name in `scorers` would let anybody compare there
            if not self._settings.scored_elsewhere:
                raise RecordError(
                    f'{describe(record)} of {record.scorer!r}: the simulator scores in this run, '
                    'so nobody compares; start the run with scorer=topic'
                )
            check_scorer(record, self._settings)
            self._arrived.judgement(record)
        elif isinstance(record, StepRewards):
            check_labels(record, self._settings)
            if not self._labels.take(record, self.phase):
                self.duplicated[TOPICS[StepRewards]] += 1

    def _check_permission(self, policy: Policy) -> None:
        """Refuse a policy that permits a phase again, or other steps than each source's share.

        Raises:
            RecordError: says what it permits.
        """
        shares = dict.fromkeys(policy.sources, 0)
        names = self._tasks.sources if self._tasks.known else tuple(sorted(policy.sources))
        own = self._settings.shares_of(policy.phase)
        given = dict(zip(policy.sources, policy.steps.tolist(), strict=True))
        if len(names) == len(own) and any(given.values()):
            shares |= dict(zip(names, own, strict=True))
            due = sum(shares[source] for source, n in given.items() if n)
        else:
            due = self._settings.steps_of(policy.phase)
        if policy.phase < self.phase or sum(given.values()) != due:
            raise RecordError(
                f'{describe(policy)} permits {sum(given.values())} steps; phase {self.phase} is '
                f'the next to be committed, phase {policy.phase} has {due}: stop the second '
                'learner'
            )

    @property
    def left_out(self) -> frozenset[str]:
        """The sources that were left out or have not joined yet, and that have not announced
        themselves since.
        """
        return frozenset(self._absent)

    def leave_out(self, sources: Collection[str]) -> list[str]:
        """Leave sources out of the phase that is waited for: nothing comes from them. If nothing
        came from any source, nobody is left out, because a phase without steps teaches nothing.
        Neither is anybody before all have announced what they simulate, because nobody could learn
        from the bag.

        Args:
            sources: names of those that are silent.

        Returns:
            The names of those that are left out now and were not before.
        """
        there = self._there(self.phase)
        if not self._tasks.known or not any(there.values()):
            return []
        new = [
            source
            for source, whole in there.items()
            if source in sources and not whole and not self._left_out.is_out(source, self.phase)
        ]
        self._left_out.leave_out(new, self.phase)
        return new

    def _permit(self, policy: Policy) -> None:
        known = self._chain.policy(policy.phase)
        if known == digest(policy):
            self.duplicated[TOPICS[Policy]] += 1
            return
        if known:
            raise RecordError(
                f'{describe(policy)} is another policy than the one that has permitted phase '
                f'{policy.phase} already: stop the second learner'
            )
        self._chain.note(policy)
        self._permission = max(self._permission, policy.phase + 1)
        steps = dict(zip(policy.sources, policy.steps.tolist(), strict=True))
        self._permitted[policy.phase] = {source: n for source, n in steps.items() if n}

    def kept(self, part: StepRewards) -> StepRewards:
        """What the bag keeps of labels that `receive` has just taken: all, or the first of each
        segment only (`record_relabels`).
        """
        return self._labels.kept(part)

    def restore(self, record: Record) -> None:
        """Take one of the records that the bag holds already, in the bag's order, commits among
        them. Call it before `work`, which then goes on with the first phase that has no commit.

        Raises:
            RecordError: it was refused before too, or a commit names what the bag does not hold.
        """
        if isinstance(record, StepRewards) and self._labels.reduced:
            self._labels.restore(record)
            return
        if not isinstance(record, Commit):
            if isinstance(record, self.subscribes):
                self.receive(record)
            return
        self._left_out.leave_out(set(record.dropped) & set(record.sources), record.phase)
        self._absent = set(record.dropped) - set(record.sources)
        if record.phase != self.phase or not self._rolled_out(record.phase):
            raise RecordError(
                f'{describe(record)} is in the bag, where phase {self.phase} is the next to be '
                f'committed and {self.waiting_for()} is lacking: the bag is damaged. '
                '`codetr bag verify` lists what is missing'
            )
        made = self._commit(record.phase, record)
        for field in ('sources', 'dropped', 'transitions', 'scorers', 'scores', *STATED):
            is_, was = (np.array(getattr(one, field)).tolist() for one in (made, record))
            if is_ != was and (was or field not in STATED):
                raise RecordError(
                    f'{describe(record)} names {field} {was}, and the bag holds {is_} before it: '
                    'the bag is damaged. `codetr bag verify` lists what is wrong'
                )

    def comes_early(self, record: Record) -> bool:
        """Whether what must come before it has not come, though it is no further ahead than what
        is permitted: records of the same source or scorer, policies or labels of phases before.
        """
        place = self._place(record)
        return place is not None and place[0] < place[1] < place[2]

    def still_due(self, record: Record) -> bool:
        """Whether a record that came early has neither come again nor been passed over."""
        place = self._place(record)
        return place is not None and place[0] <= place[1]

    def _place(self, record: Record) -> tuple[Any, Any, Any] | None:
        """The number that must come next, that of the record, and the first that is too far ahead;
        None if they may come in any order.
        """
        settings = self._settings
        if isinstance(record, Policy) and not settings.free:
            return self._permission, record.phase, self._permission + settings.ahead + 1
        if isinstance(record, StepRewards):
            return self._labels.next, (record.phase, record.part), (self.phase, 0)
        numbers = self._arrived.due(record)
        if numbers is None:
            return None
        return *numbers, numbers[0] + (settings.ahead + 1) * settings.phase_steps

    def work(self) -> Iterator[list[Record] | None]:
        """Yield a commit for each phase, in order, as soon as it is whole."""
        for phase in range(self.phase, self._settings.phases):
            began = time.perf_counter()
            while not self._whole(phase):
                yield None
            seconds = time.perf_counter() - began
            step = self._settings.steps_after(phase)
            values = {'phase_seconds': seconds}
            commit = self._commit(phase)
            if not self._settings.alone:
                values['sources_left_out'] = len(commit.dropped)
            # the commit last: a bag that ends with it has all of the phase
            yield [
                metrics(self._run.run_id, 'record', self._name, phase, step, values),
                commit,
            ]
        self.finished = True
        while True:
            yield None

    def _members(self, phase: int) -> dict[str, int]:
        """Steps of a phase by source; none as long as they are not known."""
        if not self._settings.free:
            return self._permitted.get(phase, {})
        if not self._tasks.known:
            return {}
        return dict(zip(self._tasks.sources, self._settings.shares_of(phase), strict=True))

    def _whole(self, phase: int) -> bool:
        return self._rolled_out(phase) and not self._lacks_labels(phase)

    def _lacks_labels(self, phase: int) -> bool:
        """Whether labels are still to come that the policy of a phase was learnt with."""
        before = self._settings.labels_named(phase)
        return before is not None and not self._chain.labels(before)[0]

    def _rolled_out(self, phase: int) -> bool:
        """Whether all steps and scores of a phase are there."""
        there = self._there(phase)
        return any(there.values()) and all(
            whole or self._left_out.is_out(source, phase) for source, whole in there.items()
        )

    def _there(self, phase: int) -> dict[str, bool]:
        """Whether all of each source in a phase is there; none as long as they are not known."""
        members = self._members(phase)
        return {s: self._arrived.all_of(phase, s, steps) for s, steps in members.items()}

    def _commit(self, phase: int, recorded: Commit | None = None) -> Commit:
        """Commit a phase.

        Args:
            phase: the next one.
            recorded: its commit in a bag, which the next one then follows on.
        """
        steps = self._members(phase)
        members = sorted(steps)
        self._permitted.pop(phase, None)
        dropped = self._absent - set(members)
        last = []
        for source in members:
            if self._arrived.all_of(phase, source, steps[source]):
                last.append(self._arrived.commit(phase, source))
            else:
                dropped.add(source)
                last.append(self._arrived.drop(phase, source))
        scores = self._arrived.committed_scores(members)
        self.phase = phase + 1  # at once: labels of the phase may be here before the next slice
        commit = self._chain.completed(
            Commit(
                run_id=self._run.run_id,
                phase=phase,
                sources=tuple(members),
                transitions=np.array(last, np.int64),
                scorers=tuple(scores),
                scores=np.array(list(scores.values()), np.int64),
                dropped=tuple(sorted(dropped)),
            )
        )
        self._absent = dropped
        self._chain.follow(recorded or commit)
        self._labels.follow(phase)
        return commit

    @property
    def due(self) -> int | None:
        """The next phase to be committed."""
        return self.phase

    def waiting_for(self) -> str:
        """What the recorder waits for, for people: what the next phase still lacks."""
        members = self._members(self.phase)
        if not members:
            return f'permission for phase {self.phase} from the learner'
        parts = (self._arrived.lacks(self.phase, s, steps) for s, steps in members.items())
        lacks = [part for part in parts if part]
        if self._lacks_labels(self.phase):
            lacks.append(f'labels of phase {self.phase - self._settings.lag} from the reward node')
        return f'the rest of phase {self.phase}' + (f': {", ".join(lacks)}' if lacks else '')

    def close(self) -> None:
        """Nothing to save: the bag belongs to the wiring of this core."""

    def report(self) -> CoreReport:
        """Counts for the run's summary."""
        return CoreReport(
            duplicated=dict(self.duplicated),
            refused=dict(self.refused),
            counters={
                'phases_committed': self.phase,
                **self._arrived.left_over(),
                **self._arrived.counters,
            },
        )
