"""Who takes part in a run: which roles it needs, who has said `Presence`, who is missing or
silent.

A node begins only when every peer that its topics need is there and matched, by name: a count of
subscriptions cannot tell a recorder from `ros2 topic echo`. From then on nothing is lost
(reliable, deep enough queues), and what peers say they have published tells a node what never
reached it.
"""

from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import dataclass, field

from codetr_ros.config import Settings
from codetr_ros.records import Presence, roles


@dataclass
class Peer:
    """Another node, as its last `Presence` has it."""

    said: Presence
    heard: float  # monotonic time [s] of its last word

    @property
    def published(self) -> dict[str, int]:
        """Records that it says it has published, by topic."""
        return dict(zip(self.said.topics, self.said.published.tolist(), strict=True))


@dataclass
class Peers:
    """The other nodes of the run, by instance (a process that was started again is another
    one).
    """

    role: str
    by_instance: dict[str, Peer] = field(default_factory=dict)

    def hear(self, said: Presence, now: float) -> str | None:
        """Note a peer's presence; returns what is new about it, for the log."""
        known = self.by_instance.get(said.instance_id)
        self.by_instance[said.instance_id] = Peer(said, now)
        if known is None:
            before = [p for p in self.by_instance.values() if p.said.node == said.node]
            again = ' again' if len(before) > 1 else ''
            return f'{said.role} {said.node} is there{again}'
        if said.finished and not known.said.finished:
            return f'{said.role} {said.node} has finished'
        return None

    def newest(self) -> list[Peer]:
        """The newest instance of each node: one that was killed says no last word, and does not
        count once another has taken its place.
        """
        found: dict[str, Peer] = {}
        for peer in self.by_instance.values():
            old = found.get(peer.said.node)
            if old is None or peer.heard >= old.heard:
                found[peer.said.node] = peer
        return list(found.values())

    def alive(self, role: str) -> list[Peer]:
        """Peers of a role, the newest instance of each node."""
        return [peer for peer in self.newest() if peer.said.role == role]

    def absent(self, settings: Settings, settings_hash: str) -> list[str]:
        """Roles of which too few nodes with the run's settings are there, with what would start
        them.
        """
        missing = []
        for role, count in settings.roles.items():
            there = [p for p in self.alive(role) if not p.said.finished]
            ready = [p for p in there if p.said.settings_hash == settings_hash]
            have = len(ready) + (role == self.role)
            if have >= count:
                continue
            of = f' {have + 1} of {count}' if count > 1 else ''
            if starting := [p.said.node for p in there if p not in ready]:
                missing.append(f'{role}{of} ({", ".join(starting)} is there, but not ready yet)')
            else:
                start = roles.command(role)
                missing.append(f'{role}{of} (start it with `{start}` in this namespace)')
        return missing

    def awaited(self, topics: Iterable[str]) -> list[Peer]:
        """Peers that publish on one of these topics."""
        writers = {role for topic in topics for role in roles.WRITERS.get(topic, ())}
        return [peer for role in sorted(writers) for peer in self.alive(role)]

    def anybody_left(self) -> bool:
        """Whether some peer has not finished."""
        return any(not peer.said.finished for peer in self.newest())

    def told(self) -> 'Counter[str]':
        """Records that all peers say they have published, by topic."""
        total: Counter[str] = Counter()
        for peer in self.by_instance.values():
            total.update(peer.published)
        return total


class Ledger:
    """Says what was published but never arrived.

    A `Presence` may overtake the messages it counts, so a record counts as lost only when it has
    not come `patience` seconds after its publisher said that it was published.
    """

    def __init__(self, patience: float = 5.0) -> None:
        self._patience = patience
        self._told: deque[tuple[float, Counter[str]]] = deque()
        self._due: Counter[str] = Counter()

    def tell(self, told: 'Counter[str]', now: float) -> None:
        """Note what peers say they have published by now."""
        if not self._told or self._told[-1][1] != told:
            self._told.append((now, told))

    def lost(self, received: 'Counter[str]', now: float) -> dict[str, int]:
        """Records missing by topic; only topics of which some are."""
        while self._told and self._told[0][0] <= now - self._patience:
            self._due = self._told.popleft()[1]
        return {
            topic: n - received[topic]
            for topic, n in sorted(self._due.items())
            if n > received[topic]
        }
