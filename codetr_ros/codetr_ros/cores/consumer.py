"""The common part of learner and reward side: a memory fed by commits, checkpoints, a report."""

from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import ClassVar

import torch

from codetr_ros import records
from codetr_ros.config import Settings
from codetr_ros.cores.core import Part
from codetr_ros.cores.intake import Intake
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import Metrics, Record, RunSpec
from codetr_ros.runs import checkpoints
from codetr_ros.runs.reports import CoreReport, MemoryFacts


class Consumer(Part, ABC):
    """A core that takes phases into its memory D, in order, and learns from each.

    Args:
        run: the run.
        settings: its settings.
        name: node name.
        folder: where checkpoints go; None: no checkpoints.
        scores: whether composite rewards are taken in.
        true_rewards: whether the environment's own rewards are taken in: in-process oracle only.
    """

    role: ClassVar[str]

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
        self._true_rewards = true_rewards
        self._intake = Intake(run, settings, scores, true_rewards)
        self._memory: Trajectories | None = None
        self._phase = 0  # the next to be learnt from
        self._saved = -1
        self._counters: Counter[str] = Counter()
        self.duplicated = self._intake.duplicated
        self.refused = self._intake.refused

    @property
    def missing(self) -> int | None:
        """A committed phase that is incomplete; None if there is none."""
        return self._intake.missing

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
        )
        yield from self._begin()
        for phase in range(settings.phases):
            while not self._intake.take(phase, self._memory):
                yield None
            # the phases of the warm-up are stored, and learnt from at its end
            learns = phase >= settings.warmup_phases - 1
            yield from self._learn(phase, self._memory, learns)
            if learns:
                self.close()
                yield []
        self.finished = True
        while True:
            yield None

    @abstractmethod
    def _begin(self) -> Iterator[list[Record]]:
        """Make what is trained, for sizes known now; yield the records before the first phase."""

    @abstractmethod
    def _learn(
        self, phase: int, memory: Trajectories, learns: bool
    ) -> Iterator[list[Record] | None]:
        """Handle a phase that was taken in; sets `_phase` before it yields its last records."""

    @abstractmethod
    def _state(self) -> dict[str, torch.Tensor]:
        """The tensors that a checkpoint holds."""

    def _metrics(self, phase: int, values: Mapping[str, float]) -> Metrics:
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
        }
        checkpoints.save(self._folder, self.role, done, self._state(), meta)
        self._saved = done

    def report(self) -> CoreReport:
        """Counts for the run's summary."""
        report = CoreReport(
            duplicated=dict(self.duplicated),
            refused=dict(self.refused),
            counters=dict(self._counters),
        )
        if self._memory is None:
            return report
        memory = MemoryFacts.model_validate(self._memory.report())
        return report.model_copy(update={'memory': memory})
