"""Hands records to the core of a node, and counts its messages."""

import time
from collections import Counter
from collections.abc import Callable
from typing import Any

from codetr_ros.cores.core import Core, Silent
from codetr_ros.nodes.peers import Ledger
from codetr_ros.records import TOPICS, Commit, Record, RecordError


class Traffic:
    """Hands records to the node's core and counts them, by topic.

    Attributes:
        core: takes the records; a silent one until the node has joined.
        received: records that arrived, sound or not.
        refused: those of them that were refused.
        recovered: records that were lost, and arrived when fetched again.
        ledger: counts of the records that peers have published.
        lost_for_good: records that will not arrive any more, once that is certain.

    Args:
        log: the node's logger.
        clock: monotonic time [s].
    """

    def __init__(self, log: Any, clock: Callable[[], float] = time.monotonic) -> None:
        self._log = log
        self._clock = clock
        self.core: Core[Any] = Silent()
        self.received: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.recovered: Counter[str] = Counter()
        self.ledger = Ledger()
        self.lost_for_good: dict[str, int] | None = None

    def receive(self, record: Record) -> bool:
        """Hand a record to the core; returns whether it was new and taken."""
        before = self.core.duplicated.total()
        try:
            self.core.receive(record)
        except RecordError as error:
            self.refuse(type(record), error)
            return False
        return self.core.duplicated.total() == before

    def receive_again(self, record: Record) -> None:
        """Hand over a record that was fetched again; one that is new was lost before."""
        # a node that fetches what a commit names has the commit
        if self.receive(record) and not isinstance(record, Commit):
            self.recovered[TOPICS[type(record)]] += 1

    def refuse(self, kind: type, error: RecordError) -> None:
        """Count a refusal; log the first ten on a topic, then every thousandth."""
        topic = TOPICS[kind]
        self.refused[topic] += 1
        n = self.refused[topic]
        if n <= 10 or n % 1000 == 0:
            self._log.error(f'refused on {topic!r} (number {n}): {error}')

    def lost(self) -> dict[str, int]:
        """Counts of the records that peers published a while ago, according to their presence,
        and that never arrived, not even when fetched again.
        """
        if self.lost_for_good is not None:
            return self.lost_for_good
        wanted = {TOPICS[kind] for kind in self.core.subscribes}
        lost = self.ledger.lost(self.received + self.recovered, self._clock())
        return {topic: n for topic, n in lost.items() if topic in wanted}

    def counters(self) -> dict[str, dict[str, int]]:
        """All counts, by their names on /diagnostics."""
        return {
            'received': dict(self.received),
            'lost': self.lost(),
            'duplicated': dict(self.core.duplicated),
            'refused': dict(self.refused + self.core.refused),
        }
