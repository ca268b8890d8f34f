"""A node that joins a run which has begun without it, or that was killed in it, goes on where the
run stands.

The recorder has every committed phase. It is asked for what a node needs to be as it was: a
simulator for its open episodes, the evaluator for its results, learner and reward node (once they
work) for the phases that fill their memory.
"""

from collections.abc import Callable, Iterator
from itertools import chain
from typing import Any

from codetr_ros.nodes.errors import NodeError
from codetr_ros.records import (
    INITIAL_VERSION,
    TOPICS,
    Commit,
    CompositeReward,
    EpisodeResult,
    Policy,
    Record,
    Transitions,
    TrueRewards,
)
from codetr_ros.records.dropped import undropped
from codetr_ros.records.fields import type_name
from codetr_ros.ros.fetch import NEWEST, SERVICE, Answer, Asker
from codetr_ros.ros.gathering import wait_for
from codetr_ros.ros.joining import Joined
from codetr_ros.ros.membership import Membership


class _StoppedError(Exception):
    """The process was asked to stop while it waited for an answer."""


class _Recorder:
    """The recorder, as a node asks it."""

    def __init__(self, member: Membership, run_id: str) -> None:
        self._member = member
        self._asker = Asker(member.link, SERVICE, run_id)

    def ask(self, phase: int, *kinds: type) -> tuple[int | None, list[Record]]:
        """Which phase was sent, None if none is committed, and its records of these kinds.

        Raises:
            NodeError: the recorder refuses to send it, or does not answer.
            RecordError: a message cannot be decoded, is out of bounds or not signed.
        """
        answers: list[Answer] = []
        names = [type_name(kind) for kind in kinds]

        def lacking() -> list[str]:
            if not answers and self._asker.ready and not self._asker.busy:
                self._asker.ask(phase, answers.append, names)
            return [] if answers else [f'the answer of {self._asker.service!r}']

        lacking()
        if not wait_for(self._member, lacking, self._member.peers.cause):
            raise _StoppedError
        answer = answers[0]
        if answer.reason:
            raise NodeError(
                f'{self._member.link.full_name} joins a run that has begun, and the recorder does '
                f'not send phase {phase}: {answer.reason}'
            )
        fetched = self._member.traffic.fetched
        return answer.phase, [fetched(kind, data) for kind, data in answer.messages]


def go_on(member: Membership, joined: Joined) -> bool:
    """Let a node that has joined be as it was, if phases of the run are committed.

    Args:
        member: the node; all others are present.
        joined: its part of the run, which has not worked yet.

    Returns:
        False if asked to stop meanwhile.

    Raises:
        NodeError: the recorder does not send what is needed.
        CheckpointError: a checkpoint is of another run.
    """
    if member.role == 'sim' and joined.settings.on_robot:
        return _robot_goes_on(member, joined)
    restore = _RESTORE.get(member.role)
    if restore is None or not _has_begun(member):
        return True
    recorder = _Recorder(member, joined.run.run_id)
    try:
        newest, _ = recorder.ask(NEWEST, Commit)
        if newest is None:
            return True
        member.log.info(f'the run has begun, phase {newest} is committed: goes on from there')
        member.begin_counting_anew()
        restore(member, joined, newest, recorder)
    except _StoppedError:
        return False
    return True


def newest_committed(
    member: Membership, joined: Joined, answered: Callable[[int | None], None]
) -> None:
    """Ask the recorder for the last committed phase, and hand it over unless asked to stop.

    Args:
        member: the node that asks.
        joined: its part of the run.
        answered: takes the phase; None if none is committed.

    Raises:
        NodeError: the recorder does not answer.
    """
    try:
        newest, _ = _Recorder(member, joined.run.run_id).ask(NEWEST, Commit)
    except _StoppedError:
        return
    answered(newest)


def take_place(member: Membership, joined: Joined) -> bool:
    """Let a simulator that was left out go on where what is recorded of it ends.

    Returns:
        False if asked to stop meanwhile.

    Raises:
        NodeError: the recorder does not send what is needed.
        TaskError: an environment is at fault.
    """
    core: Any = joined.core
    recorder = _Recorder(member, joined.run.run_id)
    try:
        newest, _ = recorder.ask(NEWEST, Commit)
        assert newest is not None  # a commit has let it in
        core.begin_anew()
        _restore_episodes(member, joined, newest, recorder)
    except _StoppedError:
        return False
    core.resume(max(newest + 1, core.due))
    member.log.info(f'joins the run again with phase {core.due}')
    return True


