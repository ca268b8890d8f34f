"""When waiting is pointless: the awaited records are lost, their publisher is gone, or everybody
waits.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from codetr_ros.nodes.errors import NodeError
from codetr_ros.nodes.peers import Peer, Peers
from codetr_ros.records.roles import TABLE

NAME_EVERY = 5.0  # [s] between two warnings about the same peers
GRACE = 10.0  # [s] for records that a peer published before it finished


class Warns(Protocol):
    """A logger, of ROS or of Python."""

    def warning(self, message: str) -> object:
        """Log a warning."""


@dataclass(frozen=True)
class Limit:
    """How long a node waits for others.

    Attributes:
        seconds: the deadline; 0: for ever.
        setting: what the user sets it with, for errors.
        again: what the user does once the obstacle is gone, for errors.
    """

    seconds: float
    setting: str = 'parameter peer_deadline (of `codetr train`: --peer-deadline)'
    again: str = 'start the run again'


class InVain:
    """Which lost records a node has asked for in vain for too long.

    A count of lost records does not state which they are. What a node does not need, or not yet,
    it does not ask for: a policy that is not to be evaluated, or steps that no commit names. That
    keeps nobody from going on. And what was lost only now is still to be sent again.
    """

    def __init__(self) -> None:
        self._lost: dict[str, tuple[int, float]] = {}  # counts, and since when no record came [s]

    def beyond(
        self, seconds: float, lost: Mapping[str, int], asked_for: Mapping[str, float], now: float
    ) -> dict[str, int]:
        """Those of the lost records, as counts by topic, that nobody has sent for so many seconds.

        Args:
            seconds: for how long.
            lost: counts of all lost records, by topic.
            asked_for: topics of what is asked for, and since when [s].
            now: monotonic time [s].
        """
        before, self._lost = self._lost, {}
        for topic, count in lost.items():
            known, since = before.get(topic, (count, now))
            self._lost[topic] = count, now if count < known else since
        return {
            topic: count
            for topic, (count, since) in self._lost.items()
            if topic in asked_for and now - max(since, asked_for[topic]) > seconds
        }


class Patience:
    """Watches over a node that waits during the run.

    Args:
        who: the node's full name.
        peers: the other nodes.
        topics: those on which the awaited records arrive.
        limit: how long it waits.
        log: logs warnings.
        outside: whether a node of the run may wait for what no other node brings: a robot for a
            person, for example. Then nobody can know that everybody waits in vain.
        left_out: whether nobody waits for a node, because it was left out of the run.
    """

    def __init__(
        self,
        who: str,
        peers: Peers,
        topics: Sequence[str],
        limit: Limit,
        log: Warns,
        outside: bool = False,
        left_out: Callable[[Peer], bool] = lambda peer: False,
    ) -> None:
        self._who = who
        self._peers = peers
        self._topics = topics
        self._deadline = limit.seconds
        self._limit = f'{limit.setting}: {limit.seconds:g} s'
        self._again = limit.again
        self._log = log
        self._outside = outside
        self._left_out = left_out
        self._named: dict[str, float] = {}
        self._in_vain = InVain()

    def check(
        self,
        now: float,
        waiting: float,
        doing: str,
        lost: Mapping[str, int],
        asked_for: Mapping[str, float],
    ) -> None:
        """Log which peers are silent, and give up on records that will not arrive.

        Args:
            now: monotonic time [s].
            waiting: seconds for which the node has waited.
            doing: what it waits for, in words.
            lost: counts of records by topic that were published and never arrived, not even when
                fetched again.
            asked_for: topics of what the node lacks and asks for, and since when nobody has
                answered that it is still to come [s, monotonic].

        Raises:
            NodeError: an awaited peer is gone, awaited records are lost, or everybody waits.
        """
        in_vain = self._in_vain.beyond(self._deadline, lost, asked_for, now)
        self._check_silent(now, waiting, doing)
        self._check_finished(now, waiting, doing)
        if not self._deadline or waiting <= self._deadline:
            return
        working = [peer for peer in self._others(now) if not peer.presence.waiting]
        if self._outside or working or not self._peers.by_instance:
            if in_vain:
                raise NodeError(
                    f'{self._who} gave up after {waiting:.0f} s: it {doing}, and '
                    f'{_never(in_vain)} ({self._limit}). Look for an overloaded machine or '
                    f'network, and {self._again}'
                )
            return
        never = f', {_never(lost)}' if lost else ''
        self._check_endless(now, f'{waiting:.0f} s: it {doing}{never}')

    def _others(self, now: float) -> list[Peer]:
        """The nodes that have not ended and are not silent."""
        return [
            peer
            for peer in self._peers.newest()
            if not peer.presence.finished and now - peer.received_at <= self._deadline
        ]

    def _because(self, text: str, cause: str) -> NodeError:
        """An error that names the first cause, if another node has one."""
        if not cause:
            return NodeError(text)
        return NodeError(f'{text}. What came first: {cause}', cause)

    def _check_endless(self, now: float, mine: str) -> None:
        """Give up once all others have waited as long, and nobody has done his part within that
        time: nothing is under way.
        """
        others = self._others(now)
        if now - self._peers.last_end() <= self._deadline:
            return  # what he has published last may have been lost, and is asked for
        if any(peer.presence.waiting <= self._deadline for peer in others):
            return
        waits = [
            f'{peer.who} {peer.presence.doing} ({peer.presence.waiting:.0f} s)' for peer in others
        ]
        cause = self._peers.cause()
        who = '; '.join(waits) or 'all others have ended or are silent'
        raise self._because(
            f'{self._who} gave up after {mine}; nobody is left who could end that'
            f'{"" if cause else f": {who}"} ({self._limit}). '
            f'Look for the node that lacks what another has published, and {self._again}',
            cause,
        )

    def _check_silent(self, now: float, waiting: float, doing: str) -> None:
        for peer in self._peers.awaited(self._topics):
            silent = now - peer.received_at
            if peer.presence.finished or silent < 2 * NAME_EVERY or self._left_out(peer):
                continue
            who = peer.who
            if self._deadline and silent > self._deadline and waiting > self._deadline:
                raise self._because(
                    f'{self._who} gave up: it {doing}, and {who} has been silent for '
                    f'{silent:.0f} s ({self._limit}). Look at its log, and {self._again}',
                    self._peers.cause(),
                )
            if now - self._named.get(who, 0.0) > NAME_EVERY:
                self._named[who] = now
                self._log.warning(f'{who} has been silent for {silent:.0f} s; {doing}')

    def _check_finished(self, now: float, waiting: float, doing: str) -> None:
        for role in TABLE[self._peers.role].relies_on:
            there = [peer for peer in self._peers.alive(role) if not self._left_out(peer)]
            gone = [peer for peer in there if peer.presence.finished]
            all_gone = gone and len(gone) == len(there)
            patience = GRACE if all_gone else max(GRACE, self._deadline)
            settled = all(now - peer.received_at > GRACE for peer in gone)
            if gone and waiting > patience and settled:
                names = ', '.join(peer.presence.node for peer in gone)
                causes = [peer.cause for peer in gone if peer.cause]
                raise self._because(
                    f'{self._who} gave up: it {doing}, but {role} {names} stopped before the run '
                    f'was over. Look at its log, and {self._again}',
                    causes[0] if causes else self._peers.cause(),
                )


def _never(lost: Mapping[str, int]) -> str:
    """What never arrived, in words."""
    lacking = ', '.join(f'{n} of {topic!r}' for topic, n in sorted(lost.items()))
    return f'messages that were published never reached it: {lacking}'
