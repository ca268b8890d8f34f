"""A reader until there is `bags.reader`."""

from collections.abc import Iterable, Iterator
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.highlevel import AnyReader

from codetr_ros import records
from codetr_ros.records import TOPICS, Record


class Entry(NamedTuple):
    """A message."""

    kind: type
    record: Record
    topic: str
    log_time: int
    publish_time: int
    place: str


class Bag:
    """A bag."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def entries(self, kinds: Iterable[type] | None = None) -> Iterator[Entry]:
        """Records."""
        names = {f'codetr_msgs/msg/{k.__name__}': k for k in kinds or TOPICS}
        with AnyReader([self.path]) as reader:
            wanted = [c for c in reader.connections if c.msgtype in names]
            for c, time, raw in reader.messages(wanted) if wanted else ():
                kind = names[c.msgtype]
                message = reader.deserialize(raw, c.msgtype)
                values: dict[str, Any] = {}
                for f in fields(kind):
                    value = getattr(message, f.name)
                    if isinstance(value, np.ndarray):
                        value = value.tobytes() if value.dtype == np.uint8 else value.copy()
                    values[f.name] = tuple(value) if isinstance(value, list) else value
                if kind is records.Transitions:
                    n = values['steps']
                    values['observations'] = values['observations'].reshape(n + 1, -1)
                    values['actions'] = values['actions'].reshape(n, -1)
                yield Entry(kind, kind(**values), c.topic, time, time, 'somewhere')
