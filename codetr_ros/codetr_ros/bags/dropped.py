"""Which records of a bag were dropped: by its commits, which come after what they drop."""

from collections.abc import Collection, Iterator

from codetr_ros.bags.errors import BagError
from codetr_ros.bags.raw import RawMessage
from codetr_ros.bags.reader import Bag, Entry
from codetr_ros.records import Commit, Record, RunSpec
from codetr_ros.records.dropped import Dropped
from codetr_ros.records.fields import type_name
from codetr_ros.system.parsing import ParseError, parse_json

_OF_INTEREST = (type_name(RunSpec), type_name(Commit))


class DroppedInBag:
    """The records of sources in phases that they were left out of.

    Reads the bag once, unless our recorder wrote it of a run with a single simulator, which
    nobody leaves out. Faults are passed over: whoever reads the bag for its own sake reports them.

    Args:
        bag: the bag.
    """

    def __init__(self, bag: Bag) -> None:
        self._runs: dict[tuple[str, str], Dropped] = {}  # by namespace and id
        quiet = Bag(bag.path, lambda damage: None)
        for raw in quiet.raw():
            if raw.channel.type not in _OF_INTEREST:
                continue
            entry = _entry(quiet, raw)
            if entry is None:
                continue
            if isinstance(entry.record, Commit):
                self._of(entry).follow(entry.record)
            elif raw.channel.numbered and _alone(entry):
                return

    def _of(self, entry: Entry) -> Dropped:
        return self._runs.setdefault((entry.namespace, entry.record.run_id), Dropped())

    def holds(self, entry: Entry) -> bool:
        """Whether the record of an entry was dropped."""
        dropped = self._runs.get((entry.namespace, entry.record.run_id))
        return dropped is not None and dropped.holds(entry.record)


def undropped_entries(bag: Bag, kinds: Collection[type[Record]]) -> Iterator[Entry]:
    """The records of a bag as its `entries` has them, without those that were dropped.

    Args:
        bag: the bag.
        kinds: which records.

    Raises:
        BagError: it is damaged.
    """
    dropped = DroppedInBag(bag)
    return (entry for entry in bag.entries(kinds) if not dropped.holds(entry))


def _entry(bag: Bag, raw: RawMessage) -> Entry | None:
    try:
        return bag.entry(raw)
    except BagError:  # not one of ours, whatever it calls itself
        return None


def _alone(entry: Entry) -> bool:
    """Whether a run has a single simulator."""
    assert isinstance(entry.record, RunSpec)
    try:
        settings = parse_json(entry.record.settings)
    except ParseError:
        return False
    return (
        isinstance(settings, dict)
        and settings.get('simulators') == 1
        and not settings.get('joiners')
    )
