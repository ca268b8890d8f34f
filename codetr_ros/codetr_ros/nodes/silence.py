"""Which sources are silent, so that a phase need not wait for them."""

from codetr_ros.config import Settings
from codetr_ros.nodes.attention import Attention
from codetr_ros.nodes.peers import Peer, Peers

LEAVE_OUT_AFTER = 30.0
"""Seconds of silence after which a source is left out, unless the user says otherwise: a node that
was killed is started again before, and nobody has given up yet."""


class Silence:
    """How long simulators have published no presence.

    Args:
        peers: the nodes of the run.
        settings: its settings.
        after: seconds of silence after which a source is silent; 0: never.
    """

    def __init__(self, peers: Peers, settings: Settings, after: float) -> None:
        self._peers = peers
        self._settings = settings
        self.after = after
        self._attention = Attention()
        self._since: float | None = None  # from when on silence counts

    def sources(self, now: float) -> dict[str, float]:
        """The sources of simulators that are silent or have ended, and for how long [s].

        Nobody is where nobody could be left out: with a single simulator there is nothing to go on
        with, and at a free pace nobody is permitted anything.

        Args:
            now: monotonic time [s]. Call it often: see `Attention`.
        """
        if self._since is None or self._attention.was_away(now):
            self._since = now
        settings = self._settings
        if not self.after or settings.free or settings.alone:
            return {}
        return {
            source: now - peer.received_at
            for peer in self._peers.alive('sim')
            if peer.presence.finished or self.silent(peer, now)
            for source in settings.sources_of(peer.name)
        }

    def silent(self, peer: Peer, now: float) -> bool:
        """Whether nothing has come from a node for longer than it may be silent."""
        since = peer.received_at if self._since is None else max(peer.received_at, self._since)
        return 0 < self.after < now - since
