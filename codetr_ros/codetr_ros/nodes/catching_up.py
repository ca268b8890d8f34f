"""Decides what a node that lacks something asks of whom, and when: committed phases and commits of
the recorder, labels of the reward node, policies of the learner, what a source simulates of its
simulator.
"""

import time
from collections.abc import Callable
from functools import cache
from typing import Any

from codetr_ros.cores.core import Core
from codetr_ros.nodes.asking import NEWEST, SERVICE, Answer, Asks, MakeAsks, service_of
from codetr_ros.nodes.fetching import Fetching, Offered
from codetr_ros.nodes.outbox import Outbox
from codetr_ros.nodes.peers import Peers
from codetr_ros.records import (
    TOPICS,
    Commit,
    CompositeReward,
    Policy,
    Preference,
    Record,
    StepRewards,
    TaskSpec,
    Transitions,
)
from codetr_ros.records.fields import type_name
from codetr_ros.records.roles import WRITERS

OF_PHASES = (Transitions, CompositeReward, Preference, Commit)
"""Kinds of records that a commit names, and itself."""

RECORDER = 'the recorder'
PERMISSION = 'permission for phase {} had not arrived: it came again'

TakeAgain = Callable[..., object]
"""Takes the bytes of a message that was fetched again."""


class Fetcher:
    """Asks for what a core has lacked for a while.

    Args:
        make: makes what asks a node.
        peers: the other nodes.
        take: takes each message that comes, as `Traffic.take_again` does.
        log: the node's logger.
        phases: whether its core takes phases in: the recorder is looked for at once then.
        clock: monotonic time [s].

    Attributes:
        behind: phases up to this one were committed when the node joined: nothing of them is
            under way any more.
    """

    def __init__(
        self,
        make: MakeAsks,
        peers: Peers,
        take: TakeAgain,
        log: Any,
        phases: bool,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._asker = cache(make)  # one for each service
        if phases:
            self._asker(SERVICE)
        self._peers = peers
        self._take = take
        self._log = log
        self._clock = clock
        self._phases, self._labels, self._commits = Fetching(), Fetching(), Fetching()
        self._tasks, self._permissions = Fetching(), Fetching()
        self._offered, self._committed, self._permitted = Offered(), Offered(), Offered()
        self._kinds: tuple[type, ...] = ()  # of them, those that the core takes in
        self._fetched: Callable[[int], None]  # lets the core know that a phase was sent again
        self.behind = -1

    def later(self, record: Record, core: Core[Any]) -> bool:
        """Whether a record is of a phase that is fetched when those before it have been taken in:
        the node has joined late, and could not hold all that comes meanwhile.
        """
        due, permitted = core.due, core.permitted
        if due is None or permitted is None or due > self.behind:
            return False
        if isinstance(record, StepRewards):  # made again now, for one phase after the other
            return record.phase > permitted
        if isinstance(record, Commit) and self.behind < record.phase <= permitted:
            self.behind = record.phase  # it will not come again by itself
            consumer: Any = core
            consumer.catch_up(record.phase)
        return isinstance(record, OF_PHASES)

    def check(self, core: Core[Any]) -> None:
        """Ask for what the core has lacked for a while."""
        now = self._clock()
        missing, unlabelled = core.missing, core.unlabelled
        if missing is not None:
            self._kinds = tuple(kind for kind in OF_PHASES if kind in core.subscribes)
        known = missing is not None and (missing <= self.behind or missing in core.gone_by)
        if self._phases.due(missing, now, known):
            assert missing is not None
            self._fetched = core.fetched
            self._ask_recorder(missing)
        uncommitted = core.uncommitted
        if self._commits.due(uncommitted, now):
            assert uncommitted is not None
            self._ask_commit(uncommitted)
        if self._tasks.due(0 if core.unannounced else None, now):
            self._ask_sources()
        unpermitted = core.unpermitted
        if self._permissions.due(unpermitted, now):
            assert unpermitted is not None
            self._ask_learner(unpermitted)
        behind = unlabelled is not None and unlabelled <= self.behind
        if self._labels.due(unlabelled, now, behind):
            assert unlabelled is not None
            self._ask_reward(unlabelled)

    @property
    def asked_for(self) -> dict[str, float]:
        """Topics of what the core lacks and that is asked for, and since when [s] nobody has
        answered that it is still to come.
        """
        since: dict[str, float] = {}
        for fetching, kinds in (
            (self._phases, self._kinds),
            (self._commits, (Commit,)),
            (self._tasks, (TaskSpec,)),
            (self._permissions, (Policy,)),
            (self._labels, (StepRewards,)),
        ):
            if fetching.since is not None:
                topics = [TOPICS[kind] for kind in kinds]
                since |= {each: max(fetching.since, since.get(each, 0.0)) for each in topics}
        return since

    def runs_away(self, core: Core[Any], outbox: Outbox) -> bool:
        """Whether this node learns phases again, faster than the learner does, and would soon let
        go of labels that the learner lacks.

        Args:
            core: the node's.
            outbox: what the node has published lately.
        """
        due = core.due
        # what is looked at in each turn comes first: most nodes are behind nothing
        return (
            due is not None
            and due <= self.behind
            and outbox.owes
            and any(not peer.presence.finished for peer in self._peers.alive('learner'))
        )

    @property
    def _recorder(self) -> Asks:
        return self._asker(SERVICE)

    def _ask_recorder(self, phase: int) -> None:
        if not self._recorder.ready:
            self._log.warning(
                f'phase {phase} is incomplete, and no recorder offers {self._recorder.service!r}'
            )
            return
        if phase > self.behind:
            self._log.warning(f'phase {phase} is incomplete: asking the recorder for it')
        kinds = [type_name(kind) for kind in self._kinds]
        self._recorder.ask(phase, lambda answer: self._arrived(RECORDER, phase, answer), kinds)

    def _ask_commit(self, phase: int) -> None:
        """Ask for the commit that is waited for: if it was lost, none may follow that shows it."""
        if self._recorder.ready:
            kinds = [type_name(Commit)]
            self._recorder.ask(phase, lambda answer: self._offered_commit(phase, answer), kinds)

    def _offered_commit(self, phase: int, answer: Answer) -> None:
        if answer.nothing:
            self._commits.to_come(self._clock())  # it has not committed the phase yet
            return
        if self._committed.lost(phase, self._clock()):
            said = f'the commit of phase {phase} was lost: it came again'
            self._take_all(answer, said, lost=True)

    def _ask_reward(self, phase: int) -> None:
        for asker in self._nodes('reward')[:1]:
            kinds = [type_name(StepRewards)]
            asker.ask(phase, lambda answer: self._labelled(phase, answer), kinds)

    def _ask_sources(self) -> None:
        """Ask all sources for what they have announced."""
        for role in WRITERS[TOPICS[TaskSpec]]:
            for asker in self._nodes(role):
                asker.ask(NEWEST, self._announced, [type_name(TaskSpec)])

    def _announced(self, answer: Answer) -> None:
        if not answer.messages:
            self._tasks.to_come(self._clock())
        self._take_all(answer, 'what a source has announced had not arrived: it came again')

    def _ask_learner(self, phase: int) -> None:
        """Ask for the policy that is waited for: if it was lost, none may follow that shows it."""
        for asker in self._nodes('learner')[:1]:
            kinds = [type_name(Policy)]
            asker.ask(phase, lambda answer: self._offered_policy(phase, answer), kinds)

    def _offered_policy(self, phase: int, answer: Answer) -> None:
        if answer.nothing:
            self._ask_for_earlier(phase)  # it has not permitted the phase yet, or long ago
        elif self._permitted.lost(phase, self._clock()):
            self._take_all(answer, PERMISSION.format(phase))

    def _ask_for_earlier(self, phase: int) -> None:
        """Ask for a policy that the learner may keep no more."""
        if self._recorder.ready:
            kinds = [type_name(Policy)]
            self._recorder.ask(phase, lambda answer: self._recorded_policy(phase, answer), kinds)
        else:
            self._permissions.to_come(self._clock())

    def _recorded_policy(self, phase: int, answer: Answer) -> None:
        if answer.nothing:
            self._permissions.to_come(self._clock())
        else:
            self._take_all(answer, PERMISSION.format(phase))  # it was published long ago

    def _take_all(self, answer: Answer, said: str, **how: bool) -> None:
        for kind, data in answer.messages:
            self._log.warning(said)
            self._take(kind, data, **how)

    def _nodes(self, role: str) -> list[Asks]:
        """Those that ask the nodes of a role which are there and answer."""
        peers = self._peers.alive(role)
        askers = [self._asker(service_of(peer.presence.node)) for peer in peers]
        return [asker for asker in askers if asker.ready]

    def _arrived(self, who: str, phase: int, answer: Answer) -> None:
        if answer.reason:
            self._log.error(f'{who} does not send phase {phase} again: {answer.reason}')
            return
        for kind, data in answer.messages:
            self._take(kind, data)
        # what the recorder has not committed yet, it has in part, and nothing follows from it
        if who == RECORDER and any(kind is Commit for kind, _ in answer.messages):
            self._fetched(phase)
        if phase > self.behind or phase % 100 == 0:
            self._log.info(f'phase {phase}: {len(answer.messages)} messages came again')

    def _labelled(self, phase: int, answer: Answer) -> None:
        if answer.nothing:
            self._labels.to_come(self._clock())  # it has not labelled the phase yet
            return
        if phase <= self.behind or self._offered.lost(phase, self._clock()):
            self._arrived('the reward node', phase, answer)
