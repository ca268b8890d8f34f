"""Writes a bag that loses nothing once it is flushed: MCAP in small chunks, each with its CRC.

A bag is a folder of MCAP files and a `metadata.yaml`, written last. The layout is rosbag2's:
profile `ros2`, schemas as .msg text with all that they contain, `offered_qos_profiles` and
`topic_type_hash` at each channel. A file that has reached a size is finished, index included, and
the next one begun. A process that is killed leaves its last file without index and the folder
without metadata (so that no reader takes the bag for whole): every flushed message can still be
read from it in order (`mcap.stream_reader`). The definitions lie in its first chunk, and again in
a later one whenever the file has doubled, since only a finished file has them at its end too. If
the beginning of a file is damaged, it can still be read from the next repetition on.

Messages are taken as the CDR bytes received: nothing is decoded, so nothing can change.
"""

import os
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from mcap.writer import CompressionType, Writer

from codetr_ros.bags.errors import BagError, BagWriteError, Place
from codetr_ros.bags.metadata import METADATA, BagFile, render
from codetr_ros.bags.raw import LIBRARY
from codetr_ros.bags.topics import BagTopic, schema_text, type_hash
from codetr_ros.system.disk import Disk
from codetr_ros.system.files import atomic_write, remedy, sync_folder

CHUNK_BYTES = 64 * 1024
"""Size at which a chunk is closed by itself: the most that a killed process loses of messages not
yet flushed."""
SPLIT_BYTES = 10**9
"""Size at which the next file is begun."""


@cache
def _qos_text(topic: BagTopic) -> str:
    return yaml.safe_dump(topic.qos(), sort_keys=False)  # takes milliseconds


@dataclass
class Written:
    """What a bag holds that is gone on with.

    Attributes:
        files: its files, in order; all have their end.
        bytes: the size of all of them.
    """

    files: list[BagFile] = field(default_factory=list)
    bytes: int = 0


