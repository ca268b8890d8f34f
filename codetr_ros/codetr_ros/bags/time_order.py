"""The messages of a bag in order of time, in bounded memory.

The bag is read once to learn its order: its messages become blocks, each with its first and last
time. A bag that is in order is then read from front to back. Otherwise blocks are read in order of
their first times, and a message is given out once no unread block can hold an earlier one; so only
blocks whose times overlap are in memory. Where the clock went back, a new period begins, and
everything of the period before comes first.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from heapq import heappop, heappush
from itertools import chain, pairwise
from pathlib import Path

from codetr_ros.bags.clock import TOLERANCE, Clock, Fall, Period
from codetr_ros.bags.errors import BagError, Place
from codetr_ros.bags.mcap_channels import McapChannels
from codetr_ros.bags.mcap_file import McapFile
from codetr_ros.bags.opening import open_file
from codetr_ros.bags.raw import OnDamage, RawMessage
from codetr_ros.bags.sqlite_file import SqliteFile

Prepare = Callable[[RawMessage], tuple[int, RawMessage] | None]
"""The time of a message [ns], and the message, unpacked; None where it is not asked for."""

BLOCK_MESSAGES = 1024
BLOCK_BYTES = 256 << 10
"""What a block holds, but it never ends within a chunk of its file."""
MOST_HELD = 256 << 20
"""The most bytes of messages that are held to be sorted."""
_HEAD = 64  # messages of a file by which to see that the clock went back before it
_CALENDAR = 946_684_800 * 10**9  # [ns] the year 2000: a clock beyond it shows a date


@dataclass(slots=True)
class Block:
    """Consecutive messages of a file, of those that are asked for."""

    file: int
    number: int  # in the order of the files
    first: Place
    start: int  # [ns] the earliest time
    count: int = 0
    bytes: int = 0


class _File:
    """The order of one file."""

    def __init__(self, path: Path, number: int) -> None:
        self.path = path
        self.number = number
        self.blocks: list[Block] = []
        self.clock = Clock()
        self.head: list[tuple[str, int, Place]] = []
        self._last = -1

    @property
    def start(self) -> int:
        """The earliest time [ns]."""
        return min(period.start for period in self.clock.periods)

    def take(self, raw: RawMessage, topic: str, time: int) -> None:
        place = raw.place
        cut = self.clock.take(topic, time, place, len(self.blocks))
        block = self.blocks[-1] if self.blocks else None
        if block is None or cut or (_full(block) and place.offset != self._last):
            block = Block(self.number, 0, place, time)
            self.blocks.append(block)
        self._last = place.offset
        block.count += 1
        block.bytes += len(raw.data)
        block.start = min(block.start, time)
        if len(self.head) < _HEAD:
            self.head.append((topic, time, place))

    def fall_after(self, before: Period) -> Fall | None:
        """How the clock went back from a period of another file to the begin of this file."""
        clock = Clock(before.copy())
        for i, (topic, time, place) in enumerate(self.head):
            clock.take(topic, time, place, i)
        first = clock.periods[1] if len(clock.periods) > 1 else None
        return first.fall if first is not None and not first.block else None


def _full(block: Block) -> bool:
    return block.count >= BLOCK_MESSAGES or block.bytes >= BLOCK_BYTES


@dataclass(frozen=True)
class TimeOrder:
    """The order of a bag's messages.

    Attributes:
        files: in the order in which they are read.
        late: messages that lie behind a later one of their file, and are put in their place.
        overlaps: files that begin before the one before has ended, and are merged with it.
        falls: where the clock went back.
    """

    files: list[Path]
    late: int
    overlaps: int
    falls: list[Fall]
    unset: Counter[str]  # messages left out: their header has no time; by topic
    _periods: list[list[Block]]
    _opened: list[Path]  # the files by their number in blocks

    @property
    def plain(self) -> bool:
        """Whether the files from front to back are in order of time, but for where the clock went
        back.
        """
        return not self.late and not self.overlaps

    def read(
        self,
        described: Mapping[Path, McapChannels],
        prepare: Prepare,
        on_damage: OnDamage | None,
    ) -> Iterator[tuple[int, RawMessage]]:
        """The messages with their times, in order of time, period after period.

        Args:
            described: the topics that each file describes.
            prepare: as when the order was learnt.
            on_damage: receives each fault; by default the first is an error.

        Raises:
            BagError: too much would have to be held in memory, or the bag has changed.
        """
        with ExitStack() as stack:
            openings = (
                partial(open_file, path, stack, on_damage, known=described.get(path))
                for path in self._opened
            )
            readers = [_Reader(opening, prepare) for opening in openings]
            for blocks in self._periods:
                yield from _merged(blocks, readers)


class OrderScan:
    """Learns the order of a bag from its messages, file by file."""

    def __init__(self) -> None:
        self._files: list[_File] = []
        self._file: _File | None = None

    def take(self, raw: RawMessage, topic: str, time: int) -> None:
        """Include a message, in file order.

        Raises:
            BagError: the messages cannot be brought into an order of time.
        """
        path = raw.place.file
        if self._file is None or self._file.path is not path:
            self._file = _File(path, len(self._files))
            self._files.append(self._file)
        self._file.take(raw, topic, time)

    def order(self, files: Sequence[Path], unset: Counter[str]) -> TimeOrder:
        """The order, after all messages.

        Args:
            files: of the bag.
            unset: messages that were left out, by topic.

        Raises:
            BagError: the messages cannot be brought into an order of time.
        """
        read = _as_written(self._files)
        periods: list[Period] = []
        blocks: list[list[Block]] = []
        overlaps = 0
        for file in read:
            parts = file.clock.periods
            ends = [*(part.block for part in parts[1:]), len(file.blocks)]
            for part, end in zip(parts, ends, strict=True):
                fall = part.fall or (file.fall_after(periods[-1]) if periods else None)
                if fall is not None or not periods:
                    periods.append(replace(part.copy(), fall=fall))
                    blocks.append([])
                else:
                    overlaps += part.start < periods[-1].end
                    periods[-1].join(part)
                blocks[-1] += file.blocks[part.block : end]
        for number, block in enumerate(chain.from_iterable(blocks)):
            block.number = number
        falls = [period.fall for period in periods[1:] if period.fall is not None]
        if any(len(file.clock.periods) > 1 for file in read):
            _check_lateness(periods, falls[0])
        there = [file.path for file in read]
        return TimeOrder(
            files=[*there, *(path for path in files if path not in there)],
            late=sum(period.late for period in periods),
            overlaps=overlaps,
            falls=falls,
            unset=unset,
            _periods=blocks,
            _opened=[file.path for file in self._files],
        )


def _as_written(files: Sequence[_File]) -> Sequence[_File]:
    """The files in the order in which they were written: as the bag has them, or by their first
    times where the clock goes back less often then. A clock that shows no date may have been reset
    between two files, so it decides nothing.
    """
    resets = any(len(file.clock.periods) > 1 for file in files)
    if resets or not files or min(file.start for file in files) < _CALENDAR:
        return files
    by_time = sorted(files, key=lambda file: file.start)
    return by_time if _falls(by_time) < _falls(files) else files


def _falls(files: Sequence[_File]) -> int:
    """How many times the clock went back between two files."""
    pairs = pairwise(files)
    return sum(after.fall_after(before.clock.periods[-1]) is not None for before, after in pairs)


def _check_lateness(periods: Sequence[Period], fall: Fall) -> None:
    """Refuse messages out of order in a bag whose clock went back within a file: nobody knows to
    which period they belong.

    Raises:
        BagError: there are such messages.
    """
    lateness = max(period.lateness for period in periods)
    if lateness > TOLERANCE:
        raise BagError(
            f'the clock went back ({fall}), and messages lie up to {lateness / 1e9:.3g} s behind '
            'later ones besides: to which run of the clock they belong cannot be known. Give each '
            'run of the clock as a bag of its own, or write the bag in the order of receipt'
        )


class _Reader:
    """Reads blocks of one file; the one that follows goes on where the last ended."""

    def __init__(self, opening: Callable[[], McapFile | SqliteFile], prepare: Prepare) -> None:
        self._open = opening
        self._prepare = prepare
        self._file: McapFile | SqliteFile | None = None
        self._messages: Iterator[RawMessage] = iter(())
        self._next = -1  # number of the block that follows

    def read(self, block: Block) -> Iterator[tuple[int, RawMessage]]:
        """The messages of a block with their times."""
        if self._file is None:
            self._file = self._open()
        if block.number != self._next:
            self._messages = self._file.messages(block.first)
        self._next = block.number + 1
        left = block.count
        begin = _position(block.first)
        for raw in self._messages:
            prepared = self._prepare(raw) if _position(raw.place) >= begin else None
            if prepared is not None:
                yield prepared
                left -= 1
                if not left:
                    return
        raise BagError(f'{self._file.shown} has changed while it was read: read it again')


def _position(place: Place) -> tuple[int, int]:
    return place.offset, place.inside or 0


def _merged(
    blocks: Sequence[Block], readers: Sequence[_Reader]
) -> Iterator[tuple[int, RawMessage]]:
    """The messages of blocks in order of time; those of one time in the order of the files."""
    waiting = sorted(blocks, key=lambda block: (block.start, block.number))
    held: list[tuple[int, int, int, RawMessage]] = []
    size = at = 0
    while held or at < len(waiting):
        while at < len(waiting) and (
            not held or (waiting[at].start, waiting[at].number) < held[0][:2]
        ):
            block = waiting[at]
            size += block.bytes
            if size > MOST_HELD:
                raise BagError(
                    f'{block.first}: more than {MOST_HELD >> 20} MB of messages would have to be '
                    'held to be sorted by time, since the file is out of order throughout: write '
                    'it in order of time first, with `mcap sort` or `ros2 bag convert`'
                )
            for i, (time, raw) in enumerate(readers[block.file].read(block)):
                heappush(held, (time, block.number, i, raw._replace(data=bytes(raw.data))))
            at += 1
        time, _, _, raw = heappop(held)
        size -= len(raw.data)
        yield time, raw
