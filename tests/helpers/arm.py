"""Bags of a plain arm, as anybody's recorder may leave them: ordinary types, in any file order."""

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import Stores, get_typestore

NS = 10**9
NOON = 1_700_000_000 * NS  # [ns] of a wall clock
STORE = get_typestore(Stores.ROS2_JAZZY)
TYPES = STORE.types
JOINTS = ('a', 'b')


class Sent(NamedTuple):
    """A message and when it was received."""

    topic: str
    time: int  # [ns]
    message: Any


def header(time: int) -> Any:
    """A header of this time [ns]."""
    stamp = TYPES['builtin_interfaces/msg/Time'](time // NS, time % NS)
    return TYPES['std_msgs/msg/Header'](stamp, '')


def joint_state(time: int, names: Iterable[str], positions: Iterable[float]) -> Any:
    """A JointState of positions alone."""
    empty = np.empty(0)
    values = np.array(list(positions), float)
    return TYPES['sensor_msgs/msg/JointState'](header(time), list(names), values, empty, empty)


def array_of(values: Iterable[float]) -> Any:
    """A Float64MultiArray."""
    layout = TYPES['std_msgs/msg/MultiArrayLayout']([], 0)
    return TYPES['std_msgs/msg/Float64MultiArray'](layout, np.array(list(values), float))


def number(value: float) -> Any:
    """A Float64."""
    return TYPES['std_msgs/msg/Float64'](float(value))


def attempt(steps: int = 40, begin: int = NOON, every: int = 10, first: int = 0) -> list[Sent]:
    """Joint states of (i, -i) every 20 ms, each followed after 5 ms by a command, and every
    `every` commands after 5 ms more by a score of i; i counts from `first`.
    """
    sent = []
    for n in range(steps + 1):
        i, time = first + n, begin + n * 20_000_000
        sent.append(Sent('/joint_states', time, joint_state(time, JOINTS, [i, -i])))
        if n < steps:
            sent.append(Sent('/cmd', time + 5_000_000, array_of([i / 1000, 0])))
            if (n + 1) % every == 0:
                sent.append(Sent('/score', time + 10_000_000, number(i)))
    return sent


def rules(**changes: Any) -> dict[str, Any]:
    """The mapping of such a bag."""
    joints = {'topic': '/joint_states', 'fields': ['position'], 'joints': list(JOINTS)}
    plain = {
        'observation': [joints],
        'action': {'topic': '/cmd', 'fields': ['data']},
        'score': {'topic': '/score', 'field': 'data'},
    }
    return plain | changes


def mcap_file(
    path: Path,
    sent: Iterable[Sent],
    encoding: str = 'cdr',
    chunk_bytes: int = 1 << 20,
    chunked: bool = True,
    finish: bool = True,
) -> Path:
    """An MCAP file with the messages in this order, by mcap's own writer."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open('wb') as file:
        writer: Any = McapWriter(file, chunk_bytes, CompressionType.NONE, use_chunking=chunked)
        writer.start('ros2', 'somebody')
        channels: dict[str, int] = {}
        for topic, time, message in sent:
            kind = message.__msgtype__
            if topic not in channels:
                text = STORE.generate_msgdef(kind)[0].encode()
                schema = writer.register_schema(kind, 'ros2msg', text)
                channels[topic] = writer.register_channel(topic, encoding, schema)
            data = bytes(STORE.serialize_cdr(message, kind))
            writer.add_message(channels[topic], time, data, time, 0)
        if finish:
            writer.finish()
    return path


def bag(
    folder: Path, sent: Iterable[Sent], storage: StoragePlugin = StoragePlugin.SQLITE3
) -> Path:
    """A bag with the messages in this order, by rosbags' own writer."""
    with RosbagsWriter(folder, version=9, storage_plugin=storage) as writer:
        topics: dict[str, Any] = {}
        for topic, time, message in sent:
            kind = message.__msgtype__
            if topic not in topics:
                topics[topic] = writer.add_connection(topic, kind, typestore=STORE)
            writer.write(topics[topic], time, STORE.serialize_cdr(message, kind))
    return folder


def files_of(folder: Path) -> Iterator[Path]:
    """The files of a bag with messages."""
    yield from (path for path in sorted(folder.iterdir()) if path.suffix in ('.mcap', '.db3'))
