"""`metadata.yaml`: what rosbag2 wants to know of a bag before it opens a file of it."""

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any, Protocol

import yaml

METADATA = 'metadata.yaml'
VERSION = 9
"""Of the file's layout, as rosbag2 of Jazzy writes it."""
LONGEST = 16 << 20
"""Bytes that the file may have."""


_LOADER: Any = getattr(yaml, 'CSafeLoader', yaml.SafeLoader)  # the same in C, ten times as fast


def load_yaml(text: bytes | str) -> Any:
    """Read YAML that a bag has.

    Raises:
        yaml.YAMLError: it is none.
    """
    return yaml.load(text, _LOADER)


def read(folder: Path) -> Any:
    """What the metadata of a bag says.

    Raises:
        OSError: it cannot be read, or there is none.
        ValueError: it is too long.
        yaml.YAMLError, UnicodeDecodeError, LookupError, TypeError, RecursionError: it is damaged.
    """
    path = folder / METADATA
    if (size := path.stat().st_size) > LONGEST:
        raise ValueError(f'it has {size} bytes, at most {LONGEST} are read')
    return load_yaml(path.read_bytes())['rosbag2_bagfile_information']


class Topic(Protocol):
    """A topic as it is to be described."""

    @property
    def name(self) -> str:
        """Its full name."""

    @property
    def type(self) -> str:
        """Such as `sensor_msgs/msg/JointState`."""

    def qos(self) -> list[dict[str, Any]]:
        """The QoS it was offered with."""

    def digest(self) -> str:
        """REP-2016 hash of its type; empty where it is not known."""


@dataclass
class BagFile:
    """One file of a bag."""

    name: str
    start: int = 0  # log time of the earliest message [ns]; 0 while there is none
    end: int = 0  # of the latest
    counts: Counter[str] = field(default_factory=Counter)  # messages by topic

    @property
    def count(self) -> int:
        """Messages in it."""
        return self.counts.total()

    def add(self, topic: str, log_time: int) -> None:
        """Count a message."""
        self.start = min(self.start, log_time) if self.count else log_time
        self.end = max(self.end, log_time)
        self.counts[topic] += 1


def render(files: Sequence[BagFile], topics: Iterable[Topic]) -> str:
    """The text of `metadata.yaml`.

    Args:
        files: of the bag, in order.
        topics: of the bag, those without messages included.
    """
    used = [file for file in files if file.count]
    start = min((file.start for file in used), default=0)
    end = max((file.end for file in used), default=0)
    counts = sum((file.counts for file in files), Counter())
    information = {
        'version': VERSION,
        'storage_identifier': 'mcap',
        'duration': {'nanoseconds': end - start},
        'starting_time': {'nanoseconds_since_epoch': start},
        'message_count': counts.total(),
        'topics_with_message_count': [
            {
                'topic_metadata': {
                    'name': topic.name,
                    'type': topic.type,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': topic.qos(),
                    'type_description_hash': topic.digest(),
                },
                'message_count': counts[topic.name],
            }
            for topic in topics
        ],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [file.name for file in files],
        'files': [
            {
                'path': file.name,
                'starting_time': {'nanoseconds_since_epoch': file.start},
                'duration': {'nanoseconds': file.end - file.start},
                'message_count': file.count,
            }
            for file in files
        ],
        'custom_data': None,
        'ros_distro': os.environ.get('ROS_DISTRO', 'jazzy'),
    }
    return yaml.safe_dump({'rosbag2_bagfile_information': information}, sort_keys=False)


def check(
    folder: Path, found: Mapping[str, tuple[str, int]], files: Mapping[str, int]
) -> Iterator[str]:
    """What a bag's `metadata.yaml` says that is not so.

    Args:
        folder: the bag.
        found: type and number of messages of each topic.
        files: messages in each file, by its name.

    Yields:
        One sentence for each contradiction.
    """
    path = folder / METADATA
    if not path.exists():
        yield f'{METADATA} is missing: `ros2 bag` does not open the bag without it'
        return
    try:
        yield from _contradictions(read(folder), found, files)
    except (
        OSError,
        yaml.YAMLError,
        LookupError,
        TypeError,
        ValueError,
        RecursionError,
        AttributeError,
    ) as error:
        yield f'{METADATA} cannot be read: {str(error) or type(error).__name__}'


def _contradictions(
    said: Mapping[str, Any], found: Mapping[str, tuple[str, int]], files: Mapping[str, int]
) -> Iterator[str]:
    if not 1 <= int(said['version']) <= VERSION:
        yield f'{METADATA} is of version {said["version"]}, known are 1 to {VERSION}'
    storage = {'mcap': '.mcap', 'sqlite3': '.db3'}.get(said['storage_identifier'])
    if not storage or not all(storage in name for name in files):
        yield f'{METADATA} says that the files are {said["storage_identifier"]}'
    listed = [PurePath(name).name for name in said['relative_file_paths']]
    for name in files.keys() - set(listed):
        yield f'{METADATA} does not list {name}'
    total = sum(files.values())
    if said['message_count'] != total:
        yield f'{METADATA} counts {said["message_count"]} messages, there are {total}'
    for file in said.get('files') or ():
        name = PurePath(file['path']).name
        if name in files and file['message_count'] != files[name]:
            yield (
                f'{METADATA} counts {file["message_count"]} messages in {name}, there are '
                f'{files[name]}'
            )
    topics = {}
    for topic in said['topics_with_message_count']:
        kind = topic['topic_metadata']['type']
        topics[topic['topic_metadata']['name']] = kind, topic['message_count']
    for name in sorted(topics.keys() | found.keys()):
        there, told = found.get(name, ('', 0)), topics.get(name, ('', 0))
        if there[1] != told[1] or (there[0] and told[0] and there[0] != told[0]):
            yield (
                f'{METADATA} has {told[1]} messages of {name} ({told[0] or "no type"}), there are '
                f'{there[1]} ({there[0] or "no type"})'
            )
