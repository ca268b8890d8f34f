"""Writes a bag that loses nothing which was flushed: MCAP in small chunks, each with its CRC.

A bag is a folder of MCAP files and a `metadata.yaml` (rosbag2's version 9), written last. The
layout is rosbag2's: profile `ros2`, schemas as .msg text with all that they contain,
`offered_qos_profiles` and `topic_type_hash` at each channel. A process that is killed leaves a
file without index and a folder without metadata: every flushed message can still be read from it
in order (`mcap.stream_reader`).

Messages are taken as the CDR bytes that came: nothing is decoded, so nothing can change.
"""

import json
import os
import sys
from collections import Counter
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import yaml
from mcap.writer import CompressionType, Writer

from codetr_ros.run_folder import atomic_write, sync_folder

CHUNK_BYTES = 64 * 1024
"""Size at which a chunk is closed by itself: what a killed process can lose of messages not yet
flushed."""
METADATA = 'metadata.yaml'
_FOREVER = {'sec': 9223372036, 'nsec': 854775807}


class BagError(RuntimeError):
    """A bag that cannot be written or set up: names the file or the type, the reason and the
    remedy.
    """


@dataclass(frozen=True)
class BagTopic:
    """A topic as the bag describes it."""

    name: str  # fully resolved, such as /run/transitions
    type: str  # such as codetr_msgs/msg/Transitions
    depth: int
    transient_local: bool

    def qos(self) -> list[dict[str, Any]]:
        """The QoS it was offered with, as rosbag2 writes it (so that `ros2 bag play` offers the
        same).
        """
        return [
            {
                'history': 'keep_last',
                'depth': self.depth,
                'reliability': 'reliable',
                'durability': 'transient_local' if self.transient_local else 'volatile',
                'deadline': dict(_FOREVER),
                'lifespan': dict(_FOREVER),
                'liveliness': 'automatic',
                'liveliness_lease_duration': dict(_FOREVER),
                'avoid_ros_namespace_conventions': False,
            }
        ]


