"""Copy messages to a new bag as the bytes they are, with their times and numbers.

Nothing is decoded, so nothing can change. Types that this library does not know keep the
definitions from their bag. The new bag is MCAP, whatever the old one was.
"""

from collections import Counter
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from mcap.writer import CompressionType, Writer

from codetr_ros.bags.definitions import text_of
from codetr_ros.bags.metadata import METADATA, BagFile, render
from codetr_ros.bags.raw import LIBRARY, Channel, RawMessage
from codetr_ros.bags.writer import CHUNK_BYTES
from codetr_ros.system.disk import Disk
from codetr_ros.system.files import atomic_write, sync_folder
from codetr_ros.system.parsing import ParseError, parse_yaml


@dataclass(frozen=True)
class _Topic:
    """A topic as the old bag describes it."""

    channel: Channel

    @property
    def name(self) -> str:
        return self.channel.topic

    @property
    def type(self) -> str:
        return self.channel.type

    @property
    def encoding(self) -> str:
        return self.channel.encoding

    def digest(self) -> str:
        return self.channel.definition.digest

    def qos(self) -> list[dict[str, Any]]:
        try:
            profiles = parse_yaml(self.channel.qos, unique=False)
        except ParseError:
            return []
        listed = isinstance(profiles, list) and all(isinstance(one, dict) for one in profiles)
        return profiles if listed else []


@dataclass
class Copied:
    """What a new bag holds."""

    files: list[BagFile] = field(default_factory=list)
    topics: dict[str, _Topic] = field(default_factory=dict)
    messages: Counter[str] = field(default_factory=Counter)  # by topic
    bytes: int = 0  # of all messages


class NewFile:
    """One file of the new bag.

    Args:
        path: the file, which does not exist.
        library: the writer that it names.
        disk: where it lies; None: the disk of this machine.
    """

    def __init__(self, path: Path, library: str, disk: Disk | None = None) -> None:
        self._disk = disk or Disk()
        self.path = path
        self.about = BagFile(path.name)
        self._file = self._disk.create(path)
        self._writer: Any = Writer(  # its methods carry no types
            self._file,
            chunk_size=CHUNK_BYTES,
            compression=CompressionType.NONE,
            enable_crcs=True,
            enable_data_crcs=True,
        )
        self._writer.start(profile='ros2', library=library)
        self._schemas: dict[tuple[str, str, str], int] = {}
        self._channels: dict[Channel, int] = {}

    def add(self, message: RawMessage) -> None:
        """Append a message, with its times and its number."""
        channel = message.channel
        number = self._channels.get(channel)
        if number is None:
            number = self._channels[channel] = self._describe(channel)
        self._writer.add_message(
            number, message.log_time, bytes(message.data), message.publish_time, message.sequence
        )
        self.about.add(channel.topic, message.log_time)

    def _describe(self, channel: Channel) -> int:
        digest = channel.definition.digest
        encoding, text = text_of(channel.type, channel.definition)
        key = channel.type, encoding, text
        if key not in self._schemas:
            self._schemas[key] = self._writer.register_schema(
                channel.type, encoding, text.encode()
            )
        about = {'offered_qos_profiles': channel.qos}
        if digest:
            about['topic_type_hash'] = digest
        number: int = self._writer.register_channel(
            channel.topic, channel.encoding, self._schemas[key], about
        )
        return number

    def finish(self) -> None:
        """Write the index, and wait until all of it is on the disk."""
        self._writer.finish()
        self._disk.sync(self._file)

    def close(self) -> None:
        """Close the file, whole or not."""
        self._file.close()


def copy(messages: Iterable[RawMessage], folder: Path, library: str) -> Copied:
    """Write messages to a new bag, one file for each source file; `write_metadata` makes it whole.

    Args:
        messages: in their order.
        folder: exists, and is empty.
        library: the writer that the new files name. Files numbered by our recorder name `LIBRARY`.

    Raises:
        OSError: the bag cannot be written.
    """
    made = Copied()
    with ExitStack() as stack:
        file, source = None, None
        for message in messages:
            if file is None or message.place.file != source:
                if file is not None:
                    file.finish()
                    file.close()
                source = message.place.file
                name = f'{folder.name}_{len(made.files)}.mcap'
                file = NewFile(folder / name, LIBRARY if message.channel.numbered else library)
                stack.callback(file.close)
                made.files.append(file.about)
            file.add(message)
            made.topics.setdefault(message.channel.topic, _Topic(message.channel))
            made.messages[message.channel.topic] += 1
            made.bytes += len(message.data)
        if file is not None:
            file.finish()
            sync_folder(folder)
    return made


def write_metadata(made: Copied, folder: Path) -> None:
    """Write the metadata of a copied bag."""
    atomic_write(folder / METADATA, render(made.files, made.topics.values()))
