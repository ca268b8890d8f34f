"""The learner's side of Algorithm 1: permit a phase, take it in, learn, permit the next."""

import logging
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from codetr_ros.config import Settings
from codetr_ros.cores import going_on
from codetr_ros.cores.consumer import Consumer
from codetr_ros.cores.held_labels import HeldLabels
from codetr_ros.learners import registry
from codetr_ros.learners.base import PolicyLearner
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.policy.actor import weights_bytes
from codetr_ros.records import (
    INITIAL_VERSION,
    TOPICS,
    Policy,
    Record,
    RecordError,
    RunSpec,
    StepRewards,
    describe,
)
from codetr_ros.records.checks import check_labels, check_run
from codetr_ros.records.digests import digest, digest_of_all
from codetr_ros.records.roles import subscribed
from codetr_ros.runs import checkpoints
from codetr_ros.runs.checkpoints import Checkpoint
from codetr_ros.runs.reports import PREFERENCES_UNUSED, CoreReport
from codetr_ros.system.devices import usable

_log = logging.getLogger(__name__)


class Learner(Consumer):
    """Learns a policy, phase by phase: from labelled steps, or from the scores themselves.

    Args:
        run: the run.
        settings: its settings.
        name: node name.
        folder: where checkpoints go; None: no checkpoints.

    Raises:
        DeviceError: this machine lacks the device of the settings.
    """

    role = 'learner'
    subscribes = subscribed('learner')

    def __init__(self, run: RunSpec, settings: Settings, name: str, folder: Path | None) -> None:
        usable(settings.device)  # refuse a missing device at once
        self.subscribes = subscribed('learner', settings.labels_steps)
        super().__init__(run, settings, name, folder, scores=not settings.labels_steps)
        self._labels = HeldLabels()
        self._awaits_labels = False
        self._applied = 0  # labels of phases before this one have been taken in
        self._learner: PolicyLearner | None = None

    @property
    def unlabelled(self) -> int | None:
        """A phase whose labels are awaited; None if there is none."""
        return self._phase if self._awaits_labels else None

    def receive(self, record: Record) -> None:
        """Hold a record until its phase's turn.

        Raises:
            RecordError: it must be refused; nothing has changed then.
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
        check_labels(record, self._settings)
        if record.phase > self.permitted:
            raise RecordError(
                f'{describe(record)} has labels of phase {record.phase}, and phase '
                f'{self.permitted} is the newest that is permitted: stop what '
                'publishes them'
            )
        made_of = self._intake.commits.digest(record.phase)
        if made_of and record.commit != made_of:
            raise RecordError(
                f'{describe(record)} was made of the commit {record.commit!r}; that of phase '
                f'{record.phase} is {made_of!r}: stop the second reward node'
            )
        dropped = self._labels.dropped
        commits = self._intake.commits.candidates(record.phase)
        if record.phase < self._applied or not self._labels.add(record, commits):
            self.duplicated[TOPICS[StepRewards]] += 1
        if self._labels.dropped > dropped:
            self.refused[TOPICS[StepRewards]] += self._labels.dropped - dropped

    def _begin(self) -> Iterator[list[Record]]:
        spec = self._intake.tasks.first
        self._learner = registry.make(self._settings, spec.observation_size, spec.action_size)
        if self._from is None:
            for phase in range(self._settings.lag):
                yield [self._permit(phase, INITIAL_VERSION)]

    def _restore(self, checkpoint: Checkpoint) -> list[Record]:
        learner, phase = self._learner, checkpoint.phase
        assert learner is not None
        learner.load_state(checkpoints.of_model(checkpoint.tensors))
        learner.updates = int(checkpoint.meta[going_on.KEY]['updates'])
        learner.counters.clear()
        learner.counters.update(going_on.counted(checkpoint.meta, 'learner_counters'))
        self._applied = phase + 1
        self._labels.forget(phase)
        return self._published(phase, self._last_metrics)

    def _learn(
        self, phase: int, memory: Trajectories, learns: bool
    ) -> Iterator[list[Record] | None]:
        learner = self._learner
        assert learner is not None
        metrics: dict[str, float] = {}
        if learns:
            if self._settings.labels_steps:
                yield from self._take_labels(phase, memory)
            for values in learner.train(phase, memory):
                metrics |= values
                yield []
        metrics |= {
            'updates': learner.updates,
            'labelled_steps': memory.labelled.count,
            'memory_steps': memory.steps,
            'memory_bytes': memory.nbytes,
        }
        self._phase = phase + 1
        # permit before the checkpoint: the message travels while the checkpoint is written
        yield self._published(phase, metrics)

    def _published(self, phase: int, metrics: Mapping[str, float]) -> list[Record]:
        """What is published once a phase has been learnt from."""
        return [self._permit(phase + self._settings.lag, phase), self._metrics(phase, metrics)]

    def _take_labels(self, phase: int, memory: Trajectories) -> Iterator[None]:
        """Wait for the labels that were made of a phase's commit, and take them in."""
        commit = self._intake.commits.digest(phase)
        self._awaits_labels = True
        while not self._labels.whole(phase, commit):
            yield None
        self._awaits_labels = False
        self._applied = phase + 1
        parts, others = self._labels.take(phase, commit)
        if others:
            self.refused[TOPICS[StepRewards]] += others
            _log.error(
                'refused %s parts of labels of phase %s that were made of no commit of the '
                'recorder: stop what publishes them', others, phase,
            )  # fmt: skip
        for part in parts:
            self._counters['labels of evicted steps'] += memory.apply(part)
        self._intake.labels[phase] = digest_of_all(parts)

    def waiting_for(self) -> str:
        """What the next slice waits for, for people."""
        if self._awaits_labels:
            return f'labels of phase {self._phase} from the reward node'
        return super().waiting_for()

    def _permit(self, phase: int, version: int) -> Policy:
        learner, settings = self._learner, self._settings
        assert learner is not None
        sources = self._intake.tasks.sources
        shares = self._settings.shares_of(phase)
        absent = self._intake.absent.of(phase)
        assert absent is not None  # the phase that it follows from is taken in
        steps = [0 if source in absent else n for source, n in zip(sources, shares, strict=True)]
        random = phase < settings.warmup_phases
        policy = Policy(
            run_id=self._run.run_id,
            phase=phase,
            version=version,
            sources=sources,
            steps=np.array(steps, np.uint32),
            random=random,
            network='' if random else learner.network,
            weights=b'' if random else weights_bytes(learner.actor),
        )
        if not settings.free:
            self._intake.policies[phase] = digest(policy)
        return policy

    def _state(self) -> dict[str, torch.Tensor]:
        assert self._learner is not None
        return dict(self._learner.state())

    def _facts(self) -> dict[str, Any]:
        assert self._learner is not None
        return {
            'updates': self._learner.updates,
            'learner_counters': dict(self._learner.counters),
        }

    def _set_aside(self) -> dict[str, int]:
        """Preferences, where the learner learns from scores itself and nobody from those."""
        memory = self._memory
        if self._settings.labels_steps or memory is None or memory.judgements is None:
            return {}
        pairs = len(memory.judgements.pairs())
        return {PREFERENCES_UNUSED: pairs} if pairs else {}

    def report(self) -> CoreReport:
        """Counts and the digest of the policy, for the run's summary."""
        report = super().report()
        if self._learner is None:
            return report.model_copy(update={'updates': 0})
        return report.model_copy(
            update={
                'updates': self._learner.updates,
                'counters': report.counters | self._learner.counters | self._set_aside(),
                'policy_sha256': checkpoints.digest(self._learner.actor.state_dict()),
            }
        )
