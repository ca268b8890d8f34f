"""A run in process that was ended at any moment goes on, to the bit.

Its bag is cut back to the last commit. Learner and reward side go back to a phase k of which they
both have a sound checkpoint, and all of whose labels and policies lie before that commit: in
lock-step the phase before the last, with overlap the one before that. They take the phases up to k
in, and learn from the later ones again. Simulators and the evaluator go on behind what the bag
holds. Without such checkpoints everything is learnt again, from the bag alone.
"""

import logging
from collections.abc import Callable
from pathlib import Path

import torch

from codetr_ros.bags.cutting import Cut, announced
from codetr_ros.bags.definitions import decode
from codetr_ros.bags.errors import BagError
from codetr_ros.bags.raw import RawMessage
from codetr_ros.bags.reopening import reopen
from codetr_ros.config import Settings, from_canonical, settled
from codetr_ros.cores import going_on, preparing
from codetr_ros.cores.consumer import Consumer
from codetr_ros.cores.in_process import Parts, driven, namespace_of
from codetr_ros.cores.recording import RunBag
from codetr_ros.records import (
    Commit,
    EpisodeResult,
    Metrics,
    Policy,
    Presence,
    Record,
    RecordError,
    RunSpec,
    StepRewards,
    TaskSpec,
)
from codetr_ros.records.fields import RECORD_TYPES
from codetr_ros.records.identity import identity
from codetr_ros.runs import checkpoints
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.reports import NodeReport

_log = logging.getLogger(__name__)


def prepare(
    settings: Settings,
    run_id: str,
    folder: Path,
    observe: Callable[[Record], None] = lambda record: None,
    tick: Callable[[], None] = lambda: None,
    past: Callable[[Record], None] = lambda record: None,
    log: Callable[[str], None] = _log.warning,
) -> Parts:
    """Bring the parts of a run in process to where they were: `in_process.driven` goes on.

    Args:
        settings: the run's settings; only `steps` may be others than before, and more.
        run_id: its name.
        folder: its folder, with its bag and checkpoints.
        observe: called with every record that the bag does not hold yet.
        tick: as for `in_process.run`.
        past: called with every record that the bag holds.
        log: takes what people should know, a line at a time.

    Raises:
        BagError: the bag is damaged before its last commit, of another run or of other settings,
            or cannot be written; or simulated people score, who do not remember.
        CheckpointError: the checkpoints are of another run, of other settings or of an older
            version.
        RecordError: the bag's records contradict each other.
    """
    settings = settled(settings)
    if settings.scorer == 'simulated':
        raise BagError(
            f'scorer = simulated: simulated people do not remember what they were asked for, so '
            f'that run {run_id!r} cannot be gone on with; start it again'
        )
    torch.set_num_threads(settings.thread_count)
    bag = folder / run_folder.BAG
    before = announced(bag)
    preparing.check_not_lost(bag, folder)
    if before is not None:
        preparing.check(before, settings, run_id, bag)
    known = None if before is None else from_canonical(before.settings, str(bag))
    made = preparing.cut_back(bag, known, settings, log)
    parts = Parts(settings, run_id, folder, observe, tick)
    _Past(parts, folder, made, past, log).restore()
    return parts


def take_up(settings: Settings, run_id: str, folder: Path) -> dict[str, NodeReport]:
    """Go on with a run in process to its end; the errors are those of `prepare`."""
    return driven(prepare(settings, run_id, folder))


