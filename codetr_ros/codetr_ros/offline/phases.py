"""`codetr fit --schedule phases`: learn from a run's bag what its reward node learnt.

The `Commit`s of the bag name the records that were learnt from, and when. The core of the reward
node receives the records of the bag in their order, and does its work after each commit as in the
run. With the run's settings, CPU and versions, it ends with the same weights, bit for bit.
"""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from codetr_ros.bags.causal import causal
from codetr_ros.bags.older import AsNow, as_now
from codetr_ros.bags.reader import Bag
from codetr_ros.config import Settings
from codetr_ros.cores.labeller import Labeller
from codetr_ros.offline.errors import FitError
from codetr_ros.records import TOPICS, Commit, Metrics, Record, RecordError, RunSpec, StepRewards

NODE = 'reward'
"""Name under which the core publishes; nothing is learnt from it."""


@dataclass
class Recorded:
    """Compares the labels that the bag holds with those made from it."""

    same: int = 0  # segments, or runs of steps of one
    other: int = 0
    _made: dict[tuple[int, str, int, int], bytes] = field(default_factory=dict)

    def made(self, parts: StepRewards) -> None:
        """Remember the labels made of one phase."""
        self._made.update(segments_of(parts))

    def recorded(self, parts: StepRewards) -> None:
        """Compare labels that were recorded."""
        for key, labels in segments_of(parts):
            if self._made.get(key) == labels:
                self.same += 1
            else:
                self.other += 1

    def forget(self, before: int) -> None:
        """Drop the labels made before a phase, whose recorded labels have been compared."""
        self._made = {key: labels for key, labels in self._made.items() if key[0] >= before}


@dataclass
class Fold:
    """The result of folding a bag."""

    core: Labeller
    run: RunSpec
    settings: Settings
    phases: int  # learnt from or received
    losses: list[tuple[int, float]]  # (gradient steps taken, mean loss of the phase)
    refused: Counter[str]  # records that were refused, by topic
    recorded: Recorded


def segments_of(parts: StepRewards) -> Iterator[tuple[tuple[int, str, int, int], bytes]]:
    """Phase, source, episode and first step of each row of labels, and the labels themselves."""
    ends = np.cumsum(parts.lengths, dtype=np.int64)
    for episode, first, length, end in zip(
        parts.episodes.tolist(),
        parts.first_steps.tolist(),
        parts.lengths.tolist(),
        ends.tolist(),
        strict=True,
    ):
        key = (parts.phase, parts.source, episode, first)
        yield key, parts.labels[end - length : end].tobytes()


def fold(
    bag: Bag,
    run: RunSpec,
    settings: Settings,
    folder: Path | None,
    report: Callable[[str], None] = lambda text: None,
    progress: Callable[[int, int], None] = lambda phase, phases: None,
    checkpoint: str = '',
    frozen: bool = False,
) -> Fold:
    """Learn from a run's bag phase by phase.

    Args:
        bag: the bag.
        run: one of the bag's runs.
        settings: the run's own, or changed ones, with which the result differs.
        folder: for checkpoints; None keeps none.
        report: called with each refused record and the reason.
        progress: called with the number of phases done and that of the run.
        checkpoint: the saved model that the run started from; empty if it had none.
        frozen: whether that model only labelled.

    Raises:
        CheckpointError: there is no such checkpoint.
        FitError: the bag lacks records that a commit names.
        RewardModelError: the checkpoint is of another method, size or shape, or training has
            diverged.
    """
    torch.set_num_threads(settings.thread_count)
    core = Labeller(as_now(run), settings, NODE, folder, checkpoint, frozen, alone=True)
    older = AsNow(None)  # the core compares no labels
    folded = Fold(core, run, settings, 0, [], core.refused, Recorded())
    kinds = (*core.subscribes, StepRewards)
    work = core.work()
    ours = (entry for entry in bag.entries(kinds) if entry.record.run_id == run.run_id)
    for entry in causal(ours, settings.ahead):
        record = older(entry.record)
        if isinstance(record, StepRewards):
            folded.recorded.recorded(record)
            continue
        try:
            core.receive(record)
        except RecordError as error:  # as in the run: refused, reported, counted
            folded.refused[TOPICS[entry.kind]] += 1
            report(f'{entry.place}: {error}')
        if isinstance(record, Commit):
            _work(work, folded)
            if core.doubt:
                raise FitError(
                    f'{bag.path}: phase {core.missing} of run {run.run_id!r} is not what its '
                    f'commit states: {core.doubt}. {folded.phases} phases were folded. '
                    '`codetr bag verify` names what differs'
                )
            if core.missing is not None:
                raise FitError(
                    f'{bag.path}: phase {core.missing} of run {run.run_id!r} is committed, but '
                    f'not all that belongs to it is in the bag: {folded.phases} phases were '
                    'folded. `codetr bag verify` names what is missing; --schedule epochs fits '
                    'on what is there'
                )
            folded.phases = record.phase + 1
            folded.recorded.forget(record.phase - settings.ahead)
            progress(folded.phases, settings.phases)
    core.close()
    return folded


def _work(work: Iterator[list[Record] | None], folded: Fold) -> None:
    """Let the core do all the work that it can."""
    while (records := next(work)) is not None:
        for record in records:
            if isinstance(record, StepRewards):
                folded.recorded.made(record)
            elif isinstance(record, Metrics):
                metrics = dict(zip(record.names, record.values.tolist(), strict=True))
                if 'reward_loss' in metrics:
                    folded.losses.append((int(metrics['gradient_steps']), metrics['reward_loss']))
