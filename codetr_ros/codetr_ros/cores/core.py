"""The shape of every part of a run, whoever wires it."""

from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Protocol, TypeVar

from codetr_ros.records import Record
from codetr_ros.runs.reports import CoreReport

Given_co = TypeVar('Given_co', covariant=True)
"""What a core gives out: records, or whatever stands for them."""


class Core(Protocol[Given_co]):
    """What every part of a run is, whoever wires it: it takes records in, works in slices, gives
    records out.
    """

    @property
    def subscribes(self) -> tuple[type, ...]:
        """Kinds of records that it takes in."""

    @property
    def finished(self) -> bool:
        """Whether it has done all that the run asks of it."""

    @property
    def missing(self) -> int | None:
        """A committed phase of which something has not arrived; None if there is none."""

    @property
    def duplicated(self) -> 'Counter[str]':
        """Records that came again and were dropped, by topic."""

    @property
    def refused(self) -> 'Counter[str]':
        """Records that `receive` took and that were refused later, by topic."""

    def receive(self, record: Record) -> None:
        """Store a record; raises `RecordError` for what must be refused, and has then changed
        nothing.
        """

    def work(self) -> Iterator[Sequence[Given_co] | None]:
        """One slice for each `next()`: the records that became ready, or None while there is
        nothing to do.
        """

    def waiting_for(self) -> str:
        """What the next slice waits for, for people."""

    def close(self) -> None:
        """Save what must outlast the process; harmless when called again."""

    def report(self) -> CoreReport:
        """What to say in the run's summary."""


class Part:
    """What most cores have in common: nothing missing, nothing counted, any message awaited."""

    finished = False

    def __init__(self) -> None:
        self.duplicated: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()

    @property
    def missing(self) -> int | None:
        """A committed phase of which something has not arrived; None if there is none."""
        return None

    def waiting_for(self) -> str:
        """What the next slice waits for, for people."""
        return 'messages'


class Silent(Part):
    """A core that takes nothing in and gives nothing out: of a node that has no other (yet)."""

    subscribes: tuple[type, ...] = ()
    finished = True

    def receive(self, record: Record) -> None:
        """Nothing is subscribed to."""

    def work(self) -> Iterator[list[Record] | None]:
        """Nothing to do."""
        while True:
            yield None

    def close(self) -> None:
        """Nothing to save."""

    def report(self) -> CoreReport:
        """Nothing to report."""
        return CoreReport()
