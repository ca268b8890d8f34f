"""Reads bags, ours and other people's, as records: streaming, and without ROS.

A bag is a folder of MCAP or SQLite files, read as one, or such a file by itself. Messages are
known by their type, whatever the namespace of their topics. What is read is what was written:
every chunk's CRC is checked, every definition compared, and the first fault is an error, unless
the caller asks to be told of faults and to go on (`on_damage`).
"""

import os
import re
import shutil
import stat
import tempfile
from collections import Counter
from collections.abc import Collection, Iterator
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cache
from pathlib import Path, PurePath
from typing import Any, NamedTuple

import yaml
import zstandard
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, TypesysError, get_typestore
from rosbags.typesys.store import Typestore

from codetr_ros.bags.definitions import Definition, check_own, decode, parsed
from codetr_ros.bags.errors import BagError, Damage, Place
from codetr_ros.bags.mcap_file import McapFile, OnDamage, RawMessage
from codetr_ros.bags.mcap_layout import LARGEST_RECORD
from codetr_ros.bags.metadata import METADATA
from codetr_ros.bags.sqlite_file import SqliteFile
from codetr_ros.received import RECORD_TYPES, type_name
from codetr_ros.records import Record, RecordError

_KINDS: dict[str, type[McapFile | SqliteFile]] = {'.mcap': McapFile, '.db3': SqliteFile}
_COMPRESSED = '.zstd'
_LONGEST_METADATA = 16 << 20
_ZSTD_MAGIC = b'\x28\xb5\x2f\xfd'  # no CDR message begins so
_UNREADABLE = (SerdeError, TypesysError, LookupError, OverflowError, RecursionError)


class Entry(NamedTuple):
    """A record in a bag."""

    kind: type[Record]
    record: Record
    topic: str  # full name
    log_time: int  # [ns] when it was received
    publish_time: int  # [ns] when it was published; as received where the bag does not say
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
        on_damage: is told of each fault, and reading goes on behind it: for bags of killed
            recorders. By default the first fault is an error, the missing end of a killed
            recorder's file among them; every message before it has been given out by then.

    Raises:
        BagError: there is no bag there, it cannot be read, or a file of it is missing.
    """

    def __init__(self, path: Path | str, on_damage: OnDamage | None = None) -> None:
        self.path = Path(path)
        self.on_damage = on_damage
        self.files = _files(self.path, on_damage)
        self._topics: dict[str, Topic] | None = None

    def entries(self, kinds: Collection[type[Record]] | None = None) -> Iterator[Entry]:
        """Our records, in file order. Takes memory for one chunk of the bag.

        Args:
            kinds: only these; all if not given.

        Raises:
            BagError: the bag is damaged, or says that one of our types is something else.
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
            BagError: it is damaged (unless `on_damage` is told), or the bag says that one of our
                types is something else.
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
        for path in self.files:
            with ExitStack() as stack:
                opened = open_file(path, stack, self.on_damage)
                for packed in opened.messages():
                    message = self._unpacked(packed)
                    if message is not None:
                        sizes[message.channel.topic] += len(message.data)
                        yield message
                counts += opened.counts
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
        if self.on_damage is None:
            raise damage.error()
        self.on_damage(damage)


def open_file(
    path: Path, stack: ExitStack, on_damage: OnDamage | None = None
) -> McapFile | SqliteFile:
    """One file of a bag; a compressed one is first unpacked beside other temporary files, until
    the stack is closed.

    Raises:
        BagError: it cannot be read or unpacked.
    """
    if path.suffix != _COMPRESSED:
        return _KINDS[path.suffix](path, on_damage)
    folder = stack.enter_context(tempfile.TemporaryDirectory(prefix='codetr-bag-'))
    unpacked = Path(folder) / path.stem
    try:
        with path.open('rb') as packed, unpacked.open('wb') as file:
            shutil.copyfileobj(zstandard.ZstdDecompressor().stream_reader(packed), file)
    except OSError as error:
        raise BagError(f'{path} cannot be unpacked to {unpacked}: {error.strerror}') from error
    except zstandard.ZstdError as error:
        damage = Damage(Place(path, 0), f'its zstd data is damaged ({error})', 0)
        if on_damage is None:
            raise damage.error() from None
        on_damage(damage)
    return _KINDS[unpacked.suffix](unpacked, on_damage, shown=path)


def _decompressed(data: bytes | memoryview) -> bytes:
    with zstandard.ZstdDecompressor().stream_reader(data) as stream:
        found = stream.read(LARGEST_RECORD + 1)
    if len(found) > LARGEST_RECORD:
        raise zstandard.ZstdError(f'more than {LARGEST_RECORD} bytes')
    return found


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


# ------------------------------------------------------------------------------------------------
# which files


def _kind(name: str) -> str:
    return PurePath(name.removesuffix(_COMPRESSED)).suffix


def _number(name: str) -> tuple[int, str]:
    """Splits are numbered; 10 comes after 9."""
    found = re.search(r'_(\d+)\.[a-z0-9.]+$', name)
    return (int(found[1]) if found else -1, name)


def listed_files(folder: Path) -> list[str]:
    """Names of the files that a folder's metadata lists; none if it has no metadata.

    Raises:
        BagError: the metadata cannot be read.
    """
    path = folder / METADATA
    try:
        with path.open('rb') as file:
            text = file.read(_LONGEST_METADATA)
        said = yaml.safe_load(text)['rosbag2_bagfile_information']['relative_file_paths']
        return [PurePath(name).name for name in said]
    except FileNotFoundError:
        return []
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from error
    except (yaml.YAMLError, UnicodeDecodeError, LookupError, TypeError, RecursionError) as error:
        raise BagError(
            f'{path} is damaged ({str(error).splitlines()[0]}). The messages do not need it: '
            'remove it, or make a new one with `codetr bag recover`'
        ) from error


def _files(path: Path, on_damage: OnDamage | None) -> list[Path]:
    try:
        mode = path.stat().st_mode
        if stat.S_ISREG(mode):
            if _kind(path.name) not in _KINDS:
                raise BagError(f'{path} is no bag: a bag is a folder, or a file of {_named()}')
            return [path]
        if not stat.S_ISDIR(mode):
            raise BagError(f'{path} is neither file nor folder')
        there = {name for name in os.listdir(path) if _kind(name) in _KINDS}
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from error
    try:
        listed = listed_files(path)
        if missing := [name for name in listed if name not in there]:
            raise BagError(
                f'bag {path} lacks {missing[0]}, which its {METADATA} lists: put it back, or make '
                'a whole bag of the rest with `codetr bag recover`'
            )
    except BagError as error:
        if on_damage is None:
            raise
        on_damage(Damage(Place(path / METADATA, 0), str(error), 0))
        listed = []
    names = [*listed, *sorted(there - set(listed), key=_number)]
    if not names:
        raise BagError(f'{path} is no bag: it holds no file of {_named()}')
    for name in names:
        _check_file(path / name)
    return [path / name for name in names]


def _named() -> str:
    return ' or '.join(_KINDS)


def _check_file(path: Path) -> None:
    try:
        if not stat.S_ISREG(path.stat().st_mode):
            raise BagError(f'{path} is no file')
    except OSError as error:
        raise BagError(f'{path} cannot be read: {error.strerror}') from error
