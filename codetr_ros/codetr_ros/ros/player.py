"""Plays a recorded run to nodes that learn from it, as if it were live.

Every role of the run that is not live is played, under its own node name, since nodes wait for
their peers by role and name: the recorder (whose main loop this is, and who sends a phase again to
whoever lacks it), the simulators, and the learner, reward node and evaluator unless they are there
themselves. What the recorded nodes of live roles said is not played. The messages go out as the
bytes that were recorded; only where a live learner announces a run of its own are they written
anew, under its id.
"""

import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from typing import Any

import rclpy
from rclpy.serialization import serialize_message
from rclpy.signals import SignalHandlerOptions

from codetr_ros.bags.playback import Item, Pace, Playback, Recorded
from codetr_ros.config import Settings
from codetr_ros.records import TOPICS, Commit, EpisodeResult, Metrics, RunSpec
from codetr_ros.records.roles import WRITERS
from codetr_ros.ros import signals
from codetr_ros.ros.errors import NodeError
from codetr_ros.ros.link import Link
from codetr_ros.ros.member import MakeCore
from codetr_ros.ros.node import CoreNode
from codetr_ros.ros.peers import Peer
from codetr_ros.ros.played import Played, PlayedRole
from codetr_ros.ros.resend import Resender
from codetr_ros.ros.signals import Stop

LEARNERS = ('reward', 'learner')
"""Roles that learn from what is played, and that it waits for."""
SAY_EVERY = 5.0  # [s] between two words on how far it is
MUST_AGREE = ('task', 'composite', 'beta', 'delay', 'phase_steps', 'simulators', 'envs')
"""Settings under which the steps were made: a live learner must have the same."""


