"""Waits until nothing is lacking: the run first, then all its nodes, present and matched."""

import time
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Protocol

from codetr_ros.config import Settings
from codetr_ros.nodes.attention import Attention
from codetr_ros.nodes.errors import NodeError
from codetr_ros.nodes.patience import NAME_EVERY
from codetr_ros.records.roles import WRITERS, published_by, readers
from codetr_ros.ros.link import Link
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.signals import Stop

IDLE = 0.05  # [s] to block in the executor when idle: the longest that a signal waits


class Waiter(Protocol):
    """A node that waits: a member of a run, or one that acts without any."""

    stop: Stop
    link: Link
    log: Any
    doing: str
    waits_since: float | None
    deadline_is: str

    @property
    def deadline(self) -> float:
        """Seconds to wait; 0: for ever."""

    def turn(self, wait: float = 0.0) -> None:
        """Give ROS its turn, and block at most `wait` seconds for something to arrive."""


def wait_for(
    member: Waiter, lacks: Callable[[], Sequence[str]], cause: Callable[[], str] = lambda: ''
) -> bool:
    """Wait until nothing is lacking, and log what still is. False if asked to stop meanwhile.

    Args:
        member: the node that waits.
        lacks: returns what is lacking now, in words.
        cause: returns why another node has given up, if that is known, else an empty text.

    Raises:
        NodeError: the same things were lacking for longer than the parameter `peer_deadline`.
    """
    began = named = time.monotonic()
    attention = Attention()
    while not member.stop:
        member.turn(IDLE)
        lacking = lacks()
        if not lacking:
            return True
        now = time.monotonic()
        doing = f'waits for {"; ".join(lacking)}'
        away = attention.was_away(now)
        if (
            away or doing != member.doing
        ):  # a node arrived: the deadline starts anew for the others
            member.doing, member.waits_since = doing, now
            began = named = now
        if member.deadline and now - began > member.deadline:
            raise NodeError(
                f'{member.link.full_name} gave up after {member.deadline:g} s: it {doing}. '
                f'A larger {member.deadline_is} makes it wait longer',
                cause(),
            )
        if now - named >= NAME_EVERY:
            named = now
            member.log.warning(f'{now - began:.0f} s: {doing}')
    return False


def absent_or_unmatched(
    member: Membership, settings: Settings, settings_hash: str, matched: Collection[str]
) -> list[str]:
    """Names the nodes that are absent or, if none is, those not matched yet with our topics.

    Args:
        member: the node that asks.
        settings: the settings of the run.
        settings_hash: the hash that peers with these settings publish.
        matched: roles whose nodes must be matched.
    """
    absent = member.peers.absent(settings, settings_hash)
    if absent:
        return absent

    def names(table: Mapping[str, Sequence[str]]) -> Callable[[str], set[str]]:
        def of(topic: str) -> set[str]:
            wanted = [r for r in table[topic] if r in matched and r in settings.roles]
            peers = [peer for role in wanted for peer in member.peers.alive(role)]
            return {peer.presence.node for peer in peers if not peer.presence.finished}

        return of

    reading = readers(settings.labels_steps)
    reads = [topic for topic, roles in reading.items() if member.role in roles]
    return member.link.unmatched(
        published_by(member.role), names(reading), readers=True
    ) + member.link.unmatched(reads, names(WRITERS), readers=False)
