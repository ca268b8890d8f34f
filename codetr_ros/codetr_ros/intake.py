"""What both consumers do with arriving records: check them once, hold what came early, give out
what a commit names.
"""

import logging
from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.records import (
    PROTOCOL_VERSION,
    TOPICS,
    Commit,
    CompositeReward,
    Record,
    RecordError,
    RunSpec,
    TaskSpec,
    Transitions,
    TrueRewards,
    describe,
)
from codetr_ros.trajectories import Trajectories

_log = logging.getLogger(__name__)


def check_run(record: Record, run: RunSpec) -> None:
    """Refuse a record of another run.

    Raises:
        RecordError: names both runs.
    """
    if record.run_id != run.run_id:
        raise RecordError(
            f'{describe(record)} is of run {record.run_id!r}, this is run {run.run_id!r}: stop '
            'the other run, or give '
            f'each run a namespace of its own'
        )


class Tasks:
    """The sources of a run and what they simulate."""

    def __init__(self, run: RunSpec, settings: Settings) -> None:
        self._run = run
        self._settings = settings
        self.specs: dict[str, TaskSpec] = {}
        self._unannounced: list[Transitions] = []
        self.refused: Counter[str] = Counter()  # of what waited for its announcement

    @property
    def known(self) -> bool:
        """Whether all sources of the run have said what they simulate."""
        return len(self.specs) == self._settings.source_count

    @property
    def first(self) -> TaskSpec:
        """The task, which all sources share."""
        return self.specs[min(self.specs)]

    @property
    def sources(self) -> tuple[str, ...]:
        """Names of the sources, sorted."""
        return tuple(sorted(self.specs))

    def receive(self, spec: TaskSpec) -> None:
        """Take what a simulator says it simulates.

        Raises:
            RecordError: another run, protocol, task, size, or a simulator too many.
        """
        check_run(spec, self._run)
        if spec.protocol_version != PROTOCOL_VERSION:
            raise RecordError(
                f'{spec.source!r} speaks protocol {spec.protocol_version}, this node '
                f'{PROTOCOL_VERSION}: install the same '
                f'version of codetr_ros on both'
            )
        for known in self.specs.values():
            for name in ('task', 'observation_size', 'action_size', 'horizon', 'r_max'):
                if getattr(known, name) != getattr(spec, name):
                    raise RecordError(
                        f'{spec.source!r} has {name}={getattr(spec, name)!r}, {known.source!r} '
                        'has '
                        f'{getattr(known, name)!r}: all simulators of a run must simulate the '
                        'same task'
                    )
        if spec.source not in self.specs and self.known:
            raise RecordError(
                f'{spec.source!r} is one simulator too many: the run has '
                f'simulators={self._settings.simulators} with envs={self._settings.envs} each '
                f'({", ".join(self.sources)}). Start the run with more, or stop this one'
            )
        self.specs[spec.source] = spec

    def announce(self, spec: TaskSpec, receive: Callable[[Transitions], None]) -> None:
        """Take an announcement, then hand what waited for it to `receive`.

        Raises:
            RecordError: as `receive` of this class; what waited is then still waiting.
        """
        self.receive(spec)
        waiting, self._unannounced = self._unannounced, []
        for chunk in waiting:
            try:
                receive(chunk)
            except RecordError as error:  # its fault, not that of the announcement
                self.refused[TOPICS[Transitions]] += 1
                _log.error('%s', error)

    def admit(self, chunk: Transitions) -> bool:
        """Whether steps may be taken in now; those that came before their announcement wait.

        Raises:
            RecordError: they are of no simulator of this run, or the task cannot have them.
        """
        spec = self.specs.get(chunk.source)
        if spec is not None:
            check_transitions(chunk, spec)
            return True
        if self.known:
            raise RecordError(
                f'{describe(chunk)}: {chunk.source!r} is no simulator of this run; these are: '
                f'{", ".join(self.sources)}'
            )
        self._unannounced.append(chunk)  # announcements travel on another topic
        return False


def check_transitions(chunk: Transitions, spec: TaskSpec) -> None:
    """Refuse steps that the task cannot have.

    Raises:
        RecordError: names the field, its value and what the task has.
    """
    shapes = (
        ('observations', chunk.observations, (chunk.steps + 1, spec.observation_size)),
        ('actions', chunk.actions, (chunk.steps, spec.action_size)),
    )
    for name, array, expected in shapes:
        if chunk.steps < 1 or array.shape != expected:
            raise RecordError(
                f'{describe(chunk)}: {name} have shape {array.shape}, {expected} expected of task '
                f'{spec.task} as '
                f'{spec.source!r} announced it'
            )
        bad = np.argwhere(~np.isfinite(array))
        if len(bad):
            step, component = bad[0].tolist()
            raise RecordError(
                f'{describe(chunk)}: {name}[{step}, {component}] is {array[step, component]}: all '
                'values must be finite; '
                f'mend what {spec.source!r} publishes'
            )
    if chunk.first_step + chunk.steps > spec.horizon:
        raise RecordError(
            f'{describe(chunk)}: step {chunk.first_step + chunk.steps} lies beyond the horizon '
            f'{spec.horizon} of {spec.task}'
        )


