"""The learner's part of Algorithm 1: permit, take in, learn from the labels, permit again."""

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import torch

from codetr_ros import checkpoints
from codetr_ros.config import Settings
from codetr_ros.consumer import Consumer
from codetr_ros.intake import check_run
from codetr_ros.learners import network
from codetr_ros.learners.sac import SAC, SacError
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


class Learner(Consumer):
    """Learns a policy from labelled steps, phase by phase.

    Args:
        run: the run.
        settings: its settings.
        name: node name.
        folder: where checkpoints go; None keeps none.
    """

    role = 'learner'
    subscribes: tuple[type, ...] = (TaskSpec, Transitions, Commit, StepRewards)

    def __init__(self, run: RunSpec, settings: Settings, name: str, folder: Path | None) -> None:
        super().__init__(run, settings, name, folder, scores=False)
        self._labels: dict[int, dict[int, StepRewards]] = {}
        self._sac: SAC | None = None
        self._updates = 0

    def receive(self, record: Record) -> None:
        """Hold a record until its phase's turn.

        Raises:
            RecordError: it must not be taken in; nothing has changed.
        """
        if not isinstance(record, StepRewards):
            super().receive(record)
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
        parts = self._labels.get(record.phase, {})
        others = next((part.parts for part in parts.values()), record.parts)
        if record.part >= record.parts or record.parts != others:
            raise RecordError(
                f'{describe(record)}: part {record.part} of {record.parts}, where others of the '
                f'phase are of {others}: two reward nodes? Stop one of them'
            )
        if record.phase < self._phase or record.part in parts:
            self.duplicated[TOPICS[StepRewards]] += 1
        else:
            self._labels.setdefault(record.phase, {})[record.part] = record

    def _begin(self) -> Iterator[list[Record]]:
        spec = self._intake.tasks.first
        self._sac = SAC(
            spec.observation_size, spec.action_size, self._settings.sac, self._settings.seed
        )
        for phase in range(self._settings.lag):
            yield [self._permit(phase, INITIAL_VERSION)]

    def _learn(
        self, phase: int, memory: Trajectories, learns: bool
    ) -> Iterator[list[Record] | None]:
        metrics: dict[str, float] = {}
        if learns:
            while not self._labelled(phase):
                yield None
            for _, part in sorted(self._labels.pop(phase).items()):
                self._counters['labels of evicted steps'] += memory.apply(part)
            for said in self._update(phase, memory):
                metrics |= said
                yield []
        metrics |= {
            'updates': self._updates,
            'labelled_steps': memory.labelled_steps,
            'memory_steps': memory.steps,
            'memory_bytes': memory.nbytes,
        }
        self._phase = phase + 1
        # the permission before the checkpoint: while it travels, the checkpoint is written
        yield [self._permit(phase + self._settings.lag, phase), self._metrics(phase, metrics)]

    def _labelled(self, phase: int) -> bool:
        parts = self._labels.get(phase, {})
        return bool(parts) and len(parts) == next(iter(parts.values())).parts

    def _update(self, phase: int, memory: Trajectories) -> Iterator[dict[str, float]]:
        assert self._sac is not None
        settings, sac = self._settings.sac, self._sac
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
        if not all(bool(weight.isfinite().all()) for weight in sac.actor.parameters()):
            raise SacError(
                f'the policy is not finite after phase {phase} ({means}): training has diverged. '
                'Lower sac.actor_learning_rate and sac.critic_learning_rate, or set '
                'target_scale=rms and reward_unit=scaled'
            )
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

    def _state(self) -> dict[str, torch.Tensor]:
        assert self._sac is not None
        assert self._memory is not None
        state = dict(self._sac.state())
        for source, labels in self._memory.labels().items():
            state[f'labels/{source}'] = torch.from_numpy(labels)
        return state

    def report(self) -> dict[str, Any]:
        """Counts and the digest of the policy, for the run's summary."""
        said = super().report() | {'updates': self._updates}
        if self._sac is not None:
            said['policy_sha256'] = checkpoints.digest(dict(self._sac.actor.state_dict()))
        return said