class _Past:
    """What the bag of a run holds, handed to its parts.

    Args:
        parts: those of the run that goes on.
        folder: of the run.
        made: what is left of its bag.
        past: takes what the bag holds.
        log: takes what people should know.
    """

    def __init__(
        self,
        parts: Parts,
        folder: Path,
        made: Cut,
        past: Callable[[Record], None],
        log: Callable[[str], None],
    ) -> None:
        self._parts = parts
        self._folder = folder
        self._commit = made.commit
        self._past = past
        self._log = log
        self._known = 0  # the last phase of which all that was learnt lies before the commit
        self._policies: dict[int, Policy] = {}  # whose evaluation may be incomplete, by version
        self._pending: list[tuple[str, Record]] = []

    @property
    def _consumers(self) -> dict[str, Consumer]:
        parts = self._parts
        reward = {} if parts.reward is None else {'reward': parts.reward}
        return {**reward, 'learner': parts.learner}

    def restore(self) -> None:
        """Bring all parts to where they were at the last commit."""
        parts, commit = self._parts, self._commit
        bag = self._folder / run_folder.BAG
        if commit is None:
            self._begin_again(bag)
            return
        last = commit.phase
        self._known = last - parts.settings.lag
        phase = self._common(self._known)
        for consumer in self._consumers.values():
            consumer.resume(phase)
        written = reopen(bag, self._take)
        namespace = namespace_of(parts.spec.run_id)
        parts.bag = RunBag(bag, parts.settings, namespace, written)
        for simulator in parts.simulators.values():
            simulator.resume(last + 1)
        for policy in self._policies.values():
            parts.evaluator.receive(policy)
        for name, record in self._pending:
            # the learner has the labels
            parts.publish(name, record, 'learner' if isinstance(record, StepRewards) else '')

    def _begin_again(self, bag: Path) -> None:
        """Begin from the start in the same folder: nothing has been learnt from."""
        preparing.begin_again(self._folder, self._log)
        assert all(consumer.phase == 0 for consumer in self._consumers.values())
        self._parts.bag = RunBag(bag, self._parts.settings, namespace_of(self._parts.spec.run_id))
        self._parts.announce()

    def _common(self, newest: int) -> int:
        """The newest phase of which all consumers have a sound checkpoint; -1: there is none."""
        parts = self._parts
        where = self._folder / run_folder.CHECKPOINTS
        sound: list[set[int]] = []
        for name in self._consumers:
            sound.append(set())
            for checkpoint in checkpoints.sound(where, name, newest, self._log):
                going_on.check(checkpoint, parts.spec, parts.settings)
                if _same_warmup(checkpoint.meta, parts.settings):
                    sound[-1].add(checkpoint.phase)
        common = max(set.intersection(*sound), default=-1)
        if common < 0:
            self._log(
                f'no sound checkpoint of phase {newest} or before of '
                f'{" and ".join(self._consumers)}: all phases are learnt from again'
            )
        else:
            self._log(f'learner and reward side go on from their checkpoints of phase {common}')
        return common

    def _take(self, message: RawMessage) -> None:
        """Hand the next message of the bag to those that had it."""
        kind = RECORD_TYPES.get(message.channel.type)
        if kind is None or kind in (RunSpec, Presence):
            return
        record, parts = decode(kind, message.data), self._parts
        parts.count(self._publisher(record), record)
        self._past(record)
        parts.recorder.restore(record)
        for simulator in parts.simulators.values():
            simulator.restore(record)
        parts.evaluator.restore(record)
        if self._comes_again(record):
            parts.repeats.add((type(record), identity(record)))
        self._keep_policies(record)
        for consumer in self._consumers.values():
            # labels are inferred again, and taken in as they are
            if type(record) in consumer.subscribes and not isinstance(record, StepRewards):
                consumer.receive(record)
        if isinstance(record, Commit):
            self._learn()

    def _comes_again(self, record: Record) -> bool:
        """Whether a part may publish a record of the bag once more."""
        if isinstance(record, (StepRewards, Metrics)):
            return record.phase > self._known
        return isinstance(record, TaskSpec)

    def _publisher(self, record: Record) -> str:
        """The part that published a record."""
        if isinstance(record, Metrics):
            name = record.node
        elif isinstance(record, Policy):
            name = 'learner'
        elif isinstance(record, Commit):
            name = 'record'
        elif isinstance(record, StepRewards):
            name = 'reward'
        else:
            source = str(getattr(record, 'source', ''))
            name = source if source == 'evaluate' else self._parts.settings.simulator_of(source)
        if name not in self._parts.members:
            raise RecordError(
                f'the bag holds a record of {name!r}, which is no part of this run: it is one '
                'over topics, or of other settings'
            )
        return name

    def _keep_policies(self, record: Record) -> None:
        """Keep the policies that are still to be evaluated, in whole or in part."""
        settings = self._parts.settings
        if isinstance(record, Policy):
            first = record.random and record.phase == 0
            if first or settings.evaluated(record.version):
                self._policies.setdefault(record.version, record)
        elif isinstance(record, EpisodeResult) and self._parts.evaluator.has_evaluated(
            record.version
        ):
            self._policies.pop(record.version, None)

    def _learn(self) -> None:
        """Let the consumers do all that they can. What they publish is in the bag already, but for
        the last phases; labels are handed on.
        """
        busy = True
        while busy:
            busy = False
            for name in self._consumers:
                while (records := self._parts.given_by(name)) is not None:
                    busy = True
                    for record in records:
                        self._note(name, record)
        for consumer in self._consumers.values():
            if consumer.missing is not None:
                raise RecordError(
                    f'phase {consumer.missing} cannot be learnt from again: '
                    f'{consumer.doubt or "the bag lacks some of it"}. Weights that are made here '
                    'are not those of the run, or its bag was changed: go on with the run on the '
                    'machine that began it, or restore bag and checkpoints from a copy'
                )

    def _note(self, name: str, record: Record) -> None:
        if isinstance(record, StepRewards):
            self._parts.learner.receive(record)
        lag = self._parts.settings.lag if isinstance(record, Policy) else 0
        if isinstance(record, (Policy, StepRewards, Metrics)) and (
            record.phase - lag > self._known
        ):
            self._pending.append((name, record))


def _same_warmup(meta: dict[str, object], settings: Settings) -> bool:
    """Whether a checkpoint's run had a warm-up of as many phases: a shorter run may have ended
    with its warm-up, and have learnt at its end.
    """
    before = from_canonical(str(meta['settings']), 'checkpoint')
    return before.warmup_phases == settings.warmup_phases
