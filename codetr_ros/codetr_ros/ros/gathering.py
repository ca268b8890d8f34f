"""Waits until nothing is lacking: the run, then everybody whom it needs, there and matched."""

import time
from collections.abc import Callable, Collection, Mapping, Sequence

from codetr_ros.config import Settings
from codetr_ros.records.roles import WRITERS, published_by, readers
from codetr_ros.ros.errors import NodeError
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.patience import NAME_EVERY

IDLE = 0.05  # [s] blocked in the executor while there is nothing to do: the longest a signal waits


def wait_for(member: Membership, lacks: Callable[[], Sequence[str]]) -> bool:
    """Wait until nothing is lacking, logging what is. False if asked to stop meanwhile.

    Args:
        member: who waits.
        lacks: what is lacking now, in words.

    Raises:
        NodeError: the same was lacking for longer than the parameter `peer_deadline`.
    """
    began = named = time.monotonic()
    while not member.stop:
        member.turn(IDLE)
        lacking = lacks()
        if not lacking:
            return True
        now = time.monotonic()
        doing = f'waits for {"; ".join(lacking)}'
        if doing != member.doing:  # somebody has come: the others have their time anew
            member.doing = doing
            began = named = now
        if member.deadline and now - began > member.deadline:
            raise NodeError(
                f'{member.link.full_name} gave up after {member.deadline:g} s: it {doing}. '
                'Parameter peer_deadline makes it wait longer'
            )
        if now - named >= NAME_EVERY:
            named = now
            member.log.warning(f'{now - began:.0f} s: {doing}')
    return False


def absent_or_unmatched(
    member: Membership, settings: Settings, settings_hash: str, matched: Collection[str]
) -> list[str]:
    """Who is not there yet, or else not matched yet with our topics, in words.

    Args:
        member: who asks.
        settings: of the run.
        settings_hash: what peers with the same settings publish.
        matched: roles whose nodes must be matched.
    """
    absent = member.peers.absent(settings, settings_hash)
    if absent:
        return absent

    def names(table: Mapping[str, Sequence[str]]) -> Callable[[str], set[str]]:
        def of(topic: str) -> set[str]:
            wanted = [r for r in table[topic] if r in matched and r in settings.roles]
            return {peer.said.node for role in wanted for peer in member.peers.alive(role)}

        return of

    reading = readers(settings.labels_steps)
    reads = [topic for topic, roles in reading.items() if member.role in roles]
    return member.link.unmatched(
        published_by(member.role), names(reading), readers=True
    ) + member.link.unmatched(reads, names(WRITERS), readers=False)
