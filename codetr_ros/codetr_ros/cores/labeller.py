"""The reward side of Algorithm 1: take a phase in, fit, label, publish the changed labels."""

import logging
import time
from collections import Counter
from collections.abc import Generator, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from codetr_ros.config import Settings
from codetr_ros.cores import going_on, published
from codetr_ros.cores.consumer import Consumer
from codetr_ros.memory import due
from codetr_ros.memory.judgements import Predict
from codetr_ros.memory.segments import Spans
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import (
    F32,
    I64,
    MESSAGE_BYTES,
    Record,
    RunSpec,
    ScoreRequest,
    StepRewards,
    TrueRewards,
)
from codetr_ros.records.digests import digest_of_all
from codetr_ros.records.roles import subscribed
from codetr_ros.rewards import registry, saved
from codetr_ros.rewards.asking import worth_asking
from codetr_ros.rewards.base import ModelFacts, Predictor, RewardMethod, RewardModelError
from codetr_ros.runs import checkpoints
from codetr_ros.runs.checkpoints import Checkpoint
from codetr_ros.runs.reports import CoreReport, StartedFrom
from codetr_ros.seeding import generator, seed_torch

_log = logging.getLogger(__name__)


class Labeller(Consumer):
    """Infers step rewards from composite rewards, phase by phase.

    Args:
        run: the run.
        settings: its settings.
        name: node name.
        folder: where checkpoints go; None: no checkpoints.
        checkpoint: a saved reward model to start from (`saved.read`); empty: a new one.
        frozen: only label with the checkpoint; else the model goes on learning.
        alone: it learns again from what was recorded. The labels that commits name are those of
            the run then, and on another machine not its own to the bit.

    Raises:
        CheckpointError: the checkpoint does not exist, or is damaged.
        RewardModelError: `frozen` is set without a checkpoint.
    """

    role = 'reward'
    subscribes = subscribed('reward')

    def __init__(
        self,
        run: RunSpec,
        settings: Settings,
        name: str,
        folder: Path | None,
        checkpoint: str = '',
        frozen: bool = False,
        alone: bool = False,
    ) -> None:
        if frozen and not checkpoint:
            raise RewardModelError(
                'frozen = true without a checkpoint: a model that has learnt nothing would label '
                'and never learn. Give the checkpoint of a fit or a run, or leave frozen out'
            )
        self._start = saved.read(Path(checkpoint)) if checkpoint else None
        self._frozen = frozen
        self._alone = alone
        oracle = registry.kind(settings).needs_true_rewards
        if oracle:
            self.subscribes = (*self.subscribes, TrueRewards)
        super().__init__(run, settings, name, folder, scores=True, true_rewards=oracle)
        self._method: RewardMethod | None = None
        self._fitted = False
        self._given: list[StepRewards] = []  # published after the last phase

    @property
    def method(self) -> RewardMethod | None:
        """The reward method, once the task's sizes are known."""
        return self._method

    def _begin(self) -> Iterator[list[Record]]:
        spec = self._intake.tasks.first
        sizes = spec.observation_size, spec.action_size
        self._method = (
            registry.make(self._settings, *sizes)
            if self._start is None
            else saved.restore(self._start, self._settings, *sizes)
        )
        yield []

    def _restore(self, checkpoint: Checkpoint) -> list[Record]:
        assert self._method is not None
        self._method.load_state(checkpoints.of_model(checkpoint.tensors))
        facts = checkpoint.meta[going_on.KEY]
        self._fitted = bool(facts['fitted'])
        assert self._memory is not None
        self._given = published.again(
            facts['given'],
            checkpoint,
            self._memory.labelled,
            self._run.run_id,
            self._intake.commits.digest(checkpoint.phase),
        )
        self._note_labels(checkpoint.phase)
        return [*self._given, self._metrics(checkpoint.phase, self._last_metrics)]

    def _learn(
        self, phase: int, memory: Trajectories, learns: bool
    ) -> Iterator[list[Record] | None]:
        method = self._method
        assert method is not None
        if not learns:
            self._phase = phase + 1
            # published for every phase, because the player of a recorded run waits for it
            values = {'gradient_steps': method.gradient_steps}
            yield [*self._asked(phase, memory, method), self._metrics(phase, values)]
            return
        if self._informed(memory, method) and not self._frozen:
            method.prepare(memory)
        metrics: dict[str, float] = {}
        for means in self._fit(phase, memory, method):
            metrics |= means
            yield []
        began = time.perf_counter()
        parts: list[StepRewards] = []
        for batch in self._label(phase, memory, method):
            parts += batch
            yield []
        metrics |= method.metrics() | due.metrics(memory, method.version)
        metrics |= {
            'steps_labelled': sum(len(part.labels) for part in parts),
            'target_scale': method.target_scale,
            'label_unit': method.unit,
            'gradient_steps': method.gradient_steps,
            'label_seconds': time.perf_counter() - began,
        }
        metrics |= self._of_scorers(memory, method)
        self._phase = phase + 1
        commit = self._intake.commits.digest(phase)
        self._given = published.numbered(self._run.run_id, phase, method.version, parts, commit)
        self._note_labels(phase)
        yield [
            *self._given,
            *self._asked(phase, memory, method),
            self._metrics(phase, metrics),
        ]

    @property
    def _predict(self) -> Predict | None:
        known = isinstance(self._method, Predictor) and self._method.target_scale > 0
        return self._method.predict if known else None  # type: ignore[union-attr]

    def _informed(self, memory: Trajectories, method: RewardMethod) -> bool:
        """Whether there is anything to learn or to label from."""
        pairs = method.uses_preferences
        if method.target_scale:  # it has begun
            judgements = memory.judgements if pairs else None
            return bool(len(memory.segments.ids()) or (judgements and len(judgements.pairs())))
        return memory.informed(pairs)

    def _asked(
        self, phase: int, memory: Trajectories, method: RewardMethod
    ) -> Iterator[ScoreRequest]:
        """What scorers are asked for, where others than the simulator score."""
        if memory.judgements is None or not self._settings.requests:
            return
        knows = method if method.target_scale else None
        yield worth_asking(memory, knows, self._settings, self._run.run_id, phase)

    def _of_scorers(self, memory: Trajectories, method: RewardMethod) -> dict[str, float]:
        """What is known of each scorer, where others than the simulator score."""
        if memory.judgements is None:
            return {}
        facts = memory.judgements.facts()
        self._note_set_aside(method.set_aside(memory))
        known = {'segments_scored': float(len(memory.segments.ids()))}
        for name, fact in facts.items():
            known |= {f'scorer_{name}_{what}': float(n) for what, n in asdict(fact).items()}
        return known

    def _note_set_aside(self, counts: dict[str, int]) -> None:
        """Count judgements that are not learnt from as they were stated; log each reason once."""
        for reason, count in counts.items():
            if reason not in self._counters:
                _log.warning(
                    'method %s, composite %s: %s (%d so far): docs/methods.md names the methods '
                    'that learn from them',
                    *(self._settings.method, self._settings.composite, reason, count),
                )
            self._counters[reason] = count

    @property
    def permitted(self) -> int:
        """As of all consumers. But through the warm-up the learner waits for no labels."""
        warm = self._settings.warmup_phases - 2 + self._settings.ahead
        return max(super().permitted, warm)

    def _note_labels(self, phase: int) -> None:
        """Expect the labels just published in the commit that names them."""
        if not self._alone:
            self._intake.labels[phase] = digest_of_all(self._given)

    def _fit(
        self, phase: int, memory: Trajectories, method: RewardMethod
    ) -> Iterator[dict[str, float]]:
        steps = method.schedule.each if self._fitted else method.schedule.first
        if self._frozen:
            return
        if steps and not self._informed(memory, method):
            self._counters['gradient steps skipped, nothing scored'] += steps
            return
        self._fitted = True
        began = time.perf_counter()
        sums: Counter[str] = Counter()
        for i in range(steps):
            # its own random stream: neither interleaving nor a restart changes what it draws
            seed_torch(self._settings.seed, 'reward', phase, i)
            rng = generator(self._settings.seed, 'reward', phase, i)
            sums.update(method.gradient_step(memory, rng))
            yield {}
        if steps:
            means = {name: float(value) / steps for name, value in sums.items()}
            yield means | {'fit_seconds': time.perf_counter() - began}

    def _label(
        self, phase: int, memory: Trajectories, method: RewardMethod
    ) -> Iterator[list[StepRewards]]:
        """Label all new steps, and as many of the old ones as the settings ask for.

        The memory takes the labels in as the learner's memory will. So it shows which steps are
        labelled, by which version, and which the learner will draw.
        """
        segments = due.segments_due(memory, method.version, self._settings)
        if len(segments) and not self._informed(memory, method):  # nothing is known yet
            self._counters['segments not labelled, nothing scored'] += len(segments)
            return
        yield from self._whole(phase, memory, method, segments)
        if self._settings.relabel == 'all':
            return
        ids, within = due.steps_due(memory, method.version, self._settings, phase)
        if not method.single_steps:
            yield from self._whole(phase, memory, method, np.unique(ids))
        elif len(ids):
            labels = yield from _joined(method, method.step_passes(memory, ids, within))
            yield self._applied(
                phase, memory, memory.segments.step_spans(ids, within), labels, method.version
            )

    def _whole(
        self, phase: int, memory: Trajectories, method: RewardMethod, ids: I64
    ) -> Iterator[list[StepRewards]]:
        """Label segments, `label_batch` of them at a time."""
        for i in range(0, len(ids), method.label_batch):
            some = ids[i : i + method.label_batch]
            labels = yield from _joined(method, method.label_passes(memory, some))
            yield self._applied(phase, memory, memory.segments.spans(some), labels, method.version)

    def _applied(
        self,
        phase: int,
        memory: Trajectories,
        spans: Spans,
        labels: F32,
        version: int,
    ) -> list[StepRewards]:
        """Apply labels of spans of steps to the memory; the records that carry them."""
        pieces = []
        at = 0
        for source, *where in spans:
            lengths = where[2]
            begin = 0
            while begin < len(lengths):
                sizes = np.cumsum(lengths[begin:] * 4 + 12)
                end = begin + max(1, int(np.searchsorted(sizes, MESSAGE_BYTES, side='right')))
                steps = int(lengths[begin:end].sum())
                episodes, firsts, counts = (a[begin:end].astype(np.uint32) for a in where)
                part = labels[at : at + steps].copy()
                pieces.append(
                    StepRewards(
                        run_id=self._run.run_id,
                        phase=phase,
                        version=version,
                        part=0,
                        parts=0,
                        source=source,
                        episodes=episodes,
                        first_steps=firsts,
                        lengths=counts,
                        labels=part,
                    )
                )
                at += steps
                begin = end
        for piece in pieces:
            memory.apply(piece)
        return pieces

    def _state(self) -> dict[str, torch.Tensor]:
        assert self._method is not None
        return self._method.state() | published.spans(self._given)

    def _facts(self) -> dict[str, Any]:
        return {'fitted': self._fitted, 'given': published.described(self._given)}

    def report(self) -> CoreReport:
        """Counts and the digest of the reward model, for the run's summary."""
        more: dict[str, int | str | StartedFrom | ModelFacts | None] = {}
        if self._method is not None:
            more['gradient_steps'] = self._method.gradient_steps
            more['reward_model'] = self._method.report() or None
            more['reward_model_sha256'] = checkpoints.digest(self._method.state())
        if self._start is not None:
            more['started_from'] = StartedFrom(
                checkpoint=str(self._start.path),
                reward_model_sha256=self._start.digest,
                frozen=self._frozen,
            )
        return super().report().model_copy(update=more)


def _joined(
    method: RewardMethod, passes: Iterator[F32]
) -> Generator[list[StepRewards], None, F32]:
    """Labels from all forward passes, one slice each.

    Raises:
        RewardModelError: a label is not finite.
    """
    batches = []
    for labels in passes:
        batches.append(labels)
        yield []
    joined: F32 = np.concatenate(batches)
    if not np.isfinite(joined).all():
        raise RewardModelError(
            f'labels of method {method.name!r} are not finite after {method.gradient_steps} '
            'gradient steps: training has diverged. Lower its learning_rate, or set '
            'target_scale=rms'
        )
    return joined