class McapWriter:
    """Writes messages to a new bag, or to the next file of one.

    Args:
        folder: the bag; must not exist, or be empty, unless `written` is given.
        topics: that will be written.
        chunk_bytes: size at which a chunk is closed.
        split_bytes: size at which the next file is begun; 0: never.
        keep_free: `check_room` raises an error when the disk has fewer bytes left.
        written: what the bag holds (`reopening.reopen`), to go on with it in its next file.
        disk: where it lies; None: the disk of this machine.

    Raises:
        BagError: the folder holds something or cannot be made, or a type is not installed.
    """

    def __init__(
        self,
        folder: Path,
        topics: Iterable[BagTopic],
        chunk_bytes: int = CHUNK_BYTES,
        split_bytes: int = SPLIT_BYTES,
        keep_free: int = 0,
        written: Written | None = None,
        disk: Disk | None = None,
    ) -> None:
        self.folder = folder
        written = written or Written()
        self.counts = sum((file.counts for file in written.files), Counter[str]())
        self.closed = False
        self._topics = {topic.name: topic for topic in topics}
        self._chunk_bytes = chunk_bytes
        self._split_bytes = split_bytes
        self._keep_free = keep_free
        self._disk = disk or Disk()
        self._files = list(written.files)
        self._finished = written.bytes  # of the files that are finished
        self._path: Path | None = None  # of the file that is not
        self._good = 0  # bytes of it that are on the disk and whole
        try:
            folder.mkdir(parents=True, exist_ok=True)
            there = sorted(path.name for path in folder.iterdir())
            known = {METADATA, *(file.name for file in self._files)}
            if foreign := [name for name in there if not self._files or name not in known]:
                raise BagError(
                    f'bag {folder} exists and holds {foreign[0]}: choose another folder, or '
                    'remove it'
                )
            (folder / METADATA).unlink(missing_ok=True)  # or it would lack the files to come
            self._open_file()
        except OSError as error:
            raise BagWriteError(
                f'bag {folder} cannot be made: {error.strerror}. {remedy(error).capitalize()}, or '
                'choose another folder'
            ) from error

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._finished + (self._good if self._stream.closed else self._stream.tell())

    def _open_file(self) -> None:
        """Begin the bag's next file. Schemas and channels are written to each, so that each can be
        read alone.
        """
        file = BagFile(f'{self.folder.name}_{len(self._files)}.mcap')
        # worked out first, so that a missing type leaves no file behind
        described = [
            (topic, schema_text(topic.type), type_hash(topic.type))
            for topic in self._topics.values()
        ]
        path = self.folder / file.name
        self._stream = self._disk.create(path)
        self._path = path
        self._files.append(file)
        self._writer: Any = Writer(  # its methods carry no types
            self._stream,
            chunk_size=self._chunk_bytes,
            compression=CompressionType.NONE,
            enable_crcs=True,
            enable_data_crcs=True,  # of what lies between the chunks, too
        )
        self._writer.start(profile='ros2', library=LIBRARY)
        self._channels: dict[str, int] = {}
        self._again = self._stream.tell() + 1  # where to describe them next: in the second chunk
        schemas: dict[str, int] = {}
        for topic, text, digest in described:
            if topic.type not in schemas:
                schemas[topic.type] = self._writer.register_schema(topic.type, 'ros2msg', text)
            self._channels[topic.name] = self._writer.register_channel(
                topic.name,
                'cdr',
                schemas[topic.type],
                {
                    'offered_qos_profiles': _qos_text(topic),
                    'topic_type_hash': digest,
                },
            )
        self._sync()
        sync_folder(self.folder)

    def write(
        self, topic: str, data: bytes, log_time: int, publish_time: int | None = None
    ) -> Place:
        """Append a message.

        Args:
            topic: its full name; one of the bag's topics.
            data: CDR bytes, with their header.
            log_time: when it was received [ns].
            publish_time: when it was published [ns]. The log time is used if it is not known, or
                if a node states a time before 1970, which the file cannot hold.

        Returns:
            Where the chunk begins in which it will lie.

        Raises:
            BagError: it cannot be written. The bag is then closed, and holds what was flushed.
        """
        if self.closed:
            raise BagError(f'bag {self.folder} is closed: nothing can be written to it any more')
        if publish_time is None or publish_time <= 0:
            publish_time = log_time
        try:
            if 0 < self._split_bytes <= self._stream.tell():
                self._finish_file()
                self._open_file()
            self._describe_again()
            place = Place(self.folder / self._files[-1].name, self._stream.tell())
            self._writer.add_message(
                self._channels[topic], log_time, data, publish_time, self.counts[topic]
            )
        except OSError as error:
            raise self._broken(error) from error
        self.counts[topic] += 1
        self._files[-1].add(topic, log_time)
        return place

    def _describe_again(self) -> None:
        """Repeat schemas and channels at the beginning of the next chunk, if it is time."""
        if (at := self._stream.tell()) < self._again:
            return
        self._again = 2 * at
        # mcap's writer has no call for this; the format allows it any number of times
        chunk, schemas, channels = (
            getattr(self._writer, f'_Writer__{name}')
            for name in ('chunk_builder', 'schemas', 'channels')
        )
        for schema in schemas.values():
            chunk.add_schema(schema)
        for channel in channels.values():
            chunk.add_channel(channel)

    def _sync(self) -> None:
        self._writer.flush()
        self._disk.sync(self._stream)
        self._good = self._stream.tell()

    def flush(self) -> None:
        """End the open chunk and wait until everything is on the disk.

        Raises:
            BagError: it cannot be written. The bag is then closed, and holds what was flushed
                before.
        """
        try:
            self._sync()
        except OSError as error:
            raise self._broken(error) from error

    def check_room(self) -> None:
        """Raise an error while there is still room to close the bag properly.

        Raises:
            BagError: the disk has less room left than is to be kept. The bag is unchanged.
        """
        try:
            free = self._disk.free(self.folder)
        except OSError as error:
            raise BagError(
                f'bag {self.folder}: the room left on its disk is unknown: {error.strerror}. Mend '
                'the disk, and start the run again in another folder'
            ) from error
        if free < self._keep_free:
            raise BagError(
                f'bag {self.folder}: the disk has {free / 1e6:.1f} MB left, fewer than the '
                f'{self._keep_free / 1e6:.1f} MB to be kept free: make room, and start the run '
                'again in another folder'
            )

    def _finish_file(self) -> None:
        """Write the file's index."""
        self._sync()
        self._writer.finish()
        self._disk.sync(self._stream)
        self._finished += self._stream.tell()
        self._stream.close()
        self._path, self._good = None, 0

    def _broken(self, error: OSError) -> BagWriteError:
        """Cut the file back to the last whole chunk: for some readers, half a chunk would spoil
        what comes before it.
        """
        self.closed = True
        # closing tries to write the buffer once more; the file is closed all the same
        with suppress(OSError):
            self._stream.close()
        left = 'the last file without an index'
        try:
            if self._path is not None and self._good:
                os.truncate(self._path, self._good)
            elif self._path is not None:  # not even its beginning is on the disk
                self._path.unlink()
        except OSError as failed:
            left += f' and not cut back to them ({failed.strerror}): half a chunk may follow'
        return BagWriteError(
            f'bag {self._path or self.folder} cannot be written: {error.strerror}. It holds the '
            f'{self.size} bytes flushed before, {left}. {remedy(error).capitalize()}: '
            f'`codetr bag recover {self.folder} --out NEW` makes it whole; start the run again in '
            'another folder'
        )

    def close(self) -> None:
        """Write index and metadata; harmless when called again.

        Raises:
            BagError: they cannot be written; the messages stay readable in order.
        """
        if self.closed:
            return
        try:
            self._finish_file()
        except OSError as error:
            raise self._broken(error) from error
        self.closed = True
        try:
            atomic_write(self.folder / METADATA, render(self._files, self._topics.values()))
        except OSError as error:
            raise BagWriteError(
                f'bag {self.folder} is whole but {METADATA} cannot be written: {error.strerror}. '
                f'{remedy(error).capitalize()}, and `codetr bag recover {self.folder} --out NEW` '
                'writes it'
            ) from error
