"""Makes the messages of a robot's command topic from numbers, whatever their type.

No type is built in: the type and the fields are those of the mapping.
"""

import importlib
import re
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration, Time

from codetr_ros.nodes.errors import NodeError
from codetr_ros.records import F64
from codetr_ros.robots.live import Command
from codetr_ros.robots.mapping import Action

_SEQUENCE = re.compile(r'sequence<([\w/]+)(?:, \d+)?>$|([\w/]+)\[\d+\]$')
_NUMBERS = re.compile(r'(float|double|long double)$')


def message_class(name: str) -> Any:
    """The class of a type such as std_msgs/msg/Bool or std_srvs/srv/Trigger.

    Raises:
        NodeError: it is not installed here.
    """
    package, kind, short = name.split('/')
    try:
        return getattr(importlib.import_module(f'{package}.{kind}'), short)
    except (ImportError, AttributeError) as error:
        raise NodeError(
            f'type {name} cannot be imported ({error}): install the package {package}, or correct '
            'the type in the mapping'
        ) from None


class CommandMessages:
    """Makes commands of one type.

    Args:
        rules: the action of the mapping: topic, fields and joints.
        command: its type.
        size: A, the numbers of a command.
        period: seconds that a command is for; fills `time_from_start` where there is one.

    Raises:
        NodeError: the type is not installed, a field does not exist or holds no numbers, or the
            fields do not hold `size` numbers.
    """

    def __init__(self, rules: Action, command: Command, size: int, period: float) -> None:
        self.type = message_class(command.type)
        self._name = command.type
        self._rules = rules
        self._duration = Duration(sec=int(period), nanosec=round(period % 1 * 1e9))
        probe = self.type()
        arrays = [self._is_array(probe, path) for path in rules.fields]
        scalars = arrays.count(False)
        each, rest = divmod(size - scalars, max(1, arrays.count(True)))
        if rest or each < 0 or (any(arrays) and not each) or (not any(arrays) and rest + each):
            raise NodeError(
                f'mapping: action.fields = {list(rules.fields)} of {command.type} are {scalars} '
                f'numbers and {arrays.count(True)} lists, which cannot hold the {size} numbers of '
                'a command: correct the fields, or live.command.size'
            )
        self._counts = [each if is_array else 1 for is_array in arrays]
        self._arrays = arrays
        self.make(np.zeros(size), Time())  # what does not fit is found now

    def make(self, numbers: F64, stamp: Time) -> Any:
        """The message of a command.

        Args:
            numbers: (A,).
            stamp: the time of its header, where it has one.
        """
        message = self.type()
        if hasattr(message, 'header') and hasattr(message.header, 'stamp'):
            message.header.stamp = stamp
        if self._rules.joints is not None:
            names = 'name' if hasattr(message, 'name') else 'joint_names'
            setattr(message, names, list(self._rules.joints))
        values = numbers.tolist()
        for path, count, is_array in zip(
            self._rules.fields, self._counts, self._arrays, strict=True
        ):
            mine, values = values[:count], values[count:]
            self._set(message, path, mine if is_array else mine[0])
        return message

    def _set(self, message: Any, path: str, value: Any) -> None:
        *parents, last = path.split('.')
        place = message
        for part in parents:
            place = self._child(place, part, path)
        if hasattr(place, 'time_from_start'):
            place.time_from_start = self._duration
        name, index = _split(last)
        if index is None:
            setattr(place, name, value)
            return
        held = list(getattr(place, name))
        held += [0.0] * (index + 1 - len(held))
        held[index] = value
        setattr(place, name, held)

    def _child(self, place: Any, part: str, path: str) -> Any:
        name, index = _split(part)
        kind = self._kind(place, name, path)
        if index is None:
            return getattr(place, name)
        element = _SEQUENCE.match(kind)
        held = getattr(place, name)
        if element is None:
            raise NodeError(
                f'mapping: action.fields: {name} in {path!r} of {self._name} is no list'
            )
        while len(held) <= index:
            package, short = (element[1] or element[2]).split('/')
            held.append(message_class(f'{package}/msg/{short}')())
        return held[index]

    def _kind(self, place: Any, name: str, path: str) -> str:
        fields = place.get_fields_and_field_types()
        if name not in fields:
            raise NodeError(
                f'mapping: action.fields: {path!r} of {self._name}: there is no {name!r} in '
                f'{", ".join(fields)}'
            )
        return str(fields[name])

    def _is_array(self, probe: Any, path: str) -> bool:
        """Whether a field takes a list of numbers.

        Raises:
            NodeError: it does not exist, or holds no numbers.
        """
        *parents, last = path.split('.')
        place = probe
        for part in parents:
            place = self._child(place, part, path)
        name, index = _split(last)
        kind = self._kind(place, name, path)
        element = _SEQUENCE.match(kind)
        number = (element[1] or element[2]) if element else kind
        if not _NUMBERS.match(number):
            raise NodeError(
                f'mapping: action.fields: {path!r} of {self._name} is a {kind}, no '
                'floating-point number'
            )
        return element is not None and index is None


def _split(part: str) -> tuple[str, int | None]:
    """The name and the index of a part of a path, such as points[0]."""
    name, _, index = part.rstrip(']').partition('[')
    return name, int(index) if index else None
