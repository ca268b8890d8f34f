"""Bags made without this project's own writer: records, or anything, through that of rosbags."""

from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from codetr_ros.bags.definitions import SIGNATURE_BYTES
from codetr_ros.records import TOPICS, Record

MESSAGES = Path(__file__).resolve().parents[2] / 'msgs' / 'msg'
STEP = 1_000_000  # [ns] between two messages


def types() -> Any:
    """Jazzy's message types and ours."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for path in MESSAGES.glob('*.msg'):
        store.register(get_types_from_msg(path.read_text(), f'codetr_msgs/msg/{path.stem}'))
    return store


def message(store: Any, record: Record) -> Any:
    """The message of a record, which nobody signed."""
    values = {}
    for f in fields(record):
        value = getattr(record, f.name)
        if isinstance(value, np.ndarray):
            value = value.ravel()
        elif isinstance(value, bytes):
            value = np.frombuffer(value, np.uint8)
        elif isinstance(value, tuple):
            value = list(value)
        values[f.name] = value
    stamp = store.types['builtin_interfaces/msg/Time'](1, 2)
    unsigned = {'sender': '', 'signature': np.zeros(SIGNATURE_BYTES, np.uint8)}
    return store.types[f'codetr_msgs/msg/{type(record).__name__}'](
        stamp=stamp, **values, **unsigned
    )


def write(
    folder: Path,
    records: Iterable[Record],
    namespace: str = '/run_calls',
    storage: StoragePlugin = StoragePlugin.MCAP,
) -> Path:
    """A bag of these records, in this order."""
    return write_messages(
        folder,
        (
            (f'{namespace}/{TOPICS[type(r)]}', lambda store, r=r: message(store, r))
            for r in records
        ),
        storage,
    )


def write_messages(
    folder: Path,
    made: Iterable[tuple[str, Any]],
    storage: StoragePlugin = StoragePlugin.MCAP,
) -> Path:
    """A bag of (topic, function that makes a message of a type store[, time])."""
    store = types()
    folder.parent.mkdir(parents=True, exist_ok=True)
    connections: dict[str, Any] = {}
    with Writer(folder, version=9, storage_plugin=storage) as writer:
        for i, (topic, make, *when) in enumerate(made):
            one = make(store)
            kind = one.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            time = when[0] if when else (i + 1) * STEP
            writer.write(connections[topic], time, store.serialize_cdr(one, kind))
    return folder
