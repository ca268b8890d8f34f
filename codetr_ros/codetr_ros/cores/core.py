"""The shape of every part of a run, whoever wires it."""

from collections.abc import Iterator
from typing import Protocol

from codetr_ros.records import Record
from codetr_ros.runs.reports import CoreReport


class Core(Protocol):
    """What every part of a run is, whoever wires it: it takes records in, works in slices, gives
    records out.
    """

    subscribes: tuple[type, ...]
    finished: bool

    def receive(self, record: Record) -> None:
        """Store a record; raises `RecordError` for what must be refused, and has then changed
        nothing.
        """

    def work(self) -> Iterator[list[Record] | None]:
        """One slice for each `next()`: the records that became ready, or None while there is
        nothing to do.
        """

    def close(self) -> None:
        """Save what must outlast the process; harmless when called again."""

    def report(self) -> CoreReport:
        """What to say in the run's summary."""
