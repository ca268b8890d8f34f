"""Plays a recorded run to nodes that learn from it, as if it were live.

Every role of the run that is not live is played, under its own node name, since nodes wait for
their peers by role and name. The recorder is always played: this is its main loop, and it sends a
phase again to a node that lacks it. So are the simulators, and the learner, reward node and
evaluator where they are not live. Messages of the recorded nodes of live roles are not played. The
records go out in messages of the played nodes, signed if the environment has the key of a run. If
a live learner announces a run of its own, they go out under its id.
"""

import sys
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from dataclasses import replace
from typing import Any, cast

import rclpy
from rclpy.signals import SignalHandlerOptions

from codetr_ros.bags.playback import Item, Pace, Playback, RecordedRun
from codetr_ros.bags.played_commits import PlayedCommits
from codetr_ros.config import Settings
from codetr_ros.nodes.errors import NodeError
from codetr_ros.nodes.peers import Peer
from codetr_ros.records import TOPICS, Commit, EpisodeResult, Metrics, RunSpec
from codetr_ros.records.roles import WRITERS
from codetr_ros.ros import signals
from codetr_ros.ros.joining import Joined, join
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.node import Node
from codetr_ros.ros.played import Cast, PlayedWiring
from codetr_ros.ros.resend import Resender
from codetr_ros.ros.signals import Stop

LEARNERS = ('reward', 'learner')
"""Roles that learn from what is played; playing waits for them."""
LOG_EVERY = 5.0  # [s] between two log lines about progress
MUST_AGREE = (
    *('task', 'composite', 'beta', 'delay', 'score_missing', 'score_noise', 'score_levels'),
    *('phase_steps', 'simulators', 'envs'),
)
"""Settings that made the steps: a live learner must have the same."""


def check_settings(recorded: RecordedRun, settings: Settings) -> None:
    """Refuse a live learner if the recorded steps do not fit its run.

    Args:
        recorded: the recorded run.
        settings: the settings of the learner's run.

    Raises:
        NodeError: names the setting and both values.
    """
    theirs, ours = settings.flat(), recorded.settings.flat()
    for name in MUST_AGREE:
        if ours[name] != theirs[name]:
            raise NodeError(
                f'the recorded run has {name} = {ours[name]!r}, the learner {theirs[name]!r}: '
                f'start the learner with {name}:={ours[name]}'
            )
    last = settings.phases - 1
    longer = settings.phases > recorded.phases
    if longer or settings.steps_of(last) != recorded.settings.steps_of(last):
        steps = recorded.settings.steps
        raise NodeError(
            f'the learner has steps = {settings.steps}, but {steps} were recorded in phases of '
            f'{recorded.settings.phase_steps}: start it with steps:={steps}'
        )


class Playing(PlayedWiring):
    """The wiring of the played recorder, and through it of all other played nodes.

    Args:
        member: the played recorder's membership.
        joined: the run that it has joined.
        recorded: the run that is played.
        live: roles whose real nodes take part.
        others: all other played nodes.
    """

    def __init__(
        self,
        member: Membership,
        joined: Joined,
        recorded: RecordedRun,
        live: Collection[str],
        others: Cast,
    ) -> None:
        super().__init__(member, joined, live)
        self._recorded = recorded
        self._cast = others
        self._playback = cast(Playback, joined.core)  # as `Player` made it
        self._logged_at = 0.0
        self._done = False
        self.played: Counter[str] = Counter()
        self.left = 0  # messages of roles that are live

    def open(self) -> None:
        """Subscribe to what nodes report, and offer to send a phase again."""
        super().open()
        settings = self.joined.settings
        self._last = Resender(self.member.link, self.joined.run.run_id, settings.ahead + 2)

    # ---- joining

    def complete(self) -> bool:
        """Let all played nodes join, if the recorded run can be played to the live nodes.

        Raises:
            NodeError: the run of the live nodes differs from it, or has no such nodes.
        """
        settings = self.joined.settings
        if 'learner' in self._live:  # whoever else is live takes the recorded settings
            check_settings(self._recorded, settings)
        self._check_labels(settings)
        if unknown := [role for role in self._live if role not in settings.roles]:
            raise NodeError(
                f'the run has no node of role {", ".join(unknown)} (method '
                f'{settings.method!r}): there is nobody to play to'
            )
        simulators = dict.fromkeys(map(self._simulator_of, self._recorded.sources))
        wanted = [('sim', name) for name in simulators]
        wanted += [(role, role) for role in ('reward', 'evaluate') if role in settings.roles]
        return all(self._cast.play(role, name) for role, name in wanted)

    def _check_labels(self, settings: Settings) -> None:
        recorded = self._recorded.settings
        played = 'reward' not in self._live and settings.labels_steps
        if played and 'learner' in self._live and recorded.record_relabels == 'first':
            self.log.warning(
                'the bag has the first labels of each segment only (record_relabels = first): the '
                'learner does not learn what it learnt in the run. Play to a reward node too, or '
                'record with record_relabels:=all'
            )

    def lacking(self) -> list[str]:
        """The nodes that are absent or not matched with a played node yet, in words."""
        return super().lacking() or self._cast.lacking()

    # ---- playing

    def deliver(self, given: Item) -> None:
        """Publish a message as the node that published it in the run, unless that node is live."""
        record: Any = given.record
        link = self._cast.link(*self._publisher(record))
        if link is None:
            self.left += 1
            return
        topic = TOPICS[type(record)]
        if record.run_id != self.joined.run.run_id:
            record = replace(record, run_id=self.joined.run.run_id)
        data = link.message(record)  # from the played node, and signed as it signs
        if isinstance(record, Commit):
            self._last.commit(record, data)
            self._log_phase(record)
        else:
            self._last.hold(record, data)
        link.send(topic, data)
        self.played[topic] += 1

    def _publisher(self, record: Any) -> tuple[str, str]:
        """Role of the node that published a record, and its name if it is a simulator."""
        if isinstance(record, Metrics):
            return record.role, record.node if record.role == 'sim' else ''
        if isinstance(record, EpisodeResult) and record.purpose != 'training':
            return 'evaluate', ''
        (role, *_) = WRITERS[TOPICS[type(record)]]
        if role != 'sim':
            return role, ''
        # a person's score, too, goes out through the simulator of its segment
        return 'sim', self._simulator_of(record.source)

    def _simulator_of(self, source: str) -> str:
        return self._recorded.settings.simulator_of(source)

    def _log_phase(self, commit: Commit) -> None:
        now = time.monotonic()
        if now - self._logged_at > LOG_EVERY:
            self._logged_at = now
            self.log.info(f'phase {commit.phase} is played')

    def _audience(self) -> list[Peer]:
        return [peer for role in self._live for peer in self.member.peers.alive(role)]

    def waits(self) -> str:
        """What the player waits for, in words.

        Raises:
            NodeError: a live node has stopped.
        """
        doing = super().waits()
        for peer in self._audience():
            presence = peer.presence
            if presence.finished and not self._playback.done(presence.role):
                raise NodeError(
                    f'{presence.role} {presence.node} stopped before everything was played: it '
                    f'{doing}. Look at its log, and play again'
                )
        return doing

    def settled(self, seconds: float) -> bool:
        """Whether all live nodes have finished.

        Raises:
            NodeError: one of them has not, and is silent.
        """
        if not self._done:
            self._done = True
            learnt = ' and learnt from' if self._live else ''
            self.log.info(f'everything is played{learnt}')
        left = [peer for peer in self._audience() if not peer.presence.finished]
        deadline = self.member.deadline
        for peer in left:
            silent = time.monotonic() - peer.received_at
            if deadline and silent > deadline:
                raise NodeError(
                    f'everything is played, but {peer.presence.role} {peer.presence.node} has '
                    f'been silent for {silent:.0f} s (--deadline {deadline:g}): look at its log'
                )
        names = ', '.join(peer.presence.node for peer in left)
        self.member.doing = f'waits for the end of {names}'
        return not left

    def print_counts(self) -> None:
        """Print what was played."""
        report = self._playback.report()
        counts = ', '.join(f'{n} {what}' for what, n in sorted(report.counters.items()))
        print(f'played {report.phases} of {self._recorded.phases} phases: {counts}')
        print(
            'published: ' + ', '.join(f'{n} {topic}' for topic, n in sorted(self.played.items()))
        )
        if self.left:
            print(
                f'{self.left} messages of {" and ".join(self._live)} were left to the live nodes'
            )
        sys.stdout.flush()  # if the middleware hangs now, nothing else flushes it


