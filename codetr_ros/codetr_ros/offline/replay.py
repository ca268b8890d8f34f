"""`codetr replay`: derive the weights of a recorded run again from its bag, phase by phase.

The cores of the reward node and of the learner take the bag's records as they did in the run. What
they make is compared with what the run left of it: the labels and the policies in its bag, its
checkpoints, and the digests in its summary.
"""

import hashlib
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import torch

from codetr_ros.bags.causal import causal
from codetr_ros.bags.playback import RecordedRun, recorded_run
from codetr_ros.bags.reader import Bag
from codetr_ros.cores.consumer import Consumer
from codetr_ros.cores.labeller import Labeller
from codetr_ros.cores.learner import Learner
from codetr_ros.offline.errors import FitError
from codetr_ros.offline.phases import segments_of
from codetr_ros.records import Commit, Policy, Record, RecordError, StepRewards, TrueRewards
from codetr_ros.runs import checkpoints
from codetr_ros.runs.reports import CoreReport, StartedFrom


class _DiffersError(Exception):
    """A phase that differs from what its commit states of it."""


@dataclass(frozen=True)
class Difference:
    """Something that is not as the run had it."""

    phase: int
    what: str
    made: str
    was: str

    def __str__(self) -> str:
        return f'phase {self.phase}: {self.what} made here: {self.made}, in the run: {self.was}'


@dataclass
class Replayed:
    """What was derived again, and how it compares.

    Attributes:
        recorded: the run.
        phases: learnt from again.
        same: what was compared and equal, by kind.
        differences: the first of each kind, in the order in which they were found.
        reports: of both sides at the end.
    """

    recorded: RecordedRun
    phases: int = 0
    same: Counter[str] = field(default_factory=Counter)
    differences: dict[str, Difference] = field(default_factory=dict)
    reports: dict[str, CoreReport] = field(default_factory=dict)

    @property
    def first(self) -> Difference | None:
        """That of the first phase that differs; None if nothing does."""
        return min(self.differences.values(), key=lambda one: one.phase, default=None)

    def compare(self, phase: int, kind: str, made: str, was: str) -> None:
        """Compare one thing of a phase."""
        if made == was:
            self.same[kind] += 1
        elif kind not in self.differences or phase < self.differences[kind].phase:
            self.differences[kind] = Difference(phase, kind, made, was)


def replay(
    bag: Bag,
    folder: Path | None = None,
    run_id: str | None = None,
    start: StartedFrom | None = None,
    progress: Callable[[int, int], None] = lambda phase, phases: None,
) -> Replayed:
    """Derive a run's weights again.

    Args:
        bag: of the run.
        folder: with its checkpoints; None: none are compared.
        run_id: which run, where the bag holds several.
        start: the reward model that the run started from, if it did.
        progress: called with the number of phases done and that of the run.

    Raises:
        BagError: the bag is damaged.
        CheckpointError: the model that the run started from is not there any more.
        FitError: the bag lacks records that a commit names.
        PlayError: the bag holds no such run, or several.
    """
    recorded = recorded_run(bag, run_id)
    settings = recorded.settings
    torch.set_num_threads(settings.thread_count)
    replayed = Replayed(recorded)
    sides: dict[str, Consumer] = {}
    if settings.labels_steps:
        model, frozen = (start.checkpoint, start.frozen) if start is not None else ('', False)
        sides['reward'] = Labeller(recorded.run, settings, 'reward', None, model, frozen)
    sides['learner'] = Learner(recorded.run, settings, 'learner', None)
    steps = _Steps(sides, replayed, folder)
    kinds = {TrueRewards, Commit, StepRewards, Policy}
    kinds.update(kind for side in sides.values() for kind in side.subscribes)
    ours = (e for e in bag.entries(kinds) if e.record.run_id == recorded.run.run_id)
    try:
        for entry in causal(ours, settings.lag):
            steps.take(entry.record)
            if isinstance(entry.record, Commit):
                steps.learn(entry.record.phase, bag.path)
                progress(replayed.phases, recorded.phases)
    except _DiffersError:
        pass  # it is among the differences, and nothing can be learnt behind it
    replayed.reports = {name: side.report() for name, side in sides.items()}
    return replayed


