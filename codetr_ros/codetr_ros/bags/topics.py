"""A topic as rosbag2 describes it in a bag: QoS, definition and hash of its type."""

import json
import os
import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

from codetr_ros.bags.errors import BagError
from codetr_ros.config import Settings, queues
from codetr_ros.records import TOPICS, Presence, fields

RECORDED: tuple[type, ...] = tuple(kind for kind in TOPICS if kind is not Presence)
"""Kinds of records that a run's bag holds. `Presence` only shows that a node is alive."""
_FOREVER = {'sec': 9223372036, 'nsec': 854775807}


@dataclass(frozen=True)
class BagTopic:
    """A topic as the bag describes it."""

    name: str  # fully resolved, such as /run/transitions
    type: str  # such as codetr_msgs/msg/Transitions
    depth: int
    transient_local: bool
    encoding: str = 'cdr'

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

    def digest(self) -> str:
        """REP-2016 hash of its type."""
        return type_hash(self.type)


def topics_of_run(names: Mapping[type, str], settings: Settings) -> list[BagTopic]:
    """The topics of a run's records.

    Args:
        names: the full name of each kind's topic.
        settings: of the run, which decide how deep queues are.
    """
    return [
        BagTopic(
            name,
            fields.type_name(kind),
            queues.depth(TOPICS[kind], settings),
            queues.QUALITIES[TOPICS[kind]].transient_local,
        )
        for kind, name in names.items()
    ]


@cache
def _share_folders() -> tuple[Path, ...]:
    prefixes = [p for p in os.environ.get('AMENT_PREFIX_PATH', '').split(os.pathsep) if p]
    return tuple(Path(prefix) / 'share' for prefix in (*prefixes, sys.prefix))


def _installed(package: str, name: str, suffix: str) -> Path | None:
    paths = (share / package / 'msg' / f'{name}.{suffix}' for share in _share_folders())
    return next((path for path in paths if path.is_file()), None)


def _interface_text(package: str, name: str) -> str:
    """A definition as installed, or the one that comes with the library if no ROS is installed."""
    from codetr_ros.bags import definitions

    if path := _installed(package, name, 'msg'):
        return path.read_text()
    if text := definitions.bundled_text(f'{package}/msg/{name}'):
        return text
    searched = ', '.join(str(share) for share in _share_folders())
    raise BagError(
        f'no msg file of {package}/msg/{name} in {searched}: build the workspace, or source its '
        'setup file'
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
    text = _interface_text(package, name)
    parts = [text]
    seen = {(package, name)}
    todo = list(_contained(package, text))
    while todo:
        key = todo.pop(0)
        if key in seen:
            continue
        seen.add(key)
        text = _interface_text(*key)
        parts.append(f'\n{"=" * 80}\nMSG: {key[0]}/{key[1]}\n{text}')
        todo = [*_contained(key[0], text), *todo]
    return ''.join(parts).encode()


@cache
def type_hash(type_name: str) -> str:
    """REP-2016 hash of a message type (`RIHS01_...`), from its installed description or, for types
    that come with the library, from their definition.

    Raises:
        BagError: the description is not installed or does not name the type.
    """
    from codetr_ros.bags import definitions

    package, _, name = type_name.split('/')
    path = _installed(package, name, 'json')
    if path is None:
        if definitions.bundled_text(type_name):
            return definitions.own_types().hash_rihs01(type_name)
        searched = ', '.join(str(share) for share in _share_folders())
        raise BagError(f'no json file of {type_name} in {searched}: build the workspace')
    for entry in json.loads(path.read_text())['type_hashes']:
        if entry['type_name'] == type_name:
            return str(entry['hash_string'])
    raise BagError(f'{path} has no hash of {type_name}: build the workspace again')