class PlayNode(Played, CoreNode):
    """The played recorder, and with it everybody else who is played.

    Args:
        recorded: the run.
        found: makes an iterator over its messages.
        live: roles whose nodes are there themselves.
        pace: when messages are due at the earliest; None: at once.
        stop: true once the process is asked to stop.
    """

    def __init__(
        self,
        recorded: Recorded,
        found: Callable[[], Iterator[Item]],
        live: Collection[str],
        pace: Pace | None,
        stop: Stop,
    ) -> None:
        super().__init__('record', 'record', self._load, stop)
        self._recorded = recorded.cut() if live else recorded
        self._found = found
        self._live = live
        self._pace = pace
        self._others: list[PlayedRole] = []
        self._links: dict[tuple[str, str], Link] = {('record', ''): self.link}
        self._said_at = 0.0
        self._done = False
        self.played: Counter[str] = Counter()
        self.left = 0  # messages of roles that are live

    def _load(self) -> MakeCore:
        def make(_: RunSpec, settings: Settings, *_more: object) -> Playback:
            learners = [role for role in LEARNERS if role in self._live]
            phases = settings.phases if self._live else self._recorded.phases
            return Playback(self._found(), phases, settings.lag, learners, self._pace)

        return make

    # ---- joining

    def _join(self) -> bool:
        if 'learner' not in self._live and not self._play('learner', 'learner'):
            return False
        if not super()._join():
            return False
        assert self.settings is not None
        self._check_settings(self.settings)
        if unknown := [role for role in self._live if role not in self.settings.roles]:
            raise NodeError(
                f'the run has no node of role {", ".join(unknown)} (method '
                f'{self.settings.method!r}): there is nobody to play to'
            )
        simulators = dict.fromkeys(map(self._simulator_of, self._recorded.sources))
        wanted = [('sim', name) for name in simulators]
        wanted += [(role, role) for role in ('reward', 'evaluate') if role in self.settings.roles]
        return all(self._play(role, name) for role, name in wanted if role not in self._live)

    def _play(self, role: str, name: str) -> bool:
        other = PlayedRole(role, name, self._recorded, self._live, self.stop)
        self._links[role, name if role == 'sim' else ''] = other.link
        self._others.append(other)
        return other.join()

    def _check_settings(self, settings: Settings) -> None:
        """Refuse a live learner whose run the recorded steps cannot be part of.

        Raises:
            NodeError: names the setting and both values.
        """
        recorded = self._recorded.settings
        for name in MUST_AGREE:
            ours, theirs = recorded.flat()[name], settings.flat()[name]
            if ours != theirs:
                raise NodeError(
                    f'the recorded run has {name} = {ours!r}, the learner {theirs!r}: start the '
                    f'learner with {name}:={ours}'
                )
        last = settings.phases - 1
        if settings.phases > self._recorded.phases or settings.steps_of(last) != recorded.steps_of(
            last
        ):
            raise NodeError(
                f'the learner has steps = {settings.steps}, but {recorded.steps} were recorded in '
                f'phases of {recorded.phase_steps}: start it with steps:={recorded.steps}'
            )
        if 'reward' not in self._live and settings.labels_steps:
            self._check_labels(recorded)

    def _check_labels(self, recorded: Settings) -> None:
        if 'learner' in self._live and recorded.record_relabels == 'first':
            self.log.warning(
                'the bag has the first labels of each segment only (record_relabels = first): the '
                'learner does not learn what it learnt in the run. Play to a reward node too, or '
                'record with record_relabels:=all'
            )

    def open_topics(self, settings: Settings) -> None:
        """Hear who has handled what, and offer to send a phase again."""
        super().open_topics(settings)
        assert self.run_spec is not None
        self._last = Resender(self.link, self.run_spec.run_id, settings.lag + 2)

    def _lacking(self) -> list[str]:
        return super()._lacking() or [text for other in self._others for text in other.lacking()]

    def _turn(self, wait: float = 0.0) -> None:
        super()._turn(wait)
        for other in self._others:
            other.turn()

    # ---- playing

    def deliver(self, item: Any) -> None:
        """Publish a message as the node that published it in the run, unless that is live."""
        link = self._links.get(self._publisher(item.record))
        if link is None:
            self.left += 1
            return
        assert self.run_spec is not None
        topic, data = TOPICS[type(item.record)], item.data
        record = item.record
        if record.run_id != self.run_spec.run_id:
            record = replace(record, run_id=self.run_spec.run_id)
            data = serialize_message(link.message(record))
        if isinstance(record, Commit):
            self._last.commit(record, data)
            self._say(record)
        else:
            self._last.hold(record, data)
        link.send(topic, data)
        self.played[topic] += 1

    def _publisher(self, record: Any) -> tuple[str, str]:
        if isinstance(record, Metrics):
            return record.role, record.node if record.role == 'sim' else ''
        if isinstance(record, EpisodeResult) and record.purpose != 'training':
            return 'evaluate', ''
        (role, *_) = WRITERS[TOPICS[type(record)]]
        if role != 'sim':
            return role, ''
        # a person's score, too, goes out with the simulator whose segment it is
        return 'sim', self._simulator_of(record.source)

    def _simulator_of(self, source: str) -> str:
        return self._recorded.settings.simulator_of(source)

    def _say(self, commit: Commit) -> None:
        now = time.monotonic()
        if now - self._said_at > SAY_EVERY:
            self._said_at = now
            self.log.info(f'phase {commit.phase} is played')

    def _audience(self) -> list[Peer]:
        return [peer for role in self._live for peer in self.peers.alive(role)]

    def _waits(self) -> str:
        """What is waited for.

        Raises:
            NodeError: a live node has stopped.
        """
        doing = super()._waits()
        assert isinstance(self.core, Playback)
        for peer in self._audience():
            if peer.said.finished and not self.core.done(peer.said.role):
                raise NodeError(
                    f'{peer.said.role} {peer.said.node} stopped before everything was played: it '
                    f'{doing}. Look at its log, and play again'
                )
        return doing

    def settled(self, seconds: float) -> bool:
        """Whether everybody who was played to has finished.

        Raises:
            NodeError: somebody has not, and is silent.
        """
        if not self._done:
            self._done = True
            learnt = ' and learnt from' if self._live else ''
            self.log.info(f'everything is played{learnt}')
        left = [peer for peer in self._audience() if not peer.said.finished]
        deadline = self.values['peer_deadline']
        for peer in left:
            silent = time.monotonic() - peer.heard
            if deadline and silent > deadline:
                raise NodeError(
                    f'everything is played, but {peer.said.role} {peer.said.node} has been silent '
                    f'for {silent:.0f} s (--deadline {deadline:g}): look at its log'
                )
        self._doing = f'waits for the end of {", ".join(peer.said.node for peer in left)}'
        return not left

    def say_what_was_played(self) -> None:
        """Print the counts."""
        if not isinstance(self.core, Playback):
            return
        report = self.core.report()
        counts = ', '.join(f'{n} {what}' for what, n in sorted(report.counters.items()))
        print(f'played {report.phases} of {self._recorded.phases} phases: {counts}')
        print(
            'published: ' + ', '.join(f'{n} {topic}' for topic, n in sorted(self.played.items()))
        )
        if self.left:
            print(
                f'{self.left} messages of {" and ".join(self._live)} were left to the live nodes'
            )
        sys.stdout.flush()  # nobody else does if the middleware hangs now

    def _goodbye(self) -> None:
        for other in self._others:
            other.leave()
        super()._goodbye()

    def let_go(self) -> None:
        """Take everybody who is played off the graph."""
        for other in self._others:
            other.link.close()
        super().let_go()


def play(
    recorded: Recorded,
    found: Callable[[], Iterator[Item]],
    live: Collection[str],
    pace: Pace | None,
    namespace: str,
    deadline: float,
) -> int:
    """Play a run to the nodes in a namespace.

    Args:
        recorded: the run.
        found: makes an iterator over its messages.
        live: roles whose nodes are there themselves.
        pace: when messages are due at the earliest; None: at once.
        namespace: where to publish, such as '/play'.
        deadline: seconds to wait for nodes that are missing or silent; 0: for ever.

    Returns:
        Exit code: 0 when all is played and learnt from, or when asked to stop; 1 after an error.
    """
    stop = Stop().install()
    arguments = ['-r', f'__ns:={namespace}', '-p', f'peer_deadline:={deadline}']
    rclpy.init(
        args=['play', '--ros-args', *arguments], signal_handler_options=SignalHandlerOptions.NO
    )
    try:
        node = PlayNode(recorded, found, live, pace, stop)
        code = node.run()
        node.say_what_was_played()
        return code
    finally:
        rclpy.try_shutdown()
        signals.ignore()
