"""The nodes of a run: which roles it needs, which nodes are present, which are missing or silent.

A node begins only when every peer that its topics need is present and matched by name: a count of
subscriptions cannot distinguish a recorder from `ros2 topic echo`. From then on nothing is lost
(reliable, deep enough queues). The counts that peers publish show a node what never reached it.
"""

from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field

from codetr_ros.config import Settings
from codetr_ros.records import Presence, roles
from codetr_ros.records.roles import TABLE
from codetr_ros.system.liveness import has_ended

GAVE_UP = 'has given up: '
"""Begins what a node does, in its last presence, if it has given up; its first cause follows."""


@dataclass
class Peer:
    """Another node, as its last `Presence` describes it."""

    presence: Presence
    received_at: float  # monotonic time [s] when the presence arrived
    served: bool = False  # whether it has ever taken part in the run
    ended_at: float | None = None  # monotonic time [s] since which it is known to have finished

    @property
    def published(self) -> dict[str, int]:
        """Counts of the records that it has published, by topic."""
        presence = self.presence
        return dict(zip(presence.topics, presence.published.tolist(), strict=True))

    @property
    def who(self) -> str:
        """Its role and name."""
        return f'{self.presence.role} {self.presence.node}'

    @property
    def cause(self) -> str:
        """The first cause for which it has given up, as far as it is known; else empty."""
        presence = self.presence
        if not presence.finished or not presence.doing.startswith(GAVE_UP):
            return ''
        return presence.doing.removeprefix(GAVE_UP)

    @property
    def name(self) -> str:
        """Its name within the run."""
        return self.presence.node.rpartition('/')[2]

    @property
    def dispensable(self) -> bool:
        """Whether the run goes on without it, and ends well."""
        return TABLE[self.presence.role].dispensable

    def left_out(self, settings: Settings, sources: Collection[str]) -> bool:
        """Whether it simulates only sources that are left out of the run: nobody waits for it.

        Args:
            settings: of the run.
            sources: those that are left out.
        """
        if self.presence.role != 'sim':
            return False
        return set(settings.sources_of(self.name)) <= set(sources)

    @property
    def failed(self) -> bool:
        """Whether it has ended before its run was over, and was not asked to: it has given up, or
        its process is gone.
        """
        presence = self.presence
        if presence.finished:
            return self.served and not presence.settings_hash
        return self.served and has_ended(presence.instance_id.partition(' ')[2])


