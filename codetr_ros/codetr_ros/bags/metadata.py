"""`metadata.yaml`: what rosbag2 reads about a bag before it opens any of its files."""

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path, PurePath
from typing import Any, Protocol

import yaml

from codetr_ros.records.names import full_name, full_type_name
from codetr_ros.system.parsing import ParseError, brief, read_yaml

METADATA = 'metadata.yaml'
VERSION = 9
"""Version of the file's layout, as rosbag2 of Jazzy writes it."""
LONGEST = 16 << 20
"""The most bytes of the file."""

_ROOT = 'rosbag2_bagfile_information'
_FILES = 'relative_file_paths'
_DUMPER = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)  # the same text, sooner


def read(folder: Path) -> Any:
    """The content of a bag's metadata.

    Raises:
        OSError: it cannot be read, or there is none.
        ParseError: it is damaged.
    """
    content = read_yaml(folder / METADATA, LONGEST, unique=False)
    if not isinstance(content, Mapping) or not isinstance(content.get(_ROOT), Mapping):
        raise ParseError(f'has no mapping under the key {_ROOT}')
    return content[_ROOT]


def listed(folder: Path) -> list[str]:
    """Names of the files that a bag's metadata lists; the errors are those of `read`."""
    paths = read(folder).get(_FILES)
    if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
        raise ParseError(f'has no list of names under {_ROOT}.{_FILES}')
    return [PurePath(path).name for path in paths]


class DescribedTopic(Protocol):
    """A topic as the metadata describes it."""

    @property
    def name(self) -> str:
        """Its full name."""

    @property
    def type(self) -> str:
        """Such as `sensor_msgs/msg/JointState`."""

    @property
    def encoding(self) -> str:
        """The serialisation of its messages, such as `cdr`."""

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


def render(files: Sequence[BagFile], topics: Iterable[DescribedTopic]) -> str:
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
                    'serialization_format': topic.encoding,
                    'offered_qos_profiles': topic.qos(),
                    'type_description_hash': topic.digest(),
                },
                'message_count': counts[topic.name],
            }
            for topic in topics
        ],
        'compression_format': '',
        'compression_mode': '',
        _FILES: [file.name for file in files],
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
    return str(yaml.dump({_ROOT: information}, Dumper=_DUMPER, sort_keys=False))


def check(
    folder: Path, topics: Mapping[str, tuple[str, int, str]], files: Mapping[str, int]
) -> Iterator[str]:
    """Compare a bag's `metadata.yaml` with the bag.

    Args:
        folder: the bag.
        topics: type, number of messages and serialisation of each topic that was read.
        files: messages in each file, by its name.

    Yields:
        One sentence for each contradiction.
    """
    path = folder / METADATA
    if not path.exists():
        yield f'{METADATA} is missing: `ros2 bag` does not open the bag without it'
        return
    try:
        yield from _contradictions(read(folder), topics, files)
    except (OSError, LookupError, TypeError, ValueError, AttributeError) as error:
        yield f'{METADATA} cannot be read: {brief(error)}'


def _contradictions(
    content: Mapping[str, Any],
    topics: Mapping[str, tuple[str, int, str]],
    files: Mapping[str, int],
) -> Iterator[str]:
    if not 1 <= int(content['version']) <= VERSION:
        yield f'{METADATA} is of version {content["version"]}, only 1 to {VERSION} are known'
    storage = {'mcap': '.mcap', 'sqlite3': '.db3'}.get(content['storage_identifier'])
    if not storage or not all(storage in name for name in files):
        yield f'{METADATA} states that the files are {content["storage_identifier"]}'
    listed = [PurePath(name).name for name in content[_FILES]]
    for name in files.keys() - set(listed):
        yield f'{METADATA} does not list {name}'
    total = sum(files.values())
    if content['message_count'] != total:
        yield f'{METADATA} counts {content["message_count"]} messages, there are {total}'
    for file in content.get('files') or ():
        name = PurePath(file['path']).name
        if name in files and file['message_count'] != files[name]:
            yield (
                f'{METADATA} counts {file["message_count"]} messages in {name}, there are '
                f'{files[name]}'
            )
    described = {}
    for topic in content['topics_with_message_count']:
        kind = full_type_name(topic['topic_metadata']['type'])
        name = full_name(topic['topic_metadata']['name'])
        described[name] = kind, topic['message_count']
        stated = topic['topic_metadata'].get('serialization_format', '')
        if name in topics and stated != topics[name][2]:
            yield (
                f'{METADATA} states that {name} is serialised as {stated!r}, its file states '
                f'{topics[name][2]!r}'
            )
    for name in sorted(described.keys() | topics.keys()):
        kind, count, _ = topics.get(name, ('', 0, ''))
        stated_kind, stated_count = described.get(name, ('', 0))
        if count != stated_count or (kind and stated_kind and kind != stated_kind):
            yield (
                f'{METADATA} has {stated_count} messages of {name} ({stated_kind or "no type"}), '
                f'there are {count} ({kind or "no type"})'
            )
