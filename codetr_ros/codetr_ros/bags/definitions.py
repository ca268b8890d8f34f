"""The definitions of our messages, which come with the library, and records from their bytes. No
ROS needed.

A bag carries the definitions of its messages. Before a type is read, the bag's definition is
compared with this version's, field by field: bytes read by a wrong definition would be other
numbers. An older definition of ours, which lacks fields at the end, is read as it is.
"""

import struct
from collections.abc import Callable
from dataclasses import MISSING, fields
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Fielddefs
from rosbags.serde import SerdeError
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from codetr_ros.bags.errors import BagError
from codetr_ros.bags.schemas import OWN, Definition, parsed
from codetr_ros.records import Record, RecordError
from codetr_ros.records.fields import RECORD_TYPES, record_of, type_name

_TEXTS = Path(__file__).parent / 'msg'  # the files of the message package itself
_TIME = {'builtin_interfaces/msg/Time': 'int32 sec\nuint32 nanosec'}
SIGNATURE_BYTES = 32
"""The last bytes of a message: zeros where it is not signed."""
_UNREADABLE = (SerdeError, IndexError, OverflowError)


def bundled_text(name: str) -> str | None:
    """The definition of one of our types, or of a type that they contain, without the types that
    it contains itself. None for any other type.
    """
    if name in RECORD_TYPES:
        return (_TEXTS / f'{RECORD_TYPES[name].__name__}.msg').read_text()
    return _TIME.get(name)


@cache
def own_types() -> Typestore:
    """The definitions that this version of the library expects and writes."""
    store = get_typestore(Stores.EMPTY)
    for name in (*_TIME, *RECORD_TYPES):
        text = bundled_text(name)
        assert text is not None
        store.register(get_types_from_msg(text, name))
    return store


def _described(given: Fielddefs) -> list[str]:
    def kind(node: Any) -> str:
        if node[0] == Nodetype.BASE:
            return str(node[1][0])
        if node[0] == Nodetype.NAME:
            return str(node[1])
        length = node[1][1] or ''
        return f'{kind(node[1][0])}[{length}]'

    return [f'{kind(node)} {name}' for name, node in given]


class _Reading(NamedTuple):
    """How messages of one of our types are read by the definition in a bag."""

    store: Typestore
    conversions: tuple[tuple[str, Callable[[Any], Any]], ...]  # of each field that it has


def check_own(name: str, definition: Definition) -> None:
    """Refuse a bag whose definition of one of our types cannot be read as ours.

    An older definition lacks fields at the end, because fields are only ever appended: it is read
    as it is, and records get the defaults of what is missing. Nothing else may differ.

    Raises:
        BagError: names the type, and the first field that differs.
    """
    _reading(name, definition)


def is_own(name: str, definition: Definition) -> bool:
    """Whether a bag's messages of one of our types have the bytes that this version writes.

    Raises:
        BagError: as `check_own`.
    """
    return _reading(name, definition).store is own_types()


def text_of(name: str, definition: Definition) -> tuple[str, str]:
    """Encoding and text of a type's definition: the bag's own, or for one of our types of which
    the bag has only the hash, or nothing, ours or an older one. Both empty for any other type.
    """
    if definition.encoding or bundled_text(name) is None:
        return definition.encoding, definition.text
    store = _hashed(name, definition.digest)
    if store is None or store is own_types():
        return 'ros2msg', bundled_text(name) or ''
    return 'ros2msg', store.generate_msgdef(name, ros_version=2)[0]


def _reading(name: str, definition: Definition) -> _Reading:
    made = _made_reading(name, definition)
    if isinstance(made, str):
        raise BagError(f'{made}: read it with the version that wrote it')
    return made


@cache
def _made_reading(name: str, definition: Definition) -> _Reading | str:
    """How messages are read, or why they cannot be."""
    if not definition.encoding:
        store = _hashed(name, definition.digest)
        if store is None:
            expected = own_types().hash_rihs01(name)
            return f'{name} has the hash {definition.digest}, this version reads {expected}'
        return _Reading(store, _conversions(name, store))
    try:
        types = parsed(name, definition)
    except BagError as error:
        return str(error)
    for contained in types:
        if text := _difference(contained, types[contained][1], older=contained == name):
            return text
    store = own_types()
    if len(types[name][1]) < len(store.fielddefs[name][1]):
        store = _cut(name, len(types[name][1]))
    return _Reading(store, _conversions(name, store))


def _difference(name: str, given: Fielddefs, older: bool) -> str:
    """What differs from our definition of a type, in words; empty if nothing does.

    Args:
        name: of the type; others than ours are not compared.
        given: its fields in the bag.
        older: whether fields that records can do without may be missing at the end.
    """
    if name not in own_types().fielddefs:
        return ''
    ours, theirs = _described(own_types().fielddefs[name][1]), _described(given)
    needed = _needed(name) if older else len(ours)
    for i in range(max(needed, len(theirs))):
        here = ours[i] if i < len(ours) else 'nothing'
        there = theirs[i] if i < len(theirs) else 'nothing'
        if here != there:
            return (
                f'{name} is defined otherwise: field {i + 1} is {there!r} there, '
                f'{here!r} in this version'
            )
    return ''


def _needed(name: str) -> int:
    """How many of the fields of a type, from the first on, every definition of it has had: those
    that records have no default for, and what lies between them.
    """
    kind = RECORD_TYPES.get(name)
    names = [field for field, _ in own_types().fielddefs[name][1]]
    if kind is None:
        return len(names)
    without = [f.name for f in fields(kind) if f.default is MISSING]
    return 1 + max(map(names.index, without), default=-1)


