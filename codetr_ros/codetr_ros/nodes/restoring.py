"""A node that joins a run which has begun without it, or that was killed in it, goes on where the
run stands.

The recorder has every committed phase. It is asked for what a node needs to be as it was: a
simulator for its open episodes, the evaluator for its results, learner and reward node (once they
work) for the phases that fill their memory.

What a node asks is a generator: it yields questions and gets what came of each. `Restoring` asks
them, however the node waits for the answers.
"""

from collections.abc import Callable, Collection, Generator
from dataclasses import dataclass
from itertools import chain
from typing import Any

from codetr_ros.config import Settings
from codetr_ros.nodes.asking import NEWEST, Answer, Asks
from codetr_ros.nodes.errors import NodeError
from codetr_ros.nodes.peers import Peers
from codetr_ros.records import (
    INITIAL_VERSION,
    TOPICS,
    Commit,
    CompositeReward,
    EpisodeResult,
    Policy,
    Record,
    TaskSpec,
    Transitions,
    TrueRewards,
)
from codetr_ros.records.dropped import undropped
from codetr_ros.records.fields import type_name

_SIMULATED = (Transitions, TrueRewards, CompositeReward)
"""What is recorded of a simulator in a phase."""


@dataclass(frozen=True)
class Question:
    """Asks the recorder for records of these kinds of a phase, or of `NEWEST`."""

    phase: int
    kinds: tuple[type, ...]


Sent = tuple[int | None, list[Record]]
"""Which phase was sent, None if none is committed, and its records."""
Steps = Generator[Question, Sent, None]
"""What is asked, one question after the other."""


@dataclass(frozen=True)
class Returning:
    """A node that joins.

    Attributes:
        role: one of `records.ROLES`.
        name: the node's name within the run.
        core: its part of the run, which has not worked yet.
        settings: those of the run.
        peers: the other nodes, all of which are present.
        catch_up: lets the core fetch all phases up to a committed one.
        begin_counting_anew: counts as lost only what is published from now on.
        log: the node's logger.
    """

    role: str
    name: str
    core: Any
    settings: Settings
    peers: Peers
    catch_up: Callable[[int], None]
    begin_counting_anew: Callable[[], None]
    log: Any


class Restoring:
    """Asks the recorder one question after the other.

    Args:
        recorder: asks it.
        fetched: the record in the bytes of a message that came (`Traffic.fetched`).
        who: the node's full name, for errors.
        steps: what is asked.
    """

    def __init__(
        self, recorder: Asks, fetched: Callable[[type, bytes], Record], who: str, steps: Steps
    ) -> None:
        self._recorder = recorder
        self._fetched = fetched
        self._who = who
        self._steps = steps
        self._answers: list[Answer] = []
        self._question = next(steps, None)

    def lacking(self) -> list[str]:
        """The answer that is waited for, in words; empty once all have come. Call it often: it
        takes the answers, and asks on.

        Raises:
            NodeError: the recorder refuses to send something.
            RecordError: a message cannot be decoded, is out of bounds or not signed.
            CheckpointError: a checkpoint is of another run.
            TaskError: an environment is at fault.
        """
        while self._question is not None and self._answers:
            try:
                self._question = self._steps.send(self._sent(self._question, self._answers.pop()))
            except StopIteration:
                self._question = None
        question = self._question
        if question is None:
            return []
        if self._recorder.ready and not self._recorder.busy:
            names = [type_name(kind) for kind in question.kinds]
            self._recorder.ask(question.phase, lambda answer: self._take(question, answer), names)
        which = 'the newest phase' if question.phase == NEWEST else f'phase {question.phase}'
        return [f'the answer of {self._recorder.service!r} about {which}']

    def _take(self, question: Question, answer: Answer) -> None:
        if question is self._question:
            self._answers = [answer]

    def _sent(self, question: Question, answer: Answer) -> Sent:
        if answer.reason:
            raise NodeError(
                f'{self._who} joins a run that has begun, and the recorder does not send phase '
                f'{question.phase}: {answer.reason}'
            )
        return answer.phase, [self._fetched(kind, data) for kind, data in answer.messages]


def go_on(node: Returning) -> Steps:
    """Let a node be as it was, if phases of the run are committed."""
    if node.role == 'sim' and node.settings.on_robot:
        yield from _robot_goes_on(node)
        return
    restore = _RESTORE.get(node.role)
    if restore is None or not _has_begun(node.peers):
        return
    newest, _ = yield Question(NEWEST, (Commit,))
    if newest is None:
        return
    node.log.info(f'the run has begun, phase {newest} is committed: goes on from there')
    node.begin_counting_anew()
    yield from restore(node, newest)


def newest_committed(answered: Callable[[int | None], None]) -> Steps:
    """Hand over the last committed phase; None if none is committed."""
    newest, _ = yield Question(NEWEST, (Commit,))
    answered(newest)


