"""Reads bags, ours and other people's, as records: streaming, and without ROS.

A bag is a folder of MCAP or SQLite files, read as one, or such a file by itself. Messages are
known by their type, whatever the namespace of their topics. What is read is what was written:
every chunk's CRC is checked, every definition compared, and the first fault is an error, unless
the caller asks to receive faults and to go on (`on_damage`).
"""

import tempfile
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import zstandard
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_typestore
from rosbags.typesys.store import Typestore

from codetr_ros.bags.definitions import Definition, check_own, decode, parsed
from codetr_ros.bags.errors import BagError, Damage, Place
from codetr_ros.bags.files import COMPRESSED, bag_files
from codetr_ros.bags.mcap_file import McapFile
from codetr_ros.bags.mcap_layout import LARGEST_RECORD, unzstd
from codetr_ros.bags.raw import OnDamage, RawMessage
from codetr_ros.bags.sqlite_file import SqliteFile
from codetr_ros.records import Record, RecordError
from codetr_ros.records.fields import RECORD_TYPES, type_name

_KINDS: dict[str, type[McapFile | SqliteFile]] = {'.mcap': McapFile, '.db3': SqliteFile}
_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'  # no CDR message begins with these bytes
_UNREADABLE = (SerdeError, TypesysError, LookupError, OverflowError, RecursionError)


class Entry(NamedTuple):
    """A record in a bag."""

    kind: type[Record]
    record: Record
    topic: str  # full name
    log_time: int  # [ns] when it was received
    publish_time: int  # [ns] when it was published; the log time where the bag has none
    place: Place


class Message(NamedTuple):
    """A message of any type in a bag."""

    type: str
    message: Any  # as rosbags decodes it: its fields are attributes, its arrays numpy's
    topic: str
    log_time: int  # [ns]
    publish_time: int  # [ns]
    place: Place


@dataclass(frozen=True)
class Topic:
    """A topic of a bag, and how much there is of it."""

    name: str
    type: str
    count: int
    bytes: int  # of all its messages, uncompressed


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
        try:
            check_own(raw.channel.type, raw.channel.definition)
        except BagError as error:
            raise BagError(f'{raw.place}: {error}') from None
        try:
            record = decode(kind, raw.data)
        except RecordError as error:
            self._damaged(raw, str(error))
            return None
        return Entry(kind, record, raw.channel.topic, raw.log_time, raw.publish_time, raw.place)

    def messages(
        self, topics: Collection[str] = (), types: Collection[str] = ()
    ) -> Iterator[Message]:
        """Messages of any type, decoded by the definition in the bag (by those of ROS 2 Jazzy
        where it has none), in file order.

        Args:
            topics: full names, such as `/joint_states`.
            types: such as `sensor_msgs/msg/JointState`. All messages if neither is given.

        Raises:
            BagError: the bag is damaged, or a message's definition is not known.
        """
        for raw in self.raw():
            channel = raw.channel
            if (topics or types) and channel.topic not in topics and channel.type not in types:
                continue
            try:
                store = _typestore(channel.type, channel.definition)
            except BagError as error:
                raise BagError(f'{raw.place}: {error}') from None
            try:
                message = store.deserialize_cdr(raw.data, channel.type)
            except _UNREADABLE as error:
                self._damaged(raw, f'{channel.type} cannot be decoded: {error}')
                continue
            yield Message(
                channel.type, message, channel.topic, raw.log_time, raw.publish_time, raw.place
            )

    def raw(self) -> Iterator[RawMessage]:
        """Every message as bytes, in file order.

        Raises:
            BagError: the bag is damaged.
        """
        types: dict[str, str] = {}
        counts: Counter[str] = Counter()
        sizes: Counter[str] = Counter()
        self.in_files, self.unchecked = {}, 0
        for path in self.files:
            with ExitStack() as stack:
                opened = open_file(path, stack, self.on_damage, self.thorough)
                for packed in opened.messages():
                    message = self._unpacked(packed)
                    if message is not None:
                        sizes[message.channel.topic] += len(message.data)
                        yield message
                counts += opened.counts
                self.in_files[path.name] = opened.counts.total()
                self.unchecked += opened.unchecked
                types |= {channel.topic: channel.type for channel in opened.channels()}
        self._topics = {
            name: Topic(name, kind, counts[name], sizes[name])
            for name, kind in sorted(types.items())
        }

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
        _report(damage, self.on_damage)


def _report(damage: Damage, on_damage: OnDamage | None) -> None:
    if on_damage is None:
        raise damage.error()
    on_damage(damage)


def open_file(
    path: Path, stack: ExitStack, on_damage: OnDamage | None = None, thorough: bool = False
) -> McapFile | SqliteFile:
    """One file of a bag; a compressed one is first unpacked beside other temporary files, until
    the stack is closed.

    Raises:
        BagError: it cannot be read or unpacked.
    """
    if path.suffix != COMPRESSED:
        return _KINDS[path.suffix](path, on_damage, thorough=thorough)
    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix='codetr-bag-'))
    unpacked = Path(folder) / path.stem
    try:
        with path.open('rb') as packed:
            _write(zstandard.ZstdDecompressor().read_to_iter(packed), unpacked)
    except zstandard.ZstdError as error:
        _report(Damage(Place(path, 0), f'its zstd data is damaged ({error})', 0), on_damage)
    except OSError as error:
        text = f'cannot be read: {error.strerror}'
        _report(Damage(Place(path, 0), text, 0, unread=True), on_damage)
    return _KINDS[unpacked.suffix](unpacked, on_damage, path, thorough)


def _write(pieces: Iterable[bytes], path: Path) -> None:
    """Write what is read to a file.

    Raises:
        BagError: it cannot be written; errors of what is read pass through.
    """
    with _writing(path):
        file = path.open('wb')
    with file:
        for piece in pieces:
            with _writing(path):
                file.write(piece)
                file.flush()


@contextmanager
def _writing(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise BagError(
            f'{path}, to which a bag is unpacked, cannot be written: {error.strerror}: make room '
            'there, or set TMPDIR to a folder that has some'
        ) from error


def _decompressed(data: bytes | memoryview) -> bytes:
    unpacked = unzstd(data, LARGEST_RECORD)
    if len(unpacked) > LARGEST_RECORD:
        raise zstandard.ZstdError(f'more than {LARGEST_RECORD} bytes')
    return unpacked


@cache
def _typestore(name: str, definition: Definition) -> Typestore:
    if not definition.encoding:
        store = get_typestore(Stores.ROS2_JAZZY)
        if name not in store.fielddefs:
            raise BagError(f'the bag has no definition of {name}, and ROS 2 Jazzy has none')
        return store
    types = parsed(name, definition)
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(types)
        store.get_msgdef(name)
    except _UNREADABLE as error:
        raise BagError(f'the definition of {name} cannot be used: {error}') from error
    return store
