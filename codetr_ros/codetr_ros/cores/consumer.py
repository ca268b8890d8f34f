"""The common part of learner and reward side: a memory fed by commits, checkpoints, a report.

One that was ended goes on from its newest sound checkpoint (`resume`) and the records of the run,
from its first phase on. It is fed them as in the run: tasks, steps, scores and commits, in order,
no faster than it takes phases in. So whoever feeds it needs no other call than `receive`.
"""

import logging
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import torch

from codetr_ros import records
from codetr_ros.config import Settings
from codetr_ros.cores import going_on
from codetr_ros.cores.core import Part
from codetr_ros.cores.intake import Intake
from codetr_ros.memory.judgements import Predict
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import Metrics, Record, RunSpec
from codetr_ros.runs import checkpoints
from codetr_ros.runs.checkpoints import Checkpoint
from codetr_ros.runs.reports import CoreReport, MemoryFacts
from codetr_ros.system.disk import Disk

_log = logging.getLogger(__name__)


class Consumer(Part, ABC):
    """A core that takes phases into its memory D, in order, and learns from each.

    Args:
        run: the run.
        settings: its settings.
        name: node name.
        folder: where checkpoints go; None: no checkpoints.
        scores: whether composite rewards are taken in.
        true_rewards: whether the environment's own rewards are taken in: in-process oracle only.

    Attributes:
        disk: where checkpoints lie.
    """

    role: ClassVar[str]
    subscribes: tuple[type, ...]

    def __init__(
        self,
        run: RunSpec,
        settings: Settings,
        name: str,
        folder: Path | None,
        scores: bool,
        true_rewards: bool = False,
    ) -> None:
        super().__init__()
        self._run = run
        self._settings = settings
        self._name = name
        self._folder = folder
        self.disk = Disk()
        self._scores = scores
        self._true_rewards = true_rewards
        self._intake = Intake(run, settings, scores, true_rewards, lambda: self.permitted)
        self._memory: Trajectories | None = None
        self._phase = 0  # the next to be learnt from
        self._saved = -1
        self._committed = -1  # phases up to this one are known to be committed
        self._from: Checkpoint | None = None  # where to go on
        self._last_metrics: dict[str, float] = {}  # as published after the last phase
        self._counters: Counter[str] = Counter()
        self.gone_by = self._intake.commits.missed
        self.duplicated = self._intake.duplicated
        self.refused = self._intake.refused

    @property
    def missing(self) -> int | None:
        """A committed phase that is incomplete; None if there is none."""
        due = self._intake.due
        # one that this node has still to permit is committed, but cannot be taken in yet
        if due <= min(self._committed, self.permitted):
            return due
        return self._intake.missing

    @property
    def uncommitted(self) -> int | None:
        """The phase whose commit comes next; None if it has come, or there is none."""
        commits = self._intake.commits
        newest = min(self.permitted, self._settings.phases - 1)
        more = commits.next <= newest and not commits.of(commits.next)
        return commits.next if more and self.missing is None else None

    @property
    def unannounced(self) -> bool:
        """Whether what one of the sources simulates is not known yet."""
        return not self._intake.tasks.known

    @property
    def left_out(self) -> frozenset[str]:
        """The sources that the newest commit that was taken in names as left out."""
        return self._intake.absent.now

    def catch_up(self, newest: int) -> None:
        """Note that phases up to `newest` are committed, whether their commits have come or not:
        those that have not been taken in are then missing.
        """
        self._committed = newest

    @property
    def doubt(self) -> str:
        """What of the missing phase differs from its commit, in words; empty if nothing does."""
        return self._intake.doubt

    def fetched(self, phase: int) -> None:
        """Note that everything of a phase has been sent again by the recorder."""
        self._intake.fetched(phase)

    def waiting_for(self) -> str:
        """What the next slice waits for, for people."""
        return self._intake.waiting_for()

    @property
    def permitted(self) -> int:
        """The newest phase that can have been permitted: the learner has learnt from one, and
        permits those that it is then ahead of.
        """
        learnt = self._phase - 1 if self._from is None else self._from.phase
        return learnt + self._settings.ahead

    @property
    def phase(self) -> int:
        """The next phase to be learnt from."""
        return self._phase

    @property
    def due(self) -> int | None:
        """The next phase to be taken in."""
        return self._intake.due

    def resume(self, newest: int | None = None) -> int:
        """Go on from the newest sound checkpoint of this run. Call it before `work`, if at all.

        `work` then takes the phases up to the checkpoint's into the memory without learning from
        them, yields once more what was published after that phase (receivers drop what they have),
        and goes on with the next phase, to the bit as if it had never ended. Both sides must go on
        from the same phase, unless somebody still has all labels of the phases between.

        Damaged checkpoints are logged and passed over. Those of later phases are removed: they are
        made again.

        Args:
            newest: the highest phase to go on from; None: any.

        Returns:
            The checkpoint's phase; -1 if there is none: everything is then learnt again.

        Raises:
            CheckpointError: it is of another run or of other settings, or of an older version.
        """
        if self._folder is None:
            return -1
        for checkpoint in checkpoints.sound(self._folder, self.role, newest):
            going_on.check(checkpoint, self._run, self._settings)
            self._from = checkpoint
            break
        phase = -1 if self._from is None else self._from.phase
        for path in checkpoints.remove_after(self._folder, self.role, phase):
            _log.warning('removed %s: the run goes on from phase %s', path, phase)
        return phase

    def receive(self, record: Record) -> None:
        """Hold a record until its phase's turn.

        Raises:
            RecordError: it must be refused; nothing has changed then.
        """
        self._intake.receive(record)

    def work(self) -> Iterator[list[Record] | None]:
        """This side of Algorithm 1; one slice per `next()`."""
        while not self._intake.tasks.known:
            yield None
        spec = self._intake.tasks.first
        self._settings = settings = self._settings.within(spec.horizon)
        self._memory = Trajectories(
            spec.observation_size,
            spec.action_size,
            settings.longest,
            settings.memory_steps,
            settings.phase_steps + spec.horizon,
            self._true_rewards,
            regular=not settings.lengths.drawn,
            progress=settings.progress,
            cuts=settings.cuts if settings.scored_elsewhere and self._scores else None,
        )
        yield from self._begin()
        if self._from is not None:
            yield from self._go_on(self._from, self._memory)
        for phase in range(self._phase, settings.phases):
            while not self._intake.take(phase, self._memory):
                yield None
            self._memory.settle(self._predict)
            # the phases of the warm-up are stored, and learnt from at its end
            learns = phase >= settings.warmup_phases - 1
            yield from self._learn(phase, self._memory, learns)
            if learns:
                self.close()
                yield []
        self.finished = True
        while True:
            yield None

    def _go_on(
        self, checkpoint: Checkpoint, memory: Trajectories
    ) -> Iterator[list[Record] | None]:
        """Take in the phases up to a checkpoint's, and go on as it was when it was saved."""
        for phase in range(checkpoint.phase + 1):
            while not self._intake.take(phase, memory):
                yield None
        going_on.restore_labels(memory, checkpoint)
        meta = checkpoint.meta
        self._counters = going_on.counted(meta, 'counters')
        for name, counter in (('duplicated', self.duplicated), ('refused', self.refused)):
            counter.clear()  # others hold these very counters
            counter.update(going_on.counted(meta, name))
        self._last_metrics = going_on.from_text(meta[going_on.KEY]['metrics'])
        self._saved = checkpoint.phase
        self._phase = checkpoint.phase + 1
        yield self._restore(checkpoint)
        self._from = None

    @abstractmethod
    def _begin(self) -> Iterator[list[Record]]:
        """Make what is trained, for sizes known now; yield the records before the first phase,
        unless it goes on from a checkpoint.
        """

    @abstractmethod
    def _restore(self, checkpoint: Checkpoint) -> list[Record]:
        """Go on as in a checkpoint; the records that were published after its phase."""

    @property
    def _predict(self) -> Predict | None:
        """What the reward model expects of segments; None: there is none, or it knows nothing."""
        return None

    @abstractmethod
    def _learn(
        self, phase: int, memory: Trajectories, learns: bool
    ) -> Iterator[list[Record] | None]:
        """Handle a phase that was taken in; sets `_phase` before it yields its last records."""

    @abstractmethod
    def _state(self) -> dict[str, torch.Tensor]:
        """The tensors that a checkpoint holds beside those of the memory."""

    def trained(self) -> dict[str, torch.Tensor]:
        """What has been trained so far, by name: copies."""
        return self._state()

    @abstractmethod
    def _facts(self) -> dict[str, Any]:
        """What a checkpoint holds beside tensors, for this core to go on: as JSON."""

    def _metrics(self, phase: int, values: Mapping[str, float]) -> Metrics:
        self._last_metrics = dict(values)
        step = self._settings.steps_after(phase)
        return records.metrics(self._run.run_id, self.role, self._name, phase, step, values)

    def close(self) -> None:
        """Save a checkpoint of the last finished phase, unless it exists or there is no folder."""
        done = self._phase - 1
        if self._folder is None or self._memory is None or self._saved == done:
            return
        if done < self._settings.warmup_phases - 1:
            return  # nothing has been learnt
        spec = self._intake.tasks.first
        meta = {
            'run_id': self._run.run_id,
            'settings': self._run.settings,
            'task': spec.task,
            'horizon': spec.horizon,
            'observation_size': spec.observation_size,
            'action_size': spec.action_size,
            'phase': done,
            going_on.KEY: {
                'counters': dict(self._counters),
                'duplicated': dict(self.duplicated),
                'refused': dict(self.refused),
                'metrics': going_on.as_text(self._last_metrics),
                **self._facts(),
            },
        }
        tensors = self._state() | going_on.memory_tensors(self._memory)
        # a run goes on from `lag` phases before its last commit, and one before that is kept
        keep = self._settings.lag + 2
        checkpoints.save(self._folder, self.role, done, tensors, meta, keep, self.disk)
        self._saved = done

    def report(self) -> CoreReport:
        """Counts for the run's summary."""
        report = CoreReport(
            duplicated=dict(self.duplicated),
            refused=dict(self.refused),
            counters=dict(self._counters + self._intake.dropped),
        )
        if self._memory is None:
            return report
        memory = MemoryFacts.model_validate(self._memory.report())
        return report.model_copy(update={'memory': memory})
