"""Reads bags, ours and other people's, as records: streaming, and without ROS.

A bag is a folder of MCAP or SQLite files, read as one, or such a file by itself. Messages are
known by their type, whatever the namespace of their topics. What is read is what was written:
every chunk's CRC is checked, every definition compared, and the first fault is an error, unless
the caller asks to receive faults and to go on (`on_damage`).
"""

from collections import Counter
from collections.abc import Collection, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import zstandard

from codetr_ros.bags.definitions import decode
from codetr_ros.bags.errors import BagError, Damage, Place
from codetr_ros.bags.files import bag_files
from codetr_ros.bags.mcap_channels import McapChannels
from codetr_ros.bags.mcap_layout import LARGEST_RECORD, unzstd
from codetr_ros.bags.opening import open_file, report
from codetr_ros.bags.raw import Channel, OnDamage, RawMessage
from codetr_ros.bags.schemas import UNREADABLE, types_of
from codetr_ros.bags.time_order import OrderScan, TimeOrder
from codetr_ros.bags.timing import Selection, Timing
from codetr_ros.records import Record, RecordError
from codetr_ros.records.fields import RECORD_TYPES, type_name
from codetr_ros.records.names import full_name

_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'  # no CDR message begins with these bytes
_CDR = ('cdr', '')  # '': the file does not declare how its messages are serialised


class Entry(NamedTuple):
    """A record in a bag."""

    kind: type[Record]
    record: Record
    topic: str  # full name
    log_time: int  # [ns] when it was received
    publish_time: int  # [ns] when it was published; the log time where the bag has none
    place: Place

    @property
    def namespace(self) -> str:
        """That of its topic."""
        return self.topic.rpartition('/')[0] or '/'


class Message(NamedTuple):
    """A message of any type in a bag."""

    type: str
    message: Any  # as rosbags decodes it: its fields are attributes, its arrays numpy's
    topic: str
    log_time: int  # [ns]
    publish_time: int  # [ns]
    place: Place
    stamp: int | None = None  # [ns] of its header, where that was asked for

    @property
    def time(self) -> int:
        """By which it is ordered [ns]: that of its header, or when it was received."""
        return self.log_time if self.stamp is None else self.stamp


@dataclass(frozen=True)
class Topic:
    """A topic of a bag, and how much there is of it."""

    name: str
    type: str
    count: int
    bytes: int  # of all its messages, uncompressed
    encoding: str  # of its messages, as declared


