"""Which records were dropped, because their source was left out of a phase: the one place that
decides it for all who read a run later.

A commit names such a source in `dropped`, and as its last number one beyond all that it can have
published by then. What lies up to there was learnt from by nobody.
"""

from collections import Counter
from collections.abc import Iterable, Iterator

from codetr_ros.records.chain import Publisher, named, publisher, void
from codetr_ros.records.kinds import (
    Commit,
    CompositeReward,
    Record,
    Transitions,
    TrueRewards,
)


def undropped(records: Iterable[Record]) -> Iterator[Record]:
    """The records of committed phases, with their commits, in the order of a bag; without those of
    sources in phases that they were left out of.
    """
    dropped = Dropped()
    held: list[Record] = []
    for record in records:
        held.append(record)
        if isinstance(record, Commit):
            dropped.follow(record)
            yield from (each for each in held if not dropped.holds(each))
            held = []


class Dropped:
    """The numbers that commits have voided: which records are of sources that were left out.

    Args:
        commits: of one run, in order.
    """

    def __init__(self, commits: Iterable[Commit] = ()) -> None:
        self._next: Counter[Publisher] = Counter()  # the number behind the last commit
        self._voided: dict[Publisher, list[range]] = {}
        for commit in commits:
            self.follow(commit)

    def __bool__(self) -> bool:
        return bool(self._voided)

    def follow(self, commit: Commit) -> None:
        """Take note of what a commit voids."""
        out = void(commit)
        for key, last in named(commit).items():
            if key in out:
                self._voided.setdefault(key, []).append(range(self._next[key], last + 1))
            self._next[key] = max(self._next[key], last + 1)

    def holds(self, record: Record) -> bool:
        """Whether a record was dropped: steps, true rewards, or a score of the simulator."""
        if isinstance(record, TrueRewards):
            key: Publisher = (Transitions, record.source)
        elif isinstance(record, (Transitions, CompositeReward)):
            key = publisher(record)
        else:
            return False
        return any(record.sequence in each for each in self._voided.get(key, ()))