class _Steps:
    """Feeds both sides, and compares what they make with what was recorded."""

    def __init__(
        self, sides: dict[str, Consumer], replayed: Replayed, folder: Path | None
    ) -> None:
        self._sides = sides
        self._replayed = replayed
        self._folder = folder
        self._works: dict[str, Iterator[list[Record] | None]] = {
            name: side.work() for name, side in sides.items()
        }
        self._labels: dict[tuple[int, str, int, int], bytes] = {}
        self._policies: dict[int, str] = {}  # digests, by phase

    def take(self, record: Record) -> None:
        """Hand a record to those that had it, or compare it."""
        if isinstance(record, StepRewards):
            for key, labels in segments_of(record):
                made = self._labels.pop(key, None)
                was = hashlib.sha256(labels).hexdigest()
                shown = 'none' if made is None else hashlib.sha256(made).hexdigest()
                self._replayed.compare(record.phase, 'labels', shown, was)
        elif isinstance(record, Policy) and record.phase in self._policies:
            was = hashlib.sha256(record.weights).hexdigest()
            learnt = self._policies.pop(record.phase)
            self._replayed.compare(record.version, 'policy', learnt, was)
        for side in self._sides.values():
            if type(record) in side.subscribes and not isinstance(record, StepRewards):
                try:
                    side.receive(record)
                except RecordError:  # as in the run, whose summary counts it
                    self._replayed.same['records refused'] += 1

    def learn(self, phase: int, path: Path) -> None:
        """Learn from a phase that is committed, on both sides."""
        busy = True
        while busy:
            busy = False
            for name, work in self._works.items():
                while (records := next(work)) is not None:
                    busy = True
                    for record in records:
                        self._note(record)
                if self._sides[name].missing is not None:
                    self._stop(phase, self._sides[name].doubt, path)
        self._replayed.phases = phase + 1
        # a robot that goes on may be so many phases ahead of the labels that its bag has
        ahead = self._replayed.recorded.settings.ahead
        self._labels = {key: one for key, one in self._labels.items() if key[0] >= phase - ahead}
        self._check(phase)

    def _stop(self, phase: int, doubt: str, path: Path) -> None:
        """End where a phase cannot be taken in.

        Raises:
            FitError: the bag lacks some of it.
            _DiffersError: something differs from what its commit states.
        """
        if not doubt:
            raise FitError(
                f'{path}: phase {phase} is committed, but not all that belongs to it is in the '
                'bag: `codetr bag verify` names what is missing'
            )
        self._replayed.compare(phase, f'commit, {doubt}', 'another', 'as stated')
        raise _DiffersError

    def _note(self, record: Record) -> None:
        if isinstance(record, StepRewards):
            self._labels.update(segments_of(record))
            self._sides['learner'].receive(record)
        elif isinstance(record, Policy) and not record.random:
            self._policies[record.phase] = hashlib.sha256(record.weights).hexdigest()

    def _check(self, phase: int) -> None:
        """Compare with the checkpoints of this phase, if there are any that can be read."""
        if self._folder is None:
            return
        for name, side in self._sides.items():
            path = self._folder / f'{name}-{phase:06d}'
            if not path.is_dir():
                continue
            try:
                tensors, _ = checkpoints.load(path)
            except checkpoints.CheckpointError as error:
                was = str(error)
            else:
                was = checkpoints.digest(checkpoints.of_model(tensors))
            made = checkpoints.digest(checkpoints.of_model(side.trained()))
            self._replayed.compare(phase, f'checkpoint of the {name}', made, was)