def take_place(node: Returning) -> Steps:
    """Let a simulator that was left out go on where what is recorded of it ends."""
    newest, _ = yield Question(NEWEST, (Commit,))
    assert newest is not None  # a commit has let it in
    node.core.begin_anew()
    yield from _restore_episodes(node, newest)
    node.core.resume(max(newest + 1, node.core.due))
    again = '' if node.core.is_new else ' again'
    node.log.info(f'joins the run{again} with phase {node.core.due}')


def _has_begun(peers: Peers) -> bool:
    """Whether the recorder has published a commit."""
    commits = TOPICS[Commit]
    return any(peer.published.get(commits, 0) for peer in peers.alive('record'))


def _learner(node: Returning, newest: int) -> Steps:
    # the permission for the phase behind `newest` followed from the phase `lag` before it, and a
    # recorder that was killed too may have lost it: it is published once more
    _log_checkpoint(node, node.core.resume(newest + 1 - node.settings.lag))
    node.catch_up(newest)
    yield from ()


def _reward(node: Returning, newest: int) -> Steps:
    # the learner, if it was killed too, may go on from the checkpoint of the phase
    # `newest + 1 - lag`, or if that is damaged from the one before, and needs all labels since
    _log_checkpoint(node, node.core.resume(newest - node.settings.lag - 1))
    node.catch_up(newest)
    yield from ()


def _log_checkpoint(node: Returning, phase: int) -> None:
    node.log.info(
        f'goes on from the checkpoint of phase {phase}'
        if phase >= 0
        else 'there is no checkpoint to go on from: all phases are learnt from again'
    )


def _simulator(node: Returning, newest: int) -> Steps:
    _, (commit,) = yield Question(newest, (Commit,))
    assert isinstance(commit, Commit)
    own = node.settings.sources_of(node.name)
    if set(own) <= set(commit.dropped) - set(commit.sources):
        node.core.wait_for_place(newest + 1)
        return
    yield from _restore_episodes(node, newest)
    node.core.resume(newest + 1)


def _restore_episodes(node: Returning, newest: int) -> Steps:
    phases: list[list[Record]] = []
    own = set(node.settings.sources_of(node.name))
    open_ = set(own)  # sources whose episode under way begins in an earlier phase
    for phase in range(newest, -1, -1):
        _, given = yield Question(phase, (TaskSpec, *_SIMULATED, Commit))
        records = [each for each in undropped(given) if _concerns(each, own)]
        phases.append(records)
        open_ -= {
            record.source
            for record in records
            # nothing was recorded of a source before it announced itself
            if isinstance(record, TaskSpec)
            or (isinstance(record, Transitions) and record.first_step == 0)
        }
        if not open_:
            break
    for record in chain.from_iterable(reversed(phases)):
        if not isinstance(record, TaskSpec):
            node.core.restore(record)


def _concerns(record: Record, sources: Collection[str]) -> bool:
    return isinstance(record, Commit) or getattr(record, 'source', None) in sources


def _robot_goes_on(node: Returning) -> Steps:
    """Let a robot go on behind all that the recorder has of it, also where no phase is
    committed.
    """
    kinds = (Transitions, CompositeReward, Commit)
    records: list[Record] = []
    newest, _ = yield Question(NEWEST, (Commit,))
    if newest is not None:
        records += (yield Question(newest, kinds))[1]
    under_way = 0 if newest is None else newest + 1
    records += (yield Question(under_way, kinds))[1]
    if records:
        node.begin_counting_anew()
        node.core.restore(records)
        node.log.info(f'goes on where a node of this name ended: {node.core.begun()}')


def _evaluator(node: Returning, newest: int) -> Steps:
    settings = node.settings
    versions = [v for v in range(newest + 1) if settings.evaluated(v)]
    results: list[EpisodeResult] = []
    yield from _results([0, *versions], results)
    for result in results:
        node.core.restore(result)
    for version in (INITIAL_VERSION, *versions):
        done = {result.episode for result in results if result.version == version}
        phase = 0 if version == INITIAL_VERSION else version + settings.lag
        if len(done) < settings.evaluate_episodes and phase <= newest:  # others come by themselves
            for policy in (yield Question(phase, (Policy,)))[1]:
                node.core.receive(policy)


def _results(versions: Collection[int], found: list[EpisodeResult]) -> Steps:
    """Put the results of these versions into `found`, each once."""
    seen = set()
    for version in dict.fromkeys(versions):
        for record in (yield Question(version, (EpisodeResult,)))[1]:
            if isinstance(record, EpisodeResult):
                key = record.version, record.episode
                if key not in seen:
                    seen.add(key)
                    found.append(record)


_RESTORE: dict[str, Callable[[Returning, int], Steps]] = {
    'learner': _learner,
    'reward': _reward,
    'sim': _simulator,
    'evaluate': _evaluator,
}