@cache
def _share_folders() -> tuple[Path, ...]:
    prefixes = [p for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    return tuple(Path(prefix) / 'share' for prefix in (*prefixes, sys.prefix))


def _interface_file(package: str, name: str, suffix: str) -> Path:
    for share in _share_folders():
        path = share / package / 'msg' / f'{name}.{suffix}'
        if path.is_file():
            return path
    searched = ', '.join(str(share) for share in _share_folders())
    raise BagError(
        f'no {suffix} file of {package}/msg/{name} in {searched}: build the workspace, or '
        f'source its setup file'
    )


def _contained(package: str, text: str) -> Iterable[tuple[str, str]]:
    """Message types that a .msg text names as field types, in order."""
    for line in text.splitlines():
        kind = line.split('#', 1)[0].split(' ', 1)[0].split('[', 1)[0].split('<', 1)[0].strip()
        if '/' in kind:
            owner, _, name = kind.partition('/')
            yield owner, name.removeprefix('msg/')
        elif kind[:1].isupper():
            yield package, kind


@cache
def schema_text(type_name: str) -> bytes:
    """The definition of a message type and of all that it contains, in rosbag2's form.

    Raises:
        BagError: its .msg file is not installed.
    """
    package, _, name = type_name.split('/')
    text = _interface_file(package, name, 'msg').read_text()
    parts = [text]
    seen = {(package, name)}
    todo = list(_contained(package, text))
    while todo:
        key = todo.pop(0)
        if key in seen:
            continue
        seen.add(key)
        text = _interface_file(*key, 'msg').read_text()
        parts.append(f'\n{"=" * 80}\nMSG: {key[0]}/{key[1]}\n{text}')
        todo = [*_contained(key[0], text), *todo]
    return ''.join(parts).encode()


@cache
def type_hash(type_name: str) -> str:
    """REP-2016 hash of a message type (`RIHS01_...`), from its installed description.

    Raises:
        BagError: the description is not installed or does not name the type.
    """
    package, _, name = type_name.split('/')
    path = _interface_file(package, name, 'json')
    for entry in json.loads(path.read_text())['type_hashes']:
        if entry['type_name'] == type_name:
            return str(entry['hash_string'])
    raise BagError(f'{path} has no hash of {type_name}: build the workspace again')


@dataclass
class _FileInfo:
    """What metadata.yaml says about one file."""

    name: str
    start: int = 0
    end: int = 0
    count: int = 0


class McapWriter:
    """Writes messages to a new bag.

    Args:
        folder: the bag; must not exist, or be empty.
        topics: what will be written.
        chunk_bytes: size at which a chunk is closed.

    Raises:
        BagError: the folder holds something or cannot be made, or a type is not installed.
    """

    def __init__(
        self, folder: Path, topics: Iterable[BagTopic], chunk_bytes: int = CHUNK_BYTES
    ) -> None:
        self.folder = folder
        self.counts: Counter[str] = Counter()
        self._topics = {topic.name: topic for topic in topics}
        self._chunk_bytes = chunk_bytes
        self._files: list[_FileInfo] = []
        self._good = 0
        self.closed = False
        try:
            folder.mkdir(parents=True, exist_ok=True)
            if found := sorted(p.name for p in folder.iterdir()):
                raise BagError(
                    f'bag {folder} exists and holds {found[0]}: choose another folder, or '
                    f'remove it'
                )
            self._open_file()
            sync_folder(folder)
        except OSError as error:
            raise BagError(
                f'bag {folder} cannot be made: {error.strerror}; choose another folder'
            ) from error

    @property
    def size(self) -> int:
        """Bytes written so far."""
        return self._good if self._stream.closed else self._stream.tell()

    def _open_file(self) -> None:
        """Begin the bag's next file. Schemas and channels are written to each, so that each can be
        read alone.
        """
        info = _FileInfo(f'{self.folder.name}_{len(self._files)}.mcap')
        self._stream = (self.folder / info.name).open('xb')
        self._files.append(info)
        self._writer: Any = Writer(  # its methods carry no types
            self._stream,
            chunk_size=self._chunk_bytes,
            compression=CompressionType.NONE,
            enable_crcs=True,
        )
        self._writer.start(profile='ros2', library='codetr_ros')
        self._channels: dict[str, int] = {}
        schemas: dict[str, int] = {}
        for topic in self._topics.values():
            if topic.type not in schemas:
                schemas[topic.type] = self._writer.register_schema(
                    topic.type, 'ros2msg', schema_text(topic.type)
                )
            self._channels[topic.name] = self._writer.register_channel(
                topic.name,
                'cdr',
                schemas[topic.type],
                {
                    'offered_qos_profiles': yaml.safe_dump(topic.qos(), sort_keys=False),
                    'topic_type_hash': type_hash(topic.type),
                },
            )
        self._flush()

    def write(
        self, topic: str, data: bytes, log_time: int, publish_time: int | None = None
    ) -> None:
        """Append a message.

        Args:
            topic: its full name; one of the bag's topics.
            data: CDR bytes, with their header.
            log_time: when it was received [ns].
            publish_time: when it was published [ns]; as received where not known.

        Raises:
            BagError: it cannot be written. The bag is then closed, and holds what had been
                flushed.
        """
        info = self._files[-1]
        try:
            self._writer.add_message(
                self._channels[topic], log_time, data, publish_time or log_time, self.counts[topic]
            )
        except OSError as error:
            raise self._broken(error) from error
        self.counts[topic] += 1
        info.start = min(info.start, log_time) if info.count else log_time
        info.end = max(info.end, log_time)
        info.count += 1

    def _flush(self) -> None:
        self._writer.flush()
        self._stream.flush()
        os.fsync(self._stream.fileno())
        self._good = self._stream.tell()

    def flush(self) -> None:
        """End the open chunk and wait until everything is on the disk.

        Raises:
            BagError: it cannot be written. The bag is then closed, and holds what had been flushed
                before.
        """
        try:
            self._flush()
        except OSError as error:
            raise self._broken(error) from error

    def _broken(self, error: OSError) -> BagError:
        """Cut the file back to the last whole chunk: half a chunk would spoil what comes before it
        for some readers.
        """
        self.closed = True
        path = self.folder / self._files[-1].name
        with suppress(
            OSError
        ):  # closing tries to write the buffer once more; the file is closed all the same
            self._stream.close()
        os.truncate(path, self._good)
        return BagError(
            f'bag {path} cannot be written: {error.strerror}. It holds the {self._good} bytes '
            f'flushed before, '
            f'without an index. Make room, and start the run again in another folder'
        )

    def close(self) -> None:
        """Write index and metadata; harmless when called again.

        Raises:
            BagError: they cannot be written; the messages stay readable in order.
        """
        if self.closed:
            return
        try:
            self._flush()
            self._writer.finish()
            self._stream.flush()
            os.fsync(self._stream.fileno())
            self._good = self._stream.tell()
            self._stream.close()
            atomic_write(self.folder / METADATA, self._metadata())
            self.closed = True
        except OSError as error:
            if not self._stream.closed:
                raise self._broken(error) from error
            raise BagError(
                f'bag {self.folder} is whole but {METADATA} cannot be written: '
                f'{error.strerror}; make room and reindex it'
            ) from error

    def _metadata(self) -> str:
        files = [
            {
                'path': info.name,
                'starting_time': {'nanoseconds_since_epoch': info.start},
                'duration': {'nanoseconds': info.end - info.start},
                'message_count': info.count,
            }
            for info in self._files
        ]
        used = [info for info in self._files if info.count]
        start = min((info.start for info in used), default=0)
        end = max((info.end for info in used), default=0)
        topics = [
            {
                'topic_metadata': {
                    'name': topic.name,
                    'type': topic.type,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': topic.qos(),
                    'type_description_hash': type_hash(topic.type),
                },
                'message_count': self.counts[topic.name],
            }
            for topic in self._topics.values()
        ]
        information = {
            'version': 9,
            'storage_identifier': 'mcap',
            'duration': {'nanoseconds': end - start},
            'starting_time': {'nanoseconds_since_epoch': start},
            'message_count': sum(info.count for info in self._files),
            'topics_with_message_count': topics,
            'compression_format': '',
            'compression_mode': '',
            'relative_file_paths': [info.name for info in self._files],
            'files': files,
            'custom_data': None,
            'ros_distro': os.environ.get('ROS_DISTRO', 'jazzy'),
        }
        return yaml.safe_dump({'rosbag2_bagfile_information': information}, sort_keys=False)