@dataclass
class Peers:
    """The other nodes of the run, by instance: a restarted process is another one.

    Attributes:
        role: that of this node.
        by_instance: the others.
        joiners: names of simulators that need not be there: they come and go.
        joins: whether this node is one of them.
    """

    role: str
    by_instance: dict[str, Peer] = field(default_factory=dict)
    joiners: Collection[str] = ()
    joins: bool = False
    _commands: dict[str, str] = field(default_factory=dict, init=False)  # by role
    _newest: list[Peer] | None = field(default=None, init=False)  # None: somebody was heard since

    def note(self, presence: Presence, now: float) -> str | None:
        """Note a peer's presence; returns what is new about it, for the log."""
        known = self.by_instance.get(presence.instance_id)
        if known is not None and known.presence.finished and not presence.finished:
            return None  # an earlier one, which the last one has overtaken
        served = bool(presence.settings_hash) or (known is not None and known.served)
        ended_at = known.ended_at if known is not None else None
        if presence.finished and ended_at is None:
            ended_at = now
        self.by_instance[presence.instance_id] = Peer(presence, now, served, ended_at)
        self._newest = None
        who = f'{presence.role} {presence.node}'
        if known is None:
            before = [p for p in self.by_instance.values() if p.presence.node == presence.node]
            return f'{who} is there{" again" if len(before) > 1 else ""}'
        if presence.finished and not known.presence.finished:
            now_known = self.by_instance[presence.instance_id]
            return f'{who} has {"given up" if now_known.failed else "ended"}'
        return None

    def know(self, settings: Settings | None, name: str) -> None:
        """Take note of the simulators that come and go.

        Args:
            settings: of the run; None: there are none.
            name: of this node within the run.
        """
        self.joiners = settings.joiners if settings else ()
        self.joins = self.role == 'sim' and name in self.joiners

    def newest(self) -> list[Peer]:
        """The newest instance of each node. A killed instance publishes no last presence, and
        does not count once another has taken its place.
        """
        if self._newest is not None:  # asked for several times in each turn
            return self._newest
        newest: dict[str, Peer] = {}
        for peer in self.by_instance.values():
            old = newest.get(peer.presence.node)
            if old is None or peer.received_at >= old.received_at:
                newest[peer.presence.node] = peer
        self._newest = list(newest.values())
        return self._newest

    def alive(self, role: str) -> list[Peer]:
        """Peers of a role, the newest instance of each node."""
        return [peer for peer in self.newest() if peer.presence.role == role]

    def absent(self, settings: Settings, settings_hash: str) -> list[str]:
        """Roles that lack nodes with the run's settings, and the commands that start them.

        A peer that has finished was there: nobody begins before this node is matched too, so a
        short run may be over before this node has looked around.
        """
        missing = []
        for role, count in settings.roles.items():
            there = [peer for peer in self.alive(role) if not self._comes_and_goes(peer)]
            ready = [p for p in there if p.presence.settings_hash == settings_hash]
            have = len(ready) + (role == self.role and not self.joins)
            if have >= count:
                continue
            of = f' {have + 1} of {count}' if count > 1 else ''
            if starting := [
                p.presence.node for p in there if p not in ready and not p.presence.finished
            ]:
                missing.append(f'{role}{of} ({", ".join(starting)} is there, but not ready yet)')
            elif given_up := [
                f'{p.presence.node} has given up: {p.cause}' for p in there if p.cause
            ]:
                missing.append(f'{role}{of} ({"; ".join(given_up)})')
            else:
                if role not in self._commands:  # looked for on the disk
                    self._commands[role] = roles.command(role)
                start = self._commands[role]
                missing.append(f'{role}{of} (start it with `{start}` in this namespace)')
        return missing

    def awaited(self, topics: Iterable[str]) -> list[Peer]:
        """Peers that publish on one of these topics."""
        writers = {role for topic in topics for role in roles.WRITERS.get(topic, ())}
        return [peer for role in sorted(writers) for peer in self.alive(role)]

    def failed(self, among: Iterable[Peer] | None = None) -> list[str]:
        """Roles and names of the nodes that have died or else, since a node that dies makes others
        give up, of those that have given up, in words. Nodes that the run can do without, and
        simulators that come and go, are left out.

        Args:
            among: the nodes that count; None: all.
        """
        return [f'{peer.who} has died' for peer in self.gone(among)] or [
            f'{peer.who} has given up{f" ({peer.cause})" if peer.cause else ""}'
            for peer in self._failed(among)
        ]

    def gone(self, among: Iterable[Peer] | None = None) -> list[Peer]:
        """Those of them whose processes have ended, and whose last presence has not come.

        Args:
            among: the nodes that count; None: all.
        """
        return [peer for peer in self._failed(among) if not peer.presence.finished]

    def _failed(self, among: Iterable[Peer] | None) -> Iterator[Peer]:
        for peer in self.newest() if among is None else among:
            if peer.failed and not peer.dispensable and not self._comes_and_goes(peer):
                yield peer

    def cause(self) -> str:
        """The first cause for which others have given up, as far as it is known; else empty.
        Nodes that the run can do without, and simulators that come and go, are left out.
        """
        needed = (p for p in self.newest() if not p.dispensable and not self._comes_and_goes(p))
        return next(filter(None, (peer.cause for peer in needed)), '')

    def _comes_and_goes(self, peer: Peer) -> bool:
        return peer.presence.role == 'sim' and peer.name in self.joiners

    def abandoned(self, now: float, grace: float, deadline: float) -> list[Peer]:
        """Nodes that the run can do without, and that have given up or are gone.

        Args:
            now: monotonic time [s].
            grace: seconds in which one that has died may be started again.
            deadline: seconds of silence after which one is gone; 0: never.
        """

        def gone(peer: Peer) -> bool:
            if peer.presence.finished:
                return peer.failed
            silent = now - peer.received_at
            return (peer.failed and silent > grace) or 0 < deadline < silent

        return [peer for peer in self.newest() if peer.dispensable and gone(peer)]

    def restarted(self, presence: Presence) -> bool:
        """Whether an instance of a node has taken the place of another one."""
        return any(
            peer.presence.node == presence.node
            and peer.presence.instance_id != presence.instance_id
            for peer in self.by_instance.values()
        )

    def recorded(self) -> bool:
        """Whether the recorder has finished as it should: every phase is committed."""
        there = [peer.presence for peer in self.alive('record')]
        return any(each.finished and each.settings_hash for each in there)

    def waits_for_nobody(self, role: str, now: float, deadline: float) -> bool:
        """Whether all nodes of a role have finished, or been silent beyond a deadline.

        Args:
            role: the role.
            now: monotonic time [s].
            deadline: seconds; 0: for ever.
        """
        return all(
            peer.presence.finished or 0 < deadline < now - peer.received_at
            for peer in self.alive(role)
        )

    def last_end(self) -> float:
        """When the last node that has done its part is known to have ended [s]."""
        ended = (p.ended_at for p in self.newest() if p.ended_at is not None and not p.failed)
        return max(ended, default=float('-inf'))

    def anybody_left(self) -> bool:
        """Whether any peer has not finished."""
        return any(not peer.presence.finished for peer in self.newest())
