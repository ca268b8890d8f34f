"""Fetches what a node lacks: committed phases from the recorder, labels from the reward node, what
a source simulates from its simulator, permission for a phase from the learner.
"""

import time
from collections.abc import Callable
from typing import Any

from codetr_ros.cores.core import Core
from codetr_ros.nodes.fetching import Fetching, Offered
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
from codetr_ros.ros.fetch import NEWEST, SERVICE, Answer, Asker, service_of
from codetr_ros.ros.link import Link

OF_PHASES = (Transitions, CompositeReward, Preference, Commit)
"""Kinds of records that a commit names, and itself."""

RECORDER = 'the recorder'

TakeAgain = Callable[..., object]
"""Takes the bytes of a message that was fetched again."""


class Fetcher:
    """Asks for what is awaited, and does not come.

    Args:
        link: the node's connection.
        run_id: the run.
        peers: the other nodes.
        take: takes each message that comes, as `Traffic.take_again` does.

    Attributes:
        behind: phases up to this one were committed when the node joined: nothing of them is
            under way any more.
    """

    def __init__(self, link: Link, run_id: str, peers: Peers, take: TakeAgain) -> None:
        self._link = link
        self._log = link.node.get_logger()
        self._run_id = run_id
        self._peers = peers
        self._take = take
        self._recorder = Asker(link, SERVICE, run_id)
        self._askers: dict[str, Asker] = {}  # of other nodes, by the names of their services
        self._phases, self._labels, self._commits = Fetching(), Fetching(), Fetching()
        self._tasks, self._permissions = Fetching(), Fetching()
        self._permitted = Offered()
        self._offered, self._committed = Offered(), Offered()
        self._kinds: tuple[type, ...] = ()  # that the core takes in
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
        return isinstance(record, OF_PHASES)

    def check(self, core: Core[Any]) -> None:
        """Ask for what the core has lacked for a while."""
        now = time.monotonic()
        missing, unlabelled = core.missing, core.unlabelled
        if self._phases.due(missing, now, missing is not None and missing <= self.behind):
            assert missing is not None
            self._kinds, self._fetched = core.subscribes, core.fetched
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

    def _ask_recorder(self, phase: int) -> None:
        if not self._recorder.ready:
            self._log.warning(
                f'phase {phase} is incomplete, and no recorder offers {self._recorder.service!r}'
            )
            return
        if phase > self.behind:
            self._log.warning(f'phase {phase} is incomplete: asking the recorder for it')
        kinds = [type_name(kind) for kind in OF_PHASES if kind in self._kinds]
        self._recorder.ask(phase, lambda answer: self._arrived(RECORDER, phase, answer), kinds)

    def _ask_commit(self, phase: int) -> None:
        """Ask for the commit that is waited for: if it was lost, none may follow that shows it."""
        if self._recorder.ready:
            kinds = [type_name(Commit)]
            self._recorder.ask(phase, lambda answer: self._offered_commit(phase, answer), kinds)

    def _offered_commit(self, phase: int, answer: Answer) -> None:
        if answer.reason or not answer.messages:
            return  # it has not committed the phase yet
        if self._committed.lost(phase, time.monotonic()):
            self._log.warning(f'the commit of phase {phase} was lost: it came again')
            for kind, data in answer.messages:
                self._take(kind, data, lost=True)

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
        for kind, data in answer.messages:
            self._log.warning('what a source has announced had not arrived: it came again')
            self._take(kind, data)

    def _ask_learner(self, phase: int) -> None:
        """Ask for the policy that permits a phase: most often it is still to be learnt."""
        for asker in self._nodes('learner')[:1]:
            kinds = [type_name(Policy)]
            asker.ask(phase, lambda answer: self._offered_policy(phase, answer), kinds)

    def _offered_policy(self, phase: int, answer: Answer) -> None:
        if answer.messages and self._permitted.lost(phase, time.monotonic()):
            self._log.warning(f'permission for phase {phase} had not arrived: it came again')
            for kind, data in answer.messages:
                self._take(kind, data)

    def _nodes(self, role: str) -> list[Asker]:
        """Those that ask the nodes of a role which are there and answer."""
        askers = []
        for peer in self._peers.alive(role):
            service = service_of(peer.presence.node)
            if service not in self._askers:
                self._askers[service] = Asker(self._link, service, self._run_id)
            askers.append(self._askers[service])
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
        if answer.reason:
            return  # it has not labelled the phase yet
        if phase <= self.behind or self._offered.lost(phase, time.monotonic()):
            self._arrived('the reward node', phase, answer)
