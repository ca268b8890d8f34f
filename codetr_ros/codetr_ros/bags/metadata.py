"""`metadata.yaml`: what rosbag2 wants to know of a bag before it opens a file of it."""

import os
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import yaml

from codetr_ros.bags.topics import BagTopic, type_hash

METADATA = 'metadata.yaml'
VERSION = 9
"""Of the file's layout, as rosbag2 of Jazzy writes it."""


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


def render(files: Sequence[BagFile], topics: Iterable[BagTopic]) -> str:
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
                    'type_description_hash': type_hash(topic.type),
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
