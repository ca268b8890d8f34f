"""The definitions of our messages, which come with the library, and records from their bytes. No
ROS needed.

A bag carries the definitions of its messages. Before a type is read, the bag's definition is
compared with this version's, field by field: bytes read by a wrong definition would be other
numbers.
"""

import re
import struct
from collections.abc import Callable
from dataclasses import fields
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Fielddefs, Typesdict
from rosbags.serde import SerdeError
from rosbags.typesys import (
    Stores,
    TypesysError,
    get_types_from_idl,
    get_types_from_msg,
    get_typestore,
)
from rosbags.typesys.store import Typestore

from codetr_ros.bags.errors import BagError
from codetr_ros.records import Record, RecordError
from codetr_ros.records.fields import RECORD_TYPES, record_of, type_name
from codetr_ros.records.names import full_type_name
from codetr_ros.system.parsing import brief

LONGEST_DEFINITION = 1 << 20
"""The most characters of a definition in a bag, with all that it contains."""

_TEXTS = Path(__file__).parent / 'msg'  # the files of the message package itself
_TIME = {'builtin_interfaces/msg/Time': 'int32 sec\nuint32 nanosec'}
_UNREADABLE = (SerdeError, IndexError, OverflowError)
UNREADABLE = (SerdeError, TypesysError, LookupError, OverflowError, RecursionError)
"""What decoding a message by a definition from a bag can raise."""
_LINE = '=' * 80  # rosbag2 puts it, and a heading, before each definition but a .msg file's first
_HEADING = re.compile(r'(MSG|IDL): *(\S+)\s*\n')


class Definition(NamedTuple):
    """The definition of a message type, as a bag carries it."""

    encoding: str  # 'ros2msg', 'ros2idl', or empty: the bag has none
    text: str
    digest: str = ''  # REP-2016 hash, where the bag has one


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


def parsed(name: str, definition: Definition) -> Typesdict:
    """The types that a bag's definition describes, the type itself among them.

    Raises:
        BagError: the definition cannot be read.
    """
    encoding, text = definition.encoding, definition.text
    if encoding not in ('ros2msg', 'ros2idl'):
        raise BagError(f'{name} is defined in {encoding!r}: only ros2msg and ros2idl are known')
    if len(text) > LONGEST_DEFINITION:
        raise BagError(
            f'the definition of {name} has {len(text)} characters, '
            f'at most {LONGEST_DEFINITION} are read'
        )
    try:
        types = get_types_from_msg(text, name) if encoding == 'ros2msg' else _idl_types(text)
    except (TypesysError, ValueError, LookupError, RecursionError) as error:
        raise BagError(f'the definition of {name} cannot be read: {brief(error)}') from error
    if name not in types:
        raise BagError(f'the definition of {name} does not define it')
    return types


def _idl_types(text: str) -> Typesdict:
    """The types of an IDL definition as rosbag2 writes it: each file of the type, and of the types
    that it contains, behind a line of = and a heading, with its `#include` lines.
    """
    types: Typesdict = {}
    for piece in re.split(rf'^{_LINE}=*\s*\n', text, flags=re.MULTILINE):
        heading = _HEADING.match(piece)
        body = piece[heading.end() :] if heading else piece
        if heading and heading[1] == 'MSG':
            types |= get_types_from_msg(body, full_type_name(heading[2]))
        elif body.strip():
            types |= get_types_from_idl(re.sub(r'^[ \t]*#.*$', '', body, flags=re.MULTILINE))
    return types


def _described(fields: Fielddefs) -> list[str]:
    def kind(node: Any) -> str:
        if node[0] == Nodetype.BASE:
            return str(node[1][0])
        if node[0] == Nodetype.NAME:
            return str(node[1])
        length = node[1][1] or ''
        return f'{kind(node[1][0])}[{length}]'

    return [f'{kind(node)} {name}' for name, node in fields]


