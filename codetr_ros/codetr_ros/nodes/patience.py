"""When waiting is pointless: the awaited records are lost, or their publisher is gone."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from codetr_ros.nodes.errors import NodeError
from codetr_ros.nodes.peers import Peers
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


class Patience:
    """Watches over a node that waits during the run.

    Args:
        who: the node's full name.
        peers: the other nodes.
        topics: those on which the awaited records arrive.
        limit: how long it waits.
        log: logs warnings.
    """

    def __init__(
        self, who: str, peers: Peers, topics: Sequence[str], limit: Limit, log: Warns
    ) -> None:
        self._who = who
        self._peers = peers
        self._topics = topics
        self._deadline = limit.seconds
        self._limit = f'{limit.setting}: {limit.seconds:g} s'
        self._again = limit.again
        self._log = log
        self._named: dict[str, float] = {}

    def check(self, now: float, waiting: float, doing: str, lost: Mapping[str, int]) -> None:
        """Log which peers are silent, and give up on records that will not arrive.

        Args:
            now: monotonic time [s].
            waiting: seconds for which the node has waited.
            doing: what it waits for, in words.
            lost: counts of records by topic that were published and never arrived, not even when
                fetched again.

        Raises:
            NodeError: an awaited peer is gone, or awaited records are lost.
        """
        self._check_silent(now, waiting, doing)
        self._check_finished(now, waiting, doing)
        if lost and self._deadline and waiting > self._deadline:
            lacking = ', '.join(f'{n} of {topic!r}' for topic, n in sorted(lost.items()))
            raise NodeError(
                f'{self._who} gave up after {waiting:.0f} s: it {doing}, and messages that were '
                f'published never reached it: {lacking} ({self._limit}). Look for an overloaded '
                f'machine or network, and {self._again}'
            )

    def _check_silent(self, now: float, waiting: float, doing: str) -> None:
        for peer in self._peers.awaited(self._topics):
            silent = now - peer.received_at
            if peer.presence.finished or silent < 2 * NAME_EVERY:
                continue
            who = f'{peer.presence.role} {peer.presence.node}'
            if self._deadline and silent > self._deadline and waiting > self._deadline:
                raise NodeError(
                    f'{self._who} gave up: it {doing}, and {who} has been silent for '
                    f'{silent:.0f} s ({self._limit}). Look at its log, and {self._again}'
                )
            if now - self._named.get(who, 0.0) > NAME_EVERY:
                self._named[who] = now
                self._log.warning(f'{who} has been silent for {silent:.0f} s; {doing}')

    def _check_finished(self, now: float, waiting: float, doing: str) -> None:
        for role in TABLE[self._peers.role].relies_on:
            gone = [peer for peer in self._peers.alive(role) if peer.presence.finished]
            all_gone = gone and len(gone) == len(self._peers.alive(role))
            patience = GRACE if all_gone else max(GRACE, self._deadline)
            settled = all(now - peer.received_at > GRACE for peer in gone)
            if gone and waiting > patience and settled:
                names = ', '.join(peer.presence.node for peer in gone)
                raise NodeError(
                    f'{self._who} gave up: it {doing}, but {role} {names} stopped before the run '
                    f'was over. Look at its log, and {self._again}'
                )