def check_score(reward: CompositeReward, delay: int) -> None:
    """Refuse a composite reward that no segment can have.

    Raises:
        RecordError: names the field and its value.
    """
    if not np.isfinite(reward.value):
        raise RecordError(
            f'{describe(reward)}: value is {reward.value}: a composite reward must be finite'
        )
    if not 1 <= reward.length <= delay:
        raise RecordError(
            f'{describe(reward)}: length is {reward.length}: a segment has 1 to {delay} steps'
        )


class Intake:
    """Holds what arrived until a commit says to which phase it belongs, then adds it to the memory
    in order.

    Args:
        run: the run to which everything must belong.
        settings: its settings.
        scores: whether composite rewards are taken in too.
        true_rewards: whether the environment's own rewards are: the in-process oracle only.
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
        self._rewards: dict[tuple[str, int], CompositeReward] = {}
        self._true: dict[tuple[str, int], TrueRewards] = {}
        self._commits: dict[int, Commit] = {}
        self._taken = {
            'transitions': Counter[str](),
            'scores': Counter[str](),
        }  # next sequence number due
        self.duplicated: Counter[str] = Counter()
        self.refused = self.tasks.refused
        self.missing: int | None = None  # a committed phase of which something has not arrived

    def receive(self, record: Record) -> None:
        """Check a record and hold it.

        Raises:
            RecordError: it must not be taken in; nothing has changed.
        """
        check_run(record, self._run)
        if isinstance(record, TaskSpec):
            self.tasks.announce(record, self.receive)
        elif isinstance(record, Transitions):
            if self.tasks.admit(record):
                key = (record.source, record.sequence)
                self._hold(record, self._transitions, key, self._taken['transitions'])
        elif isinstance(record, CompositeReward):
            check_score(record, self._settings.delay)
            self._hold(
                record, self._rewards, (record.scorer, record.sequence), self._taken['scores']
            )
        elif isinstance(record, TrueRewards):
            self._true[record.source, record.sequence] = record
        elif isinstance(record, Commit):
            self._commits.setdefault(record.phase, record)

    def _hold(
        self,
        record: Any,
        held: dict[tuple[str, int], Any],
        key: tuple[str, int],
        taken: 'Counter[str]',
    ) -> None:
        ahead = (self._settings.lag + 1) * self._settings.phase_steps
        if key[1] >= taken[key[0]] + ahead:
            raise RecordError(
                f'{describe(record)} is out of sequence: the permitted phases hold fewer than '
                f'{ahead} records, and {taken[key[0]]} is the next of {key[0]!r} to be taken in'
            )
        if key in held or key[1] < taken[key[0]]:
            self.duplicated[TOPICS[type(record)]] += 1
        else:
            held[key] = record

    def take(self, phase: int, memory: Trajectories) -> bool:
        """Add everything that the phase's commit names to the memory, ordered by source and
        number.

        Returns:
            Whether it was all there. If not, nothing was added, and `missing` is the phase where
            its commit is known.

        Raises:
            RecordError: what is committed contradicts itself: the run cannot go on.
        """
        commit = self._commits.get(phase)
        if commit is None:
            return False
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
            memory.append(self._transitions.pop((chunk.source, chunk.sequence)))
        for key in true:
            memory.append_true_rewards(self._true.pop(key))
        for reward in scores:
            del self._rewards[reward.scorer, reward.sequence]
            try:
                memory.score(reward)
            except (
                RecordError
            ) as error:  # a wrong score spoils no run: it is said, counted, and left out
                self.refused[TOPICS[CompositeReward]] += 1
                _log.error('%s', error)
        for names, last, kind in (
            (commit.sources, commit.transitions, 'transitions'),
            (commit.scorers, commit.scores, 'scores'),
        ):
            for name, number in zip(names, last.tolist(), strict=True):
                self._taken[kind][name] = number + 1
        memory.evict()
        return True

    def _named(
        self, names: tuple[str, ...], last: Any, held: dict[tuple[str, int], Any], kind: str
    ) -> list[Any] | None:
        found = []
        for name, number in sorted(zip(names, last.tolist(), strict=True)):
            for sequence in range(self._taken[kind][name], number + 1):
                if (name, sequence) not in held:
                    return None
                found.append(held[name, sequence])
        return found
