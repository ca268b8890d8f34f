"""Whether a recorder that has committed every phase may end."""

from collections.abc import Callable, Mapping

from codetr_ros.nodes.errors import NodeError
from codetr_ros.nodes.patience import GRACE, Limit
from codetr_ros.nodes.peers import Peer, Peers


class Settling:
    """Watches over the end of a run.

    Attributes:
        without: roles and names of the nodes without which it ends: the run needs nothing of
            them.
        held: those of them that are silent, and of which nothing is lacking.

    Args:
        who: the recorder's full name.
        peers: the other nodes.
        limit: how long it waits for silent ones.
        left_out: whether nobody waits for a node any more, at a monotonic time [s].
        recorded: whether everything that a node has to publish is recorded, as far as that can be
            known: it may then be silent for good.
    """

    def __init__(
        self,
        who: str,
        peers: Peers,
        limit: Limit,
        left_out: Callable[[Peer, float], bool] = lambda peer, now: False,
        recorded: Callable[[Peer], bool] = lambda peer: False,
    ) -> None:
        self._who = who
        self._peers = peers
        self._deadline = limit.seconds
        self._left_out = left_out
        self._recorded = recorded
        self.without: list[str] = []
        self.held: list[str] = []
        self._missing: Mapping[str, int] = {}
        self._ended: set[str] | None = None
        self._came_at = float('-inf')  # when something that was lacking came, or a node ended

    def gone(self, now: float) -> list[Peer]:
        """The nodes that nobody waits for, and of which nothing is still to come.

        Args:
            now: monotonic time [s].
        """
        grace = max(GRACE, self._deadline)  # one that was killed may be started again meanwhile
        abandoned = self._peers.abandoned(now, grace, self._deadline)
        self.without = [peer.who for peer in abandoned]
        left_out = [peer for peer in self._peers.newest() if self._left_out(peer, now)]
        return [*abandoned, *left_out]

    def check(self, missing: Mapping[str, int], seconds: float, now: float) -> tuple[bool, str]:
        """Whether all nodes have finished and nothing is missing; and what the recorder does.

        Args:
            missing: counts of records that are still to come, by topic: none of nodes that are
                gone.
            seconds: time since every phase is committed.
            now: monotonic time [s].

        Raises:
            NodeError: a node has ended too early, or records never arrived.
        """
        grace = max(GRACE, self._deadline)
        gone = self.gone(now)
        held = self._silent_for_good(now)
        self.held = [peer.who for peer in held]
        self.without += self.held
        gone += held
        awaited = [p for p in self._peers.newest() if p not in gone]
        there = [
            p
            for p in awaited
            if not p.presence.finished and not (p.failed and now - p.received_at > grace)
        ]
        running = [f'{p.presence.role} {p.presence.node}' for p in there]
        if not running and not missing:
            if failed := self._peers.failed(awaited):
                raise NodeError(
                    f'{self._who}: every phase is recorded, but {"; ".join(failed)}, and the bag '
                    'lacks what was still to come from there. Look at the log of that node',
                    self._peers.cause(),
                )
            return True, 'has finished'
        lacking = [f'{n} of {topic}' for topic, n in missing.items()]
        doing = (
            f'waits for the end of {", ".join(running) or "nobody"} '
            f'and for {", ".join(lacking) or "nothing"}'
        )
        self._note(missing, now)
        # a node that still publishes its presence may work as long as it needs
        newest_at = max((p.received_at for p in there), default=0.0)
        quiet = now - max(newest_at, self._came_at)
        if self._deadline and min(seconds, quiet) > self._deadline:
            raise NodeError(
                f'{self._who} gave up after {self._deadline:g} s: {doing}. The bag lacks that',
                self._peers.cause(),
            )
        return False, doing

    def _note(self, missing: Mapping[str, int], now: float) -> None:
        """Note whether something that was lacking has come, or a node has ended: what that has
        published last may still be lacking.
        """
        finished = (peer.presence for peer in self._peers.newest() if peer.presence.finished)
        ended = {presence.instance_id for presence in finished}
        less = any(missing.get(topic, 0) < count for topic, count in self._missing.items())
        if less or (self._ended is not None and ended - self._ended):
            self._came_at = now
        self._missing, self._ended = dict(missing), ended

    def _silent_for_good(self, now: float) -> list[Peer]:
        """Nodes that are silent beyond the deadline, and of which nothing is to come any more."""
        return [
            peer
            for peer in self._peers.newest()
            if not peer.presence.finished
            and not peer.failed
            and 0 < self._deadline < now - peer.received_at
            and self._recorded(peer)
        ]
