"""Reads a bag that is still being written: each time what has come since the time before."""

from collections.abc import Collection, Iterator
from pathlib import Path

from mcap.opcode import Opcode

from codetr_ros.bags.errors import BagError, Damage, Place
from codetr_ros.bags.mcap_channels import McapChannels
from codetr_ros.bags.mcap_file import McapFile
from codetr_ros.bags.mcap_layout import HEAD, MAGIC
from codetr_ros.bags.reader import Bag
from codetr_ros.records import Record
from codetr_ros.records.fields import type_name


class Follower:
    """Follows a bag of our recorder.

    Args:
        folder: the bag; may not be there yet.
        tail: read at first no more than about so many bytes of its end; None: all of it.

    Attributes:
        faults: what could not be read.
        left_out: bytes before the tail, which were not read.
    """

    def __init__(self, folder: Path, tail: int | None = None) -> None:
        self._folder = folder
        self._tail = tail
        self._read: dict[str, int] = {}  # file name -> where its next record begins
        self._known: dict[str, McapChannels] = {}
        self._sizes: dict[str, int] = {}  # of the files at the last call
        self.faults: list[Damage] = []
        self.left_out = 0

    def records(self, kinds: Collection[type[Record]]) -> Iterator[Record]:
        """Records of these kinds that have come since the last call, in file order.

        A chunk that is half written is left for the next call.
        """
        names = {type_name(kind) for kind in kinds}
        sizes = {path.name: path.stat().st_size for path in self._folder.glob('*.mcap')}
        if sizes == self._sizes:
            return  # often asked, and the metadata of a finished bag takes a while to read
        self._sizes = sizes
        try:
            bag = Bag(self._folder, self.faults.append)
        except BagError as error:
            self._fault(Place(self._folder, 0), str(error))
            return
        if not self._read:
            self._begin(bag.files)
        for path in bag.files:
            if path.suffix == '.mcap':
                yield from self._follow(bag, path, names)

    def _fault(self, place: Place, text: str) -> None:
        damage = Damage(place, text, 0)
        if damage not in self.faults:
            self.faults.append(damage)

    def _begin(self, files: list[Path]) -> None:
        """Choose where to begin in each file."""
        left = self._tail
        for path in reversed(files):
            self._read[path.name] = 0
            if left is None or path.suffix != '.mcap':
                continue
            starts, end = _whole_records(path, 0)
            skipped = [start for start in starts if end - start > left]
            if skipped:
                self._read[path.name] = skipped[-1]
                self.left_out += skipped[-1]
            left = max(0, left - end)

    def _follow(self, bag: Bag, path: Path, names: set[str]) -> Iterator[Record]:
        start = self._read.get(path.name, 0)
        _, end = _whole_records(path, start)
        if end <= max(start, len(MAGIC)):
            return
        if path.name not in self._known:
            self._describe(path)

        def note(damage: Damage) -> None:
            # behind the end, the file is still being written
            if damage.place.offset < end and not damage.harmless:
                self.faults.append(damage)

        file = McapFile(path, note, known=self._known[path.name])
        for raw in file.messages(Place(path, start) if start else None):
            if raw.place.offset >= end:
                break
            if raw.channel.type in names and (entry := bag.entry(raw)) is not None:
                yield entry.record
        self._read[path.name] = end

    def _describe(self, path: Path) -> None:
        """Learn the topics of a file: they stand before its first message."""
        file = McapFile(path, lambda damage: None)
        next(file.messages(), None)
        self._known[path.name] = file.described


def _whole_records(path: Path, start: int) -> tuple[list[int], int]:
    """Where the file's records begin that are there as a whole, and where the last of them ends.

    The index at the end of a finished file does not count.
    """
    starts = []
    with path.open('rb') as file:
        size = file.seek(0, 2)
        at = start or len(MAGIC)
        while at + HEAD.size <= size:
            file.seek(at)
            opcode, length = HEAD.unpack(file.read(HEAD.size))
            if opcode == Opcode.DATA_END or at + HEAD.size + length > size:
                break
            starts.append(at)
            at += HEAD.size + length
    return starts, min(at, size)