def check_own(name: str, definition: Definition) -> None:
    """Refuse a bag whose definition of one of our types differs from ours.

    Raises:
        BagError: names the type, and the first field that differs.
    """
    if text := _difference(name, definition):
        raise BagError(f'{text}: read it with the version that wrote it')


@cache
def _difference(name: str, definition: Definition) -> str:
    store = own_types()
    if not definition.encoding:
        expected = store.hash_rihs01(name)
        if definition.digest in ('', expected):
            return ''
        return f'{name} has the hash {definition.digest}, this version reads {expected}'
    try:
        types = parsed(name, definition)
    except BagError as error:
        return str(error)
    for contained, (_, given) in types.items():
        if contained not in store.fielddefs:
            continue
        ours, theirs = _described(store.fielddefs[contained][1]), _described(given)
        for i in range(max(len(ours), len(theirs))):
            here = ours[i] if i < len(ours) else 'nothing'
            there = theirs[i] if i < len(theirs) else 'nothing'
            if here != there:
                return (
                    f'{contained} is defined otherwise: field {i + 1} is {there!r} there, '
                    f'{here!r} in this version'
                )
    return ''


@cache
def _inward(record_type: type) -> tuple[tuple[str, Callable[[Any], Any]], ...]:
    """The conversion of each field of a decoded message for a record: arrays are copied."""
    nodes = dict(own_types().fielddefs[type_name(record_type)][1])
    conversions: list[tuple[str, Callable[[Any], Any]]] = []
    for field in fields(record_type):
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


def decode(record_type: type, data: bytes | memoryview) -> Record:
    """The record in the CDR bytes of its message.

    It takes no more memory than the bytes, whatever lengths they claim.

    Raises:
        RecordError: the bytes are no such message, or its lengths disagree.
    """
    try:
        message = own_types().deserialize_cdr(data, type_name(record_type))
    except _UNREADABLE as error:
        raise RecordError(f'{record_type.__name__} cannot be decoded: {error}') from error
    values = {name: inward(getattr(message, name)) for name, inward in _inward(record_type)}
    return record_of(record_type, values)


def encode(record: Record, stamp: int = 0) -> bytes:
    """The CDR bytes of a record's message.

    Args:
        record: the content of the message.
        stamp: when it is published [ns].

    Raises:
        RecordError: a number does not fit its field.
    """
    name = type_name(type(record))
    store = own_types()
    values = [store.types['builtin_interfaces/msg/Time'](*divmod(stamp, 10**9))]
    for field, node in store.fielddefs[name][1][1:]:
        value = getattr(record, field)
        if isinstance(value, tuple):
            value = list(value)
        elif isinstance(value, bytes):
            value = np.frombuffer(value, np.uint8)
        elif isinstance(value, np.ndarray):
            element: Any = node[1][0]
            value = np.ascontiguousarray(value, element[1][0]).reshape(-1)
        values.append(value)
    try:
        return bytes(store.serialize_cdr(store.types[name](*values), name))
    except (SerdeError, struct.error, OverflowError) as error:
        raise RecordError(f'{type(record).__name__} cannot be written: {error}') from error


@cache
def types_of(name: str, definition: Definition) -> Typestore:
    """The types to decode a message by: as the bag defines them, or as ROS 2 Jazzy does where the
    bag has no definition.

    Raises:
        BagError: the type is not known, or its definition cannot be used.
    """
    if not name:
        raise BagError('the bag does not state of what type its messages are')
    if not definition.encoding:
        store = get_typestore(Stores.ROS2_JAZZY)
        if name not in store.fielddefs:
            raise BagError(f'the bag has no definition of {name}, and ROS 2 Jazzy has none')
        return store
    types = parsed(name, definition)
    store = get_typestore(Stores.EMPTY)
    try:
        store.register(types)
        store.get_msgdef(name)
    except UNREADABLE as error:
        raise BagError(f'the definition of {name} cannot be used: {brief(error)}') from error
    return store
