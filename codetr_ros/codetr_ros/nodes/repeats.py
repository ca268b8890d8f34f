"""Which records a recorder has already: a node that was killed publishes some of them again."""

import hashlib
from collections import Counter, OrderedDict
from dataclasses import fields
from typing import Any

import numpy as np

from codetr_ros.records import TOPICS, EpisodeResult, Metrics, Record
from codetr_ros.records.identity import identity

MOST = 100_000
"""Records that are remembered, evaluations apart, of which all are. What came before so many
others cannot come again: no node keeps it."""


class Repeats:
    """Knows a record that came before, and compares the two.

    Takes 16 bytes and a key for each.

    Attributes:
        different: counts of records that came again and were others, by topic: what published
            them is not deterministic.
    """

    def __init__(self) -> None:
        self._known: OrderedDict[Any, bytes] = OrderedDict()
        self._evaluations: dict[Any, bytes] = {}
        self.different: Counter[str] = Counter()

    def note(self, record: Record) -> bool:
        """Remember a record; returns whether it came before."""
        key, content = (type(record), identity(record)), _digest(record)
        evaluation = isinstance(record, EpisodeResult) and record.purpose != 'training'
        known = self._evaluations if evaluation else self._known
        before = known.setdefault(key, content)
        if before is not content:
            if before != content and not isinstance(record, Metrics):  # times differ always
                self.different[TOPICS[type(record)]] += 1
            return True
        while len(self._known) > MOST:
            self._known.popitem(last=False)
        return False

    def knows(self, record: Record) -> bool:
        """Whether a record came before."""
        key = type(record), identity(record)
        return key in self._known or key in self._evaluations

    def differs(self, record: Record) -> bool:
        """Whether another record came before in its place."""
        before = self._known.get((type(record), identity(record)))
        return before is not None and before != _digest(record)


def _digest(record: Record) -> bytes:
    """Of what a record says."""
    digest = hashlib.blake2b(digest_size=16)
    for field in fields(record):
        value = getattr(record, field.name)
        if isinstance(value, np.ndarray):
            digest.update(np.ascontiguousarray(value).tobytes())
        else:
            digest.update(value if isinstance(value, bytes) else repr(value).encode())
        digest.update(b'\n')
    return digest.digest()
