"""Numbered records that a consumer holds until a commit names them, and their digests."""

from collections import Counter
from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

from codetr_ros.records import I64, TOPICS, RecordError, Transitions, describe
from codetr_ros.records.chain import publisher
from codetr_ros.records.digests import joined, raw_digest

SHOWN = 12
"""Characters of a digest in a message for people: enough to tell two apart."""


def nbytes(record: Any) -> int:
    """Bytes of the arrays of steps; 0 for judgements."""
    if not isinstance(record, Transitions):
        return 0
    return int(record.observations.nbytes + record.actions.nbytes)


@dataclass(slots=True)
class _Entry:
    """A record that is held, with its digest once that was asked for."""

    record: Any
    _digest: bytes = b''

    @property
    def digest(self) -> bytes:
        if not self._digest:
            self._digest = raw_digest(self.record)
        return self._digest


@dataclass(frozen=True)
class Named:
    """What a commit names of one source or scorer.

    Attributes:
        name: the source or scorer.
        last: the last sequence number.
        records: all of them in order, with the commit's digest unless something differs.
        lacks: whether some are not held.
        replaced: how many of them are not those that came first.
        difference: what differs from the commit's digest, in words; empty if nothing does.
    """

    name: str
    last: int
    records: list[Any]
    lacks: bool = False
    replaced: int = 0
    difference: str = ''


class Held:
    """The records of one kind that are held.

    Args:
        kind: Transitions, or CompositeReward for all judgements.
    """

    def __init__(self, kind: type) -> None:
        self._kind = kind
        self._first: dict[tuple[str, int], _Entry] = {}
        self._again: dict[tuple[str, int], _Entry] = {}  # of the same number, in doubt
        self.nbytes = 0
        """Bytes of the steps that are held."""
        self._next: Counter[str] = Counter()  # the number of each publisher to be taken in next

    def due(self, record: Any) -> tuple[str, int]:
        """Who numbers a record, and the next number of it that is to be taken in."""
        _, name = publisher(record)
        return name, self._next[name]

    def add(self, record: Any, in_doubt: bool) -> bool:
        """Hold a record; returns whether it is new.

        Args:
            record: the record.
            in_doubt: whether another record of the number of one that is held may be the right
                one: the phase is sent again.

        Raises:
            RecordError: it is not in doubt, and another record of the number is held.
        """
        _, name = publisher(record)
        key, entry = (name, record.sequence), _Entry(record)
        if record.sequence < self._next[name]:
            return False
        known = self._first.setdefault(key, entry)
        if known is entry:
            self.nbytes += nbytes(record)
            return True
        if known.digest == entry.digest:
            return False
        if not in_doubt:
            raise RecordError(
                f'{describe(record)} has the number of another record that came before: if both '
                f'are of {name!r}, restart it; else stop what publishes them on '
                f'{TOPICS[type(record)]!r}'
            )
        self._drop(self._again.pop(key, None))
        self._again[key] = entry
        self.nbytes += nbytes(record)
        return True

    def _drop(self, entry: _Entry | None) -> None:
        if entry is not None:
            self.nbytes -= nbytes(entry.record)

    def named(
        self,
        names: tuple[str, ...],
        last: I64,
        digests: tuple[str, ...],
        dropped: Collection[str] = (),
    ) -> list[Named]:
        """What a commit names, ordered by name and number.

        Args:
            names: of sources or scorers.
            last: the last sequence number of each.
            digests: of each.
            dropped: those of them that are left out of the phase.
        """
        rows = sorted(zip(names, last.tolist(), digests, strict=True))
        return [self._named(*row) for row in rows if row[0] not in dropped]

    def _named(self, name: str, last: int, digest: str) -> Named:
        first, entries = [], []
        for number in range(self._next[name], last + 1):
            if (name, number) not in self._first:
                return Named(name, last, [], lacks=True)
            first.append(self._first[name, number])
            entries.append(self._again.get((name, number), first[-1]))
        own = joined(entry.digest for entry in first)
        records = [entry.record for entry in first]
        if own == digest:
            return Named(name, last, records)
        again = joined(entry.digest for entry in entries)
        if again == digest:
            count = sum(a is not b for a, b in zip(first, entries, strict=True))
            return Named(name, last, [entry.record for entry in entries], replaced=count)
        came = f', and came again as {again[:SHOWN]}' if again != own else ''
        text = (
            f'{TOPICS[self._kind]} {self._next[name]} to {last} of {name!r} have the digest '
            f'{own[:SHOWN]} here{came}; the commit states {digest[:SHOWN]}'
        )
        return Named(name, last, records, difference=text)

    def void(self, name: str, last: int) -> int:
        """Drop what is held up to a number, and whatever may still come of it; returns how many
        steps or scores that were.
        """
        keys = [key for key in self._first if key[0] == name and key[1] <= last]
        steps = 0
        for key in keys:
            entry = self._first.pop(key)
            steps += getattr(entry.record, 'steps', 1)
            self._drop(entry)
            self._drop(self._again.pop(key, None))
        self._next[name] = max(self._next[name], last + 1)
        return steps

    def take(self, named: Named) -> None:
        """Forget what is taken in, and go on behind it."""
        for number in range(self._next[named.name], named.last + 1):
            self._drop(self._first.pop((named.name, number)))
            self._drop(self._again.pop((named.name, number), None))
        self._next[named.name] = named.last + 1
