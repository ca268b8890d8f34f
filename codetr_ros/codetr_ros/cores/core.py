"""The interface of every part of a run, over topics or in process."""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from typing import Protocol, TypeVar

from codetr_ros.records import Record
from codetr_ros.runs.reports import CoreReport

Given_co = TypeVar('Given_co', covariant=True)
"""What a core yields: records, or what represents them."""


class Core(Protocol[Given_co]):
    """A part of a run, over topics or in process: it takes records in, works in slices and yields
    records.
    """

    @property
    def subscribes(self) -> tuple[type, ...]:
        """The kinds of records that it takes in."""

    @property
    def finished(self) -> bool:
        """Whether it has done everything that the run asks of it."""

    @property
    def missing(self) -> int | None:
        """A committed phase that is incomplete; None if there is none."""

    @property
    def gone_by(self) -> Collection[int]:
        """Phases whose commits came before their turn, and went: they are not under way."""

    @property
    def uncommitted(self) -> int | None:
        """The phase whose commit comes next; None if none is awaited here."""

    @property
    def unannounced(self) -> bool:
        """Whether it has to know what all sources simulate, and does not yet."""

    @property
    def unpermitted(self) -> int | None:
        """A phase whose policy is awaited; None if there is none."""

    @property
    def due(self) -> int | None:
        """The next phase to be finished here; None if there are none here."""

    @property
    def permitted(self) -> int | None:
        """The newest phase that can have been permitted; None if that is not known here."""

    @property
    def unlabelled(self) -> int | None:
        """A phase whose labels are awaited; None if there is none."""

    @property
    def left_out(self) -> frozenset[str]:
        """The sources that are no part of the run now, as far as that is known here."""

    @property
    def duplicated(self) -> 'Counter[str]':
        """Counts of records that arrived again and were dropped, by topic."""

    @property
    def refused(self) -> 'Counter[str]':
        """Counts of records that `receive` took and that were refused later, by topic."""

    def fetched(self, phase: int) -> None:
        """Note that everything of a phase has been sent again by the recorder."""

    def receive(self, record: Record) -> None:
        """Store a record.

        Raises:
            RecordError: it must be refused; nothing has changed then.
        """

    def work(self) -> Iterator[Sequence[Given_co] | None]:
        """Work one slice for each `next()`; yields the records that are ready, or None if there is
        nothing to do.
        """

    def waiting_for(self) -> str:
        """What the next slice waits for, for people."""

    def close(self) -> None:
        """Save what must outlast the process; a second call does no harm."""

    def report(self) -> CoreReport:
        """What the core contributes to the run's summary."""


class Part:
    """The defaults of most cores: nothing is missing or counted, and any message is awaited."""

    finished = False
    gone_by: Collection[int] = ()

    def __init__(self) -> None:
        self.duplicated: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()

    @property
    def missing(self) -> int | None:
        """A committed phase that is incomplete; None if there is none."""
        return None

    @property
    def uncommitted(self) -> int | None:
        """The phase whose commit comes next; None if none is awaited here."""
        return None

    @property
    def unannounced(self) -> bool:
        """Whether it has to know what all sources simulate, and does not yet."""
        return False

    @property
    def unpermitted(self) -> int | None:
        """A phase whose policy is awaited; None if there is none."""
        return None

    @property
    def due(self) -> int | None:
        """The next phase to be finished here; None if there are none here."""
        return None

    @property
    def permitted(self) -> int | None:
        """The newest phase that can have been permitted; None if that is not known here."""
        return None

    def fetched(self, phase: int) -> None:
        """Do nothing: no phase is missing."""

    @property
    def unlabelled(self) -> int | None:
        """A phase whose labels are awaited; None if there is none."""
        return None

    @property
    def left_out(self) -> frozenset[str]:
        """The sources that are no part of the run now, as far as that is known here."""
        return frozenset()

    def waiting_for(self) -> str:
        """What the next slice waits for, for people."""
        return 'messages'


class Silent(Part):
    """A core that takes nothing in and yields no record: for a node without another (yet)."""

    subscribes: tuple[type, ...] = ()
    finished = True

    def receive(self, record: Record) -> None:
        """Do nothing: no record is subscribed to."""

    def work(self) -> Iterator[list[Record] | None]:
        """Nothing to do."""
        while True:
            yield None

    def close(self) -> None:
        """Nothing to save."""

    def report(self) -> CoreReport:
        """Nothing to report."""
        return CoreReport()