class Player:
    """The node that plays a run: the played recorder, with all other played nodes.

    Args:
        recorded: the run.
        items: makes an iterator over its messages.
        live: roles whose real nodes take part.
        pace: when messages are due at the earliest; None: at once.
        stop: true once the process is asked to stop.
    """

    def __init__(
        self,
        recorded: RecordedRun,
        items: Callable[[], Iterator[Item]],
        live: Collection[str],
        pace: Pace | None,
        stop: Stop,
    ) -> None:
        self._recorded = recorded.cut() if live else recorded
        self._items = items
        self._live = live
        self._pace = pace
        self._playing: Playing | None = None
        self._member = Membership('record', 'record', stop)
        self._member.deadline_is, self._member.again = '--deadline', 'play again'
        self._cast = Cast(self._member, self._recorded, live)

    def run(self) -> int:
        """Play everything and print what was played; returns the exit code of the process."""
        code = Node(self._member, self._join, self._wire).run()
        if self._playing is not None:
            self._playing.print_counts()
        return code

    def _join(self, member: Membership) -> Joined | None:
        if not self._cast.play('learner', 'learner'):
            return None
        return join(member, lambda: self._make)

    def _make(self, run: RunSpec, settings: Settings, *_more: object) -> Playback:
        learners = [role for role in LEARNERS if role in self._live]
        phases = settings.phases if self._live else self._recorded.phases
        recorded = self._recorded.settings
        lag = None if recorded.free else recorded.lag
        commits = PlayedCommits(run.run_id, settings, lag, self._live)
        return Playback(self._items(), phases, settings.ahead, learners, self._pace, commits)

    def _wire(self, member: Membership, joined: Joined) -> Playing:
        self._playing = Playing(member, joined, self._recorded, self._live, self._cast)
        return self._playing


def play(
    recorded: RecordedRun,
    items: Callable[[], Iterator[Item]],
    live: Collection[str],
    pace: Pace | None,
    namespace: str,
    deadline: float,
) -> int:
    """Play a run to the nodes in a namespace.

    Args:
        recorded: the run.
        items: makes an iterator over its messages.
        live: roles whose real nodes take part.
        pace: when messages are due at the earliest; None: at once.
        namespace: where to publish, such as '/play'.
        deadline: seconds to wait for nodes that are missing or silent; 0: for ever.

    Returns:
        Exit code: 0 after everything is played and learnt from, or if asked to stop; 1 after an
        error.
    """
    stop = Stop().install()
    arguments = ['-r', f'__ns:={namespace}', '-p', f'peer_deadline:={deadline}']
    rclpy.init(
        args=['play', '--ros-args', *arguments], signal_handler_options=SignalHandlerOptions.NO
    )
    try:
        return Player(recorded, items, live, pace, stop).run()
    finally:
        rclpy.try_shutdown()
        signals.ignore()
