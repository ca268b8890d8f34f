"""The definitions that bags carry, of messages of any type. No ROS needed."""

import re
from functools import cache
from typing import NamedTuple

from rosbags.interfaces.typing import Typesdict
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
from codetr_ros.records.names import full_type_name
from codetr_ros.system.parsing import brief

LONGEST_DEFINITION = 1 << 20
"""The most characters of a definition in a bag, with all that it contains."""

UNREADABLE = (SerdeError, TypesysError, LookupError, OverflowError, RecursionError)
"""What decoding a message by a definition from a bag can raise."""
_LINE = '=' * 80  # rosbag2 puts it, and a heading, before each definition but a .msg file's first
_HEADING = re.compile(r'(MSG|IDL): *(\S+)\s*\n')


class Definition(NamedTuple):
    """The definition of a message type, as a bag carries it."""

    encoding: str  # 'ros2msg', 'ros2idl', or empty: the bag has none
    text: str
    digest: str = ''  # REP-2016 hash, where the bag has one


OWN = Definition('', '')
"""Stands for what a bag leaves open: the definition of this version."""


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
