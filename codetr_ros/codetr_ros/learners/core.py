"""The learner's part of Algorithm 1: permit a phase, take it in, learn from its labels, permit the
next.
"""

import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from codetr_ros import checkpoints, records
from codetr_ros.config import Settings
from codetr_ros.intake import Intake, check_run
from codetr_ros.learners import network
from codetr_ros.learners.sac import SAC
from codetr_ros.records import (
    INITIAL_VERSION,
    TOPICS,
    Commit,
    Policy,
    Record,
    RecordError,
    RunSpec,
    StepRewards,
    TaskSpec,
    Transitions,
    describe,
)
from codetr_ros.seeding import generator, seed_torch
from codetr_ros.trajectories import Trajectories


class Learner:
    """Learns a policy from labelled steps, phase by phase.

    Args:
        run: the run.
        settings: its settings.
        name: node name.
        folder: where checkpoints go; None keeps none.
    """

    subscribes: tuple[type, ...] = (TaskSpec, Transitions, Commit, StepRewards)

    def __init__(self, run: RunSpec, settings: Settings, name: str, folder: Path | None) -> None:
        self._run = run
        self._settings = settings
        self._name = name
        self._folder = folder
        self._intake = Intake(run, settings, scores=False)
        self._labels: dict[int, dict[int, StepRewards]] = {}
        self._memory: Trajectories | None = None
        self._sac: SAC | None = None
        self._phase = 0  # the next to be learnt from
        self._saved = -1
        self._updates = 0
        self._counters: Counter[str] = Counter()
        self._duplicated: Counter[str] = Counter()
        self.finished = False

    @property
    def missing(self) -> int | None:
        """A committed phase of which something has not arrived."""
        return self._intake.missing

    def receive(self, record: Record) -> None:
        """Hold a record until its phase's turn.

        Raises:
            RecordError: it must not be taken in; nothing has changed.
        """
        if not isinstance(record, StepRewards):
            self._intake.receive(record)
            return
        check_run(record, self._run)
        if len(record.labels) != int(record.lengths.sum()):
            raise RecordError(
                f'{describe(record)}: {len(record.labels)} labels for segments of '
                f'{int(record.lengths.sum())} steps'
            )
        if not np.isfinite(record.labels).all():
            raise RecordError(
                f'{describe(record)}: labels[{int(np.argmin(np.isfinite(record.labels)))}] is not '
                'finite'
            )
        parts = self._labels.setdefault(record.phase, {})
        if record.phase < self._phase or record.part in parts:
            self._duplicated[TOPICS[StepRewards]] += 1
        else:
            parts[record.part] = record

    def work(self) -> Iterator[list[Record] | None]:
        """Algorithm 1 as this node sees it; one slice per `next()`."""
        settings = self._settings
        while not self._intake.tasks.known:
            yield None
        spec = self._intake.tasks.first
        margin = settings.phase_steps + spec.horizon
        memory = Trajectories(
            spec.observation_size, spec.action_size, settings.delay, settings.memory_steps, margin
        )
        sac = SAC(spec.observation_size, spec.action_size, settings.sac, settings.seed)
        self._memory, self._sac = memory, sac
        for phase in range(settings.lag):
            yield [self._permit(phase, INITIAL_VERSION)]
        for phase in range(settings.phases):
            while not self._intake.take(phase, memory):
                yield None
            metrics: dict[str, float] = {}
            if phase >= settings.warmup_phases - 1:
                while not self._labelled(phase):
                    yield None
                for _, part in sorted(self._labels.pop(phase).items()):
                    self._counters['labels of evicted steps'] += memory.apply(part)
                for said in self._learn(phase, memory, sac):
                    metrics |= said
                    yield []
            metrics |= {
                'updates': self._updates,
                'labelled_steps': memory.labelled_steps,
                'memory_steps': memory.steps,
                'memory_bytes': memory.nbytes,
            }
            self._phase = phase + 1
            # the permission first: while it travels, the checkpoint is written
            yield [
                self._permit(phase + settings.lag, phase),
                records.metrics(
                    self._run.run_id,
                    'learner',
                    self._name,
                    phase,
                    settings.steps_after(phase),
                    metrics,
                ),
            ]
            if phase >= settings.warmup_phases - 1:
                self.close()
                yield []
        self.finished = True
        while True:
            yield None

    def _labelled(self, phase: int) -> bool:
        parts = self._labels.get(phase, {})
        return bool(parts) and len(parts) == next(iter(parts.values())).parts

    def _learn(self, phase: int, memory: Trajectories, sac: SAC) -> Iterator[dict[str, float]]:
        settings = self._settings.sac
        updates = round(self._settings.steps_of(phase) * settings.updates_per_step)
        if not memory.labelled_steps:
            self._counters['updates skipped, nothing labelled'] += updates
            return
        totals: dict[str, torch.Tensor] = {}
        began = time.perf_counter()
        done = 0
        while done < updates:
            # a slice of its own stream: neither interleaving nor a restart changes what it draws
            rng = generator(self._settings.seed, 'learner', phase, done)
            seed_torch(self._settings.seed, 'learner', phase, done)
            burst = min(settings.burst, updates - done)
            for _ in range(burst):
                said = sac.update(memory.sample_steps(rng, settings.batch))
                for name, value in said.items():
                    totals[name] = totals.get(name, torch.zeros(())) + value
            done += burst
            self._updates += burst
            yield {}
        means = {name: float(total) / updates for name, total in totals.items()}
        yield means | {'update_seconds': time.perf_counter() - began}

    def _permit(self, phase: int, version: int) -> Policy:
        assert self._sac is not None
        settings = self._settings
        sources = self._intake.tasks.sources
        steps = settings.steps_of(phase)
        # the first simulators take one step more where the phase does not divide
        shares = [steps // len(sources) + (i < steps % len(sources)) for i in range(len(sources))]
        spec = self._intake.tasks.first
        random = phase < settings.warmup_phases
        return Policy(
            self._run.run_id,
            phase,
            version,
            sources,
            np.array(shares, np.uint32),
            random,
            ''
            if random
            else network.describe(spec.observation_size, spec.action_size, settings.sac.hidden),
            b'' if random else network.weights_bytes(self._sac.actor),
        )

    def close(self) -> None:
        """Save a checkpoint of the last finished phase, unless there is one or no folder."""
        if (
            self._folder is None
            or self._sac is None
            or self._memory is None
            or self._saved == self._phase - 1
        ):
            return
        tensors = dict(self._sac.state())
        for source, labels in self._memory.labels().items():
            tensors[f'labels/{source}'] = torch.from_numpy(labels)
        meta = {
            'run_id': self._run.run_id,
            'settings': self._run.settings,
            'task': self._intake.tasks.first.task,
            'observation_size': self._intake.tasks.first.observation_size,
            'action_size': self._intake.tasks.first.action_size,
            'phase': self._phase - 1,
            'updates': self._updates,
        }
        checkpoints.save(self._folder, 'learner', self._phase - 1, tensors, meta)
        self._saved = self._phase - 1

    def report(self) -> dict[str, Any]:
        """Counts and digests for the run's summary."""
        said: dict[str, Any] = {
            'duplicated': dict(self._intake.duplicated + self._duplicated),
            'refused': dict(self._intake.refused),
            'counters': dict(self._counters),
            'updates': self._updates,
        }
        if self._sac is not None:
            said['policy_sha256'] = checkpoints.digest(dict(self._sac.actor.state_dict()))
        if self._memory is not None:
            said['memory'] = self._memory.report()
        return said
