"""Makes a whole bag of what can be read of a damaged one, or of one whose recorder was killed.

Every message that can be read is kept byte for byte, in order, with its times and its number; what
comes twice stays there twice. Nothing is altered and nothing invented: a gap stays a gap, and is
named. A chunk whose CRC is wrong is left out as a whole, since nobody can say what in it is true.
The new bag is MCAP, whatever the old one was.
"""

import os
from collections import Counter
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from mcap.writer import CompressionType, Writer

from codetr_ros.bags.definitions import bundled_text
from codetr_ros.bags.errors import BagError, Damage
from codetr_ros.bags.mcap_file import LIBRARY, Channel, RawMessage
from codetr_ros.bags.metadata import METADATA, BagFile, render
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import Verdict, verify
from codetr_ros.bags.writer import CHUNK_BYTES
from codetr_ros.run_folder import atomic_write, sync_folder

SAID = 1000
"""Losses that are named one by one; more are only counted."""


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

    def digest(self) -> str:
        return self.channel.definition.digest

    def qos(self) -> list[dict[str, Any]]:
        try:
            said = yaml.safe_load(self.channel.qos)
        except yaml.YAMLError:
            return []
        return said if isinstance(said, list) else []


@dataclass
class Recovery:
    """What became of a bag."""

    old: Path
    new: Path
    messages: Counter[str] = field(default_factory=Counter)  # kept, by topic
    bytes: int = 0  # of the messages that were kept
    lost: int = 0  # bytes of the old bag that could not be read
    faults: int = 0
    said: list[Damage] = field(default_factory=list)
    verdict: Verdict | None = None  # on the new bag

    def note(self, damage: Damage) -> None:
        """Something could not be read."""
        self.faults += 1
        self.lost += damage.lost
        if len(self.said) < SAID:
            self.said.append(damage)

    def report(self) -> dict[str, Any]:
        """As JSON has it."""
        return {
            'old': str(self.old),
            'new': str(self.new),
            'messages': self.messages.total(),
            'topics': dict(sorted(self.messages.items())),
            'bytes': self.bytes,
            'faults': self.faults,
            'bytes_lost': self.lost,
            'losses': [
                {'place': str(d.place), 'text': d.text, 'bytes': d.lost} for d in self.said
            ],
            'verdict': self.verdict.report() if self.verdict else None,
        }


class _Copy:
    """One file of the new bag."""

    def __init__(self, path: Path, library: str) -> None:
        self.path = path
        self.about = BagFile(path.name)
        self._file = path.open('xb')
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
        channel = message.channel
        number = self._channels.get(channel)
        if number is None:
            number = self._channels[channel] = self._describe(channel)
        self._writer.add_message(
            number, message.log_time, bytes(message.data), message.publish_time, message.sequence
        )
        self.about.add(channel.topic, message.log_time)

    def _describe(self, channel: Channel) -> int:
        encoding, text, digest = channel.definition
        if not encoding and (known := bundled_text(channel.type)):
            encoding, text = 'ros2msg', known
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
        self._writer.finish()
        self._file.flush()
        os.fsync(self._file.fileno())

    def close(self) -> None:
        self._file.close()


def recover(old: Path | str, new: Path | str) -> Recovery:
    """Copy what can be read of a bag to a new one, and verify that.

    Args:
        old: the damaged bag; it is not touched.
        new: a folder that does not exist, or is empty.

    Raises:
        BagError: nothing can be read, or the new bag cannot be written.
    """
    found = Recovery(Path(old), Path(new))
    bag = Bag(found.old, found.note)
    topics: dict[str, _Topic] = {}
    try:
        found.new.mkdir(parents=True, exist_ok=True)
        if there := sorted(path.name for path in found.new.iterdir()):
            raise BagError(
                f'{new} exists and holds {there[0]}: choose another folder, or remove it'
            )
        files = _copy(bag.raw(), found, topics)
        if not files:
            raise BagError(
                f'no message of {old} can be read, {new} stays empty: '
                + (found.said[0].text if found.said else 'it holds none')
            )
        atomic_write(found.new / METADATA, render(files, topics.values()))
    except OSError as error:
        raise BagError(
            f'{new} cannot be written: {error.strerror}. What it holds is unfinished: remove it, '
            f'make room, and recover {old} again'
        ) from error
    found.verdict = verify(found.new)
    return found


def _copy(
    messages: Iterable[RawMessage], found: Recovery, topics: dict[str, _Topic]
) -> list[BagFile]:
    """Write the new files, one for each old one that has messages."""
    files: list[BagFile] = []
    with ExitStack() as stack:
        copy, source = None, None
        for message in messages:
            if copy is None or message.place.file != source:
                if copy is not None:
                    copy.finish()
                source = message.place.file
                library = LIBRARY if message.channel.numbered else f'recovered by {LIBRARY}'
                copy = _Copy(found.new / f'{found.new.name}_{len(files)}.mcap', library)
                stack.callback(copy.close)
                files.append(copy.about)
            copy.add(message)
            topics.setdefault(message.channel.topic, _Topic(message.channel))
            found.messages[message.channel.topic] += 1
            found.bytes += len(message.data)
        if copy is not None:
            copy.finish()
            sync_folder(found.new)
    return files