def _has_begun(member: Membership) -> bool:
    """Whether the recorder has published a commit."""
    commits = TOPICS[Commit]
    return any(peer.published.get(commits, 0) for peer in member.peers.alive('record'))


def _learner(member: Membership, joined: Joined, newest: int, _: _Recorder) -> None:
    core: Any = joined.core
    phase = core.resume(newest)  # a bag that was restored from a copy may end earlier
    member.log.info(f'goes on from the checkpoint of phase {phase}' if phase >= 0 else _ANEW)
    member.catch_up(newest)


def _reward(member: Membership, joined: Joined, newest: int, _: _Recorder) -> None:
    core: Any = joined.core
    # the learner, if it was killed too, goes on from the checkpoint before the phase that it was
    # to learn from, or if that is damaged from the one before, and needs all labels since
    phase = core.resume(newest - joined.settings.lag - 1)
    member.log.info(f'goes on from the checkpoint of phase {phase}' if phase >= 0 else _ANEW)
    member.catch_up(newest)


def _simulator(member: Membership, joined: Joined, newest: int, recorder: _Recorder) -> None:
    core: Any = joined.core
    _restore_episodes(member, joined, newest, recorder)
    core.resume(newest + 1)


def _restore_episodes(
    member: Membership, joined: Joined, newest: int, recorder: _Recorder
) -> None:
    core: Any = joined.core
    sources = set(joined.settings.sources_of(member.link.name))
    phases: list[list[Record]] = []
    open_ = set(sources)  # whose episode under way begins in an earlier phase
    for phase in range(newest, -1, -1):
        _, given = recorder.ask(phase, Transitions, TrueRewards, CompositeReward, Commit)
        records = list(undropped(given))
        phases.append(records)
        open_ -= {
            record.source
            for record in records
            if isinstance(record, Transitions) and record.first_step == 0
        }
        if not open_:
            break
    for record in chain.from_iterable(reversed(phases)):
        core.restore(record)


def _robot_goes_on(member: Membership, joined: Joined) -> bool:
    """Let a robot go on behind all that the recorder has of it, also where no phase is committed;
    false if asked to stop meanwhile.
    """
    core: Any = joined.core
    recorder = _Recorder(member, joined.run.run_id)
    kinds = (Transitions, CompositeReward, Commit)
    records: list[Record] = []
    try:
        newest, _ = recorder.ask(NEWEST, Commit)
        if newest is not None:
            records += recorder.ask(newest, *kinds)[1]
        under_way = 0 if newest is None else newest + 1
        records += recorder.ask(under_way, *kinds)[1]
    except _StoppedError:
        return False
    if records:
        member.begin_counting_anew()
        core.restore(records)
        member.log.info(f'goes on where a node of this name ended: {core.begun()}')
    return True


def _evaluator(_: Membership, joined: Joined, newest: int, recorder: _Recorder) -> None:
    core: Any = joined.core
    settings = joined.settings
    versions = [v for v in range(newest + 1) if settings.evaluated(v)]
    results = list(_results(recorder, [0, *versions]))
    for result in results:
        core.restore(result)
    for version in (INITIAL_VERSION, *versions):
        done = {result.episode for result in results if result.version == version}
        phase = 0 if version == INITIAL_VERSION else version + settings.lag
        if len(done) < settings.evaluate_episodes and phase <= newest:  # others come by themselves
            for policy in recorder.ask(phase, Policy)[1]:
                core.receive(policy)


def _results(recorder: _Recorder, versions: list[int]) -> Iterator[EpisodeResult]:
    seen = set()
    for version in dict.fromkeys(versions):
        for record in recorder.ask(version, EpisodeResult)[1]:
            if isinstance(record, EpisodeResult):
                key = record.version, record.episode
                if key not in seen:
                    seen.add(key)
                    yield record


_ANEW = 'there is no checkpoint to go on from: all phases are learnt from again'
_Restore = Callable[[Membership, Joined, int, _Recorder], None]
_RESTORE: dict[str, _Restore] = {
    'learner': _learner,
    'reward': _reward,
    'sim': _simulator,
    'evaluate': _evaluator,
}
