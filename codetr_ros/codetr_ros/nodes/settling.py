"""Whether a recorder that has committed every phase may end."""

from collections import Counter
from collections.abc import Callable, Mapping

from codetr_ros.nodes.errors import NodeError
from codetr_ros.nodes.patience import GRACE, Limit
from codetr_ros.nodes.peers import Peer, Peers


def still_missing(
    by_peers: Mapping[str, int],
    own: Mapping[str, int],
    received: Mapping[str, int],
    written: Mapping[str, int],
) -> dict[str, int]:
    """Counts of records, by topic, that were published and that the recorder does not have.

    Args:
        by_peers: published by the other nodes.
        own: published by the recorder itself.
        received: those that reached it.
        written: those that it wrote without receiving them: its own commits.
    """
    due = Counter(by_peers)
    due.update(own)
    arrived = Counter(received) + Counter(written)
    return {topic: n - arrived[topic] for topic, n in sorted(due.items()) if n > arrived[topic]}


class Settling:
    """Watches over the end of a run.

    Attributes:
        without: roles and names of the nodes without which it has ended: the run needs nothing of
            them.

    Args:
        who: the recorder's full name.
        peers: the other nodes.
        limit: how long it waits for silent ones.
        gone: whether nobody waits for a node any more, at a monotonic time [s]: it was left out.
    """

    def __init__(
        self,
        who: str,
        peers: Peers,
        limit: Limit,
        gone: Callable[[Peer, float], bool] = lambda peer, now: False,
    ) -> None:
        self._who = who
        self._peers = peers
        self._deadline = limit.seconds
        self._gone = gone
        self.without: list[str] = []

    def check(self, missing: Mapping[str, int], seconds: float, now: float) -> tuple[bool, str]:
        """Whether all nodes have finished and nothing is missing; and what the recorder does.

        Args:
            missing: counts of records that are still to come, by topic.
            seconds: time since every phase is committed.
            now: monotonic time [s].

        Raises:
            NodeError: a node has ended too early, or records never arrived.
        """
        grace = max(GRACE, self._deadline)  # one that was killed may be started again meanwhile
        gone = self._peers.abandoned(now, grace, self._deadline)
        self.without = [peer.who for peer in gone]
        excused: Counter[str] = Counter()  # it may have died before that was sent
        for peer in gone:
            excused.update(peer.published)
        missing = {t: n - excused[t] for t, n in missing.items() if n > excused[t]}
        awaited = [p for p in self._peers.newest() if p not in gone and not self._gone(p, now)]
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
        # a node that still publishes its presence may work as long as it needs
        newest_at = max((p.received_at for p in there), default=0.0)
        if self._deadline and min(seconds, now - newest_at) > self._deadline:
            raise NodeError(
                f'{self._who} gave up after {self._deadline:g} s: {doing}. The bag lacks that',
                self._peers.cause(),
            )
        return False, doing
