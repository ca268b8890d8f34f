"""Values in messages, named by paths such as `pose.position.x` or `poses[1].y`."""

import re
from typing import Annotated, Any, Literal, Protocol

import numpy as np
from pydantic import AfterValidator, Field

from codetr_ros.config import Group, in_words
from codetr_ros.records.names import full_name
from codetr_ros.robots.errors import MessageError

NS = 10**9

Topic = Annotated[
    str,
    Field(pattern=in_words(r'^/?[^\s/]\S*$', 'the name of a topic, such as /joint_states')),
    AfterValidator(full_name),
]
FieldPath = Annotated[
    str,
    Field(
        pattern=in_words(
            r'^[A-Za-z_]\w*(\[\d+\])?(\.[A-Za-z_]\w*(\[\d+\])?)*$',
            'the path of a number in a message, such as position[0] or pose.position.x',
        )
    ),
]

Clock = Literal['log', 'header']


class Message(Protocol):
    """A message of a robot's topic, received live or read from a bag."""

    @property
    def topic(self) -> str:
        """Full name of its topic."""

    @property
    def message(self) -> Any:
        """Its content."""


class Timed(Group):
    """Messages of a topic."""

    topic: Topic = Field(description='full name')
    time: Clock | None = Field(
        None, description='log or header, where it is not the `time` of the whole mapping'
    )


_PART = re.compile(r'(\w+)(?:\[(\d+)\])?$')


def field(message: Any, path: str, topic: str) -> Any:
    """The value of a field of a message.

    Raises:
        MessageError: the message has no such field or element.
    """
    value = message
    for part in path.split('.'):
        matched = _PART.match(part)
        assert matched is not None  # by the pattern of the mapping
        name, index = matched[1], matched[2]
        if not hasattr(value, name):
            there = [n for n in getattr(value, '__dict__', ()) if not n.startswith('_')]
            raise MessageError(
                f'{topic} has no field {path!r}: there is no {name!r} in '
                + (', '.join(there) or type(value).__name__)
            )
        value = getattr(value, name)
        if index is not None:
            if not hasattr(value, '__len__') or int(index) >= len(value):
                raise MessageError(f'{topic} has no element {path!r} in a message')
            value = value[int(index)]
    return value


def number(message: Any, path: str, topic: str) -> float:
    """The number in a field.

    Raises:
        MessageError: there is no such field, or it holds no number.
    """
    value = field(message, path, topic)
    try:
        return float(value)
    except OverflowError:
        return float('inf')
    except (TypeError, ValueError):
        raise MessageError(f'{topic}: field {path!r} holds no number') from None


def moment(message: Any, path: str, topic: str) -> int:
    """The time [ns] in a field: a `builtin_interfaces/Time`, an integer number of nanoseconds, or
    a number of seconds with a fraction.

    Raises:
        MessageError: there is no such field, or it holds no time.
    """
    value = field(message, path, topic)
    if hasattr(value, 'sec') and hasattr(value, 'nanosec'):
        return int(value.sec) * NS + int(value.nanosec)
    if isinstance(value, int | np.integer) and not isinstance(value, bool):
        return int(value)
    if isinstance(value, float | np.floating) and np.isfinite(value):
        return round(float(value) * NS)
    raise MessageError(
        f'{topic}: field {path!r} = {value!r} holds no time: name a builtin_interfaces/Time (such '
        'as header.stamp), an integer number of nanoseconds, or a fractional number of seconds'
    )


def name_in(message: Any, path: str, topic: str) -> str:
    """The name or number in a field, as text: it is compared with that of another message.

    Raises:
        MessageError: there is no such field, or it holds neither a text nor numbers.
    """
    value = field(message, path, topic)
    if isinstance(value, np.ndarray | np.generic):  # an array such as the 16 bytes of a UUID
        value = value.tolist()
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    if isinstance(value, str | int | float | list):
        return str(value)
    raise MessageError(
        f'{topic}: field {path!r} holds no name: it must be a text, a number or an array of '
        f'numbers, not {type(value).__name__}'
    )