@cache
def _hashed(name: str, digest: str) -> Typestore | None:
    """The types of which one of ours has this hash, as it is or as it was before fields were
    appended; those of this version where there is no hash. None if no version had it.
    """
    ours = own_types()
    if digest in ('', ours.hash_rihs01(name)):
        return ours
    sizes = range(_needed(name), len(ours.fielddefs[name][1]))
    older = (_cut(name, size) for size in sizes)
    return next((store for store in older if store.hash_rihs01(name) == digest), None)


@cache
def _cut(name: str, size: int) -> Typestore:
    """The types of this version, one of them with its first fields only, as it was before."""
    constants, given = own_types().fielddefs[name]
    store = get_typestore(Stores.EMPTY)
    store.register({**own_types().fielddefs, name: (constants, given[:size])})
    return store


def _conversions(name: str, store: Typestore) -> tuple[tuple[str, Callable[[Any], Any]], ...]:
    """The conversion of each field of a decoded message for a record: arrays are copied."""
    nodes = dict(store.fielddefs[name][1])
    conversions: list[tuple[str, Callable[[Any], Any]]] = []
    for field in fields(RECORD_TYPES[name]):
        if field.name not in nodes:
            continue
        node: Any = nodes[field.name]
        element = node[1][0][1][0] if node[0] == Nodetype.SEQUENCE else None
        if element == 'string':
            conversions.append((field.name, tuple))
        elif element == 'uint8':
            conversions.append((field.name, lambda value: value.tobytes()))
        elif element:
            conversions.append((field.name, lambda value: value.copy()))
        else:
            conversions.append((field.name, lambda value: value))
    return tuple(conversions)


def decode(record_type: type, data: bytes | memoryview, definition: Definition = OWN) -> Record:
    """The record in the CDR bytes of its message.

    It takes no more memory than the bytes, whatever lengths they claim.

    Args:
        record_type: its kind.
        data: the bytes.
        definition: that of the bag, by which the bytes are read; by default that of this version.

    Raises:
        BagError: the definition is neither ours nor an older one of ours.
        RecordError: the bytes are no such message, or its lengths disagree.
    """
    return decode_sent(record_type, data, definition)[0]


def decode_sent(
    record_type: type, data: bytes | memoryview, definition: Definition = OWN
) -> tuple[Record, str]:
    """The record in the CDR bytes of its message, and who sent it.

    Args:
        record_type: its kind.
        data: the bytes.
        definition: that of the bag, by which the bytes are read; by default that of this version.

    Returns:
        The record, and the instance id of the process that published it; empty if not stated.

    Raises:
        BagError: the definition is neither ours nor an older one of ours.
        RecordError: the bytes are no such message, or its lengths disagree.
    """
    name = type_name(record_type)
    store, conversions = _reading(name, definition)
    try:
        message = store.deserialize_cdr(data, name)
    except _UNREADABLE as error:
        raise RecordError(f'{record_type.__name__} cannot be decoded: {error}') from error
    values = {field: inward(getattr(message, field)) for field, inward in conversions}
    return record_of(record_type, values), getattr(message, 'sender', '')


def sender_of(record_type: type, data: bytes) -> str:
    """Who sent a message, also where its content is no sound record; empty if not stated.

    Args:
        record_type: what it should be.
        data: CDR.
    """
    name = type_name(record_type)
    try:
        return str(getattr(_reading(name, OWN)[0].deserialize_cdr(data, name), 'sender', ''))
    except _UNREADABLE:
        return ''


def stamp_of(data: bytes) -> int:
    """When a message was published [ns], from its CDR bytes: the first field of all our types.

    Raises:
        struct.error: the bytes are too few.
    """
    seconds, nanoseconds = struct.unpack_from('<iI' if data[1] & 1 else '>iI', data, 4)
    return int(seconds * 10**9 + nanoseconds)


def encode(
    record: Record, stamp: int = 0, definition: Definition = OWN, sender: str = ''
) -> bytes:
    """The CDR bytes of a record's message.

    Args:
        record: the content of the message.
        stamp: when it is published [ns].
        definition: that of the bag for which they are; by default that of this version.
        sender: instance id of the process that publishes it. The message is not signed.

    Raises:
        BagError: the definition is neither ours nor an older one of ours.
        RecordError: a number does not fit its field.
    """
    name = type_name(type(record))
    store, _ = _reading(name, definition)
    values: list[Any] = [store.types['builtin_interfaces/msg/Time'](*divmod(stamp, 10**9))]
    of_message = {'sender': sender, 'signature': np.zeros(SIGNATURE_BYTES, np.uint8)}
    for field, node in store.fielddefs[name][1][1:]:
        value = of_message[field] if field in of_message else getattr(record, field)
        if isinstance(value, tuple):
            value = list(value)
        elif isinstance(value, bytes):
            value = np.frombuffer(value, np.uint8)
        elif isinstance(value, np.ndarray) and field not in of_message:
            element: Any = node[1][0]
            value = np.ascontiguousarray(value, element[1][0]).reshape(-1)
        values.append(value)
    try:
        return bytes(store.serialize_cdr(store.types[name](*values), name))
    except (SerdeError, struct.error, OverflowError) as error:
        raise RecordError(f'{type(record).__name__} cannot be written: {error}') from error