class Bag:
    """A bag to read from. Nothing is kept open or in memory between two calls.

    Args:
        path: the bag's folder, or one MCAP or SQLite file (`.mcap`, `.db3`, also with `.zstd`).
        on_damage: receives each fault, and reading goes on behind it: for bags of killed
            recorders. By default the first fault is an error, even the missing end of a killed
            recorder's file; every message before it has been yielded by then.
        thorough: compare indexes and summaries too, although nothing is read by them.

    Attributes:
        files: its files, in order.
        in_files: messages in each, by name, as far as the bag has been read.
        unchecked: chunks and messages read that carry no CRC: a bit changed in them goes unnoticed
            where the result is still a possible message.

    Raises:
        BagError: there is no bag there, it cannot be read, or a file of it is missing.
    """

    def __init__(
        self, path: Path | str, on_damage: OnDamage | None = None, thorough: bool = False
    ) -> None:
        self.path = Path(path)
        self.on_damage = on_damage
        self.thorough = thorough
        self.in_files: dict[str, int] = {}
        self.unchecked = 0
        self.files = bag_files(self.path, on_damage)
        self._topics: dict[str, Topic] | None = None
        self._order: tuple[Selection, TimeOrder] | None = None
        self._described: dict[Path, McapChannels] = {}

    def entries(self, kinds: Collection[type[Record]] | None = None) -> Iterator[Entry]:
        """Our records, in file order. Takes memory for one chunk of the bag.

        Args:
            kinds: only these; all if not given.

        Raises:
            BagError: the bag is damaged, or defines one of our types differently.
        """
        names = None if kinds is None else {type_name(kind) for kind in kinds}
        for raw in self.raw():
            if names is None or raw.channel.type in names:
                entry = self.entry(raw)
                if entry is not None:
                    yield entry

    def entry(self, raw: RawMessage) -> Entry | None:
        """Our record in a message; None if it is of another type, or damaged.

        Raises:
            BagError: it is damaged (and there is no `on_damage` to receive that), or the bag
                defines one of our types differently.
        """
        kind = RECORD_TYPES.get(raw.channel.type)
        if kind is None:
            return None
        _check_encoding(raw)
        try:
            record = decode(kind, raw.data, raw.channel.definition)
        except BagError as error:
            raise BagError(f'{raw.place}: {error}') from None
        except RecordError as error:
            self._damaged(raw, str(error))
            return None
        topic = full_name(raw.channel.topic)
        return Entry(kind, record, topic, raw.log_time, raw.publish_time, raw.place)

    def messages(
        self,
        topics: Collection[str] = (),
        types: Collection[str] = (),
        stamped: Collection[str] = (),
    ) -> Iterator[Message]:
        """Messages of any type in order of time, decoded by the definition in the bag (by those of
        ROS 2 Jazzy where it has none). Where the clock of the bag went back, so do the times.

        The bag is read twice, and the second time in other than file order where it must be.

        Args:
            topics: such as `/joint_states`, with or without the leading slash.
            types: such as `sensor_msgs/msg/JointState`. All messages if neither is given.
            stamped: topics whose messages have the time of their header, not of their receipt.

        Raises:
            BagError: the bag is damaged, a message's definition is not known, or the messages
                cannot be brought into an order of time.
        """
        order = self.time_order(topics, types, stamped)
        self._order = None
        selection = Selection.of(topics, types, stamped)
        timing = Timing(selection, self._unpacked)
        on_damage = None if self.on_damage is None else _known_damage
        if order.plain:
            timed: Iterator[tuple[int, RawMessage]] = (
                one for raw in self._read(order.files, on_damage) if (one := timing(raw))
            )
        else:
            timed = order.read(self._described, timing, on_damage)
        for time, raw in timed:
            message = self._message(raw)
            if message is not None:
                own = message.topic in selection.stamped
                yield message._replace(stamp=time) if own else message

    def time_order(
        self,
        topics: Collection[str] = (),
        types: Collection[str] = (),
        stamped: Collection[str] = (),
    ) -> TimeOrder:
        """Read the bag to learn in which order such messages come. `messages` of the same need not
        read it for that again.

        Raises:
            BagError: the bag is damaged, or they cannot be brought into an order of time.
        """
        selection = Selection.of(topics, types, stamped)
        if self._order is None or self._order[0] != selection:
            timing = Timing(selection, self._unpacked)
            scan = OrderScan()
            for packed in self.raw():
                if (timed := timing(packed)) is not None:
                    time, raw = timed
                    scan.take(raw, full_name(raw.channel.topic), time)
            try:
                timing.check_clocks()
                self._order = selection, scan.order(self.files, timing.unset)
            except BagError as error:
                raise BagError(f'{self.path}: {error}') from None
        return self._order[1]

    def _message(self, raw: RawMessage) -> Message | None:
        channel = raw.channel
        _check_encoding(raw)
        try:
            store = types_of(channel.type, channel.definition)
        except BagError as error:
            raise BagError(f'{raw.place}: {error}') from None
        try:
            message = store.deserialize_cdr(raw.data, channel.type)
        except UNREADABLE as error:
            self._damaged(raw, f'{channel.type} cannot be decoded: {error}')
            return None
        topic = full_name(channel.topic)
        return Message(channel.type, message, topic, raw.log_time, raw.publish_time, raw.place)

    def raw(self) -> Iterator[RawMessage]:
        """Every message as bytes, in file order.

        Raises:
            BagError: the bag is damaged.
        """
        return self._read(self.files, self.on_damage)

    def _read(self, files: Sequence[Path], on_damage: OnDamage | None) -> Iterator[RawMessage]:
        channels: dict[str, Channel] = {}
        counts: Counter[str] = Counter()
        sizes: Counter[str] = Counter()
        self.in_files, self.unchecked, self._described = {}, 0, {}
        for path in files:
            with ExitStack() as stack:
                opened = open_file(path, stack, on_damage, self.thorough)
                self._described[path] = opened.described
                for packed in opened.messages():
                    message = self._unpacked(packed)
                    if message is not None:
                        sizes[message.channel.topic] += len(message.data)
                        yield message
                for topic, count in opened.counts.items():
                    counts[topic] += count
                self.in_files[path.name] = opened.counts.total()
                self.unchecked += opened.unchecked
                channels |= {channel.topic: channel for channel in opened.channels()}
        topics: dict[str, Topic] = {}
        for topic, channel in channels.items():
            name, count, size = full_name(topic), counts[topic], sizes[topic]
            if name in topics:  # with and without its leading slash
                count, size = count + topics[name].count, size + topics[name].bytes
            topics[name] = Topic(name, channel.type, count, size, channel.encoding)
        self._topics = dict(sorted(topics.items()))

    def _unpacked(self, message: RawMessage) -> RawMessage | None:
        if bytes(message.data[:4]) != _ZSTD_MAGIC:
            return message
        try:
            return message._replace(data=_decompressed(message.data))
        except zstandard.ZstdError as error:
            self._damaged(message, f'its zstd data is damaged ({error})')
            return None

    @property
    def topics(self) -> dict[str, Topic]:
        """The topics by name. Counted by reading the bag, unless it has been read before.

        Raises:
            BagError: the bag is damaged.
        """
        if self._topics is None:
            for _ in self.raw():
                pass
        assert self._topics is not None
        return self._topics

    @property
    def namespaces(self) -> tuple[str, ...]:
        """Namespaces that have topics of our types: one for each run that was recorded."""
        return tuple(
            sorted(
                {
                    name.rpartition('/')[0] or '/'
                    for name, topic in self.topics.items()
                    if topic.type in RECORD_TYPES and topic.count
                }
            )
        )

    def _damaged(self, message: RawMessage, text: str) -> None:
        damage = Damage(message.place, f'{message.channel.topic}: {text}', len(message.data))
        report(damage, self.on_damage)


def _known_damage(_: Damage) -> None:
    """Receive damage that has been reported when the order was learnt."""


def _check_encoding(raw: RawMessage) -> None:
    if raw.channel.encoding not in _CDR:
        raise BagError(
            f'{raw.place}: the messages of {raw.channel.topic} are serialised as '
            f'{raw.channel.encoding!r}: only cdr is read. Convert the bag to cdr first'
        )


def _decompressed(data: bytes | memoryview) -> bytes:
    unpacked = unzstd(data, LARGEST_RECORD)
    if len(unpacked) > LARGEST_RECORD:
        raise zstandard.ZstdError(f'more than {LARGEST_RECORD} bytes')
    return unpacked
