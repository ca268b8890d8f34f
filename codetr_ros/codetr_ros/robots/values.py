"""Numbers in the messages of a topic: which fields and joints, and how they are read."""

from typing import Any

import numpy as np
from pydantic import Field, model_validator

from codetr_ros.records import F64
from codetr_ros.robots.errors import MessageError
from codetr_ros.robots.message_fields import FieldPath, Timed, field


class Values(Timed):
    """Numbers in the messages of a topic."""

    fields: tuple[FieldPath, ...] = Field(
        min_length=1,
        description='fields in this order, such as position, data[0] or pose.position.x; an array '
        'gives all of its elements',
    )
    joints: tuple[str, ...] | None = Field(
        None,
        min_length=1,
        description='take only the elements of these joints from array fields, in this order, by '
        'the field `name` of the message (sensor_msgs/JointState), or else by `joint_names` '
        '(trajectory_msgs/JointTrajectory)',
    )
    units: tuple[str, ...] | None = Field(
        None,
        min_length=1,
        description='the unit of each field, such as rad: nothing is converted, but a policy is '
        'not let act where the mapping states another one',
    )

    @model_validator(mode='after')
    def _unit_for_each_field(self) -> 'Values':
        if self.units is not None and len(self.units) != len(self.fields):
            raise ValueError(f'units has {len(self.units)} values, fields {len(self.fields)}')
        return self


def joint_names(message: Any, topic: str) -> list[str]:
    """The names of the joints that the arrays of a message are of.

    Raises:
        MessageError: it has none.
    """
    for name in ('name', 'joint_names'):
        names = getattr(message, name, None)
        if isinstance(names, (list, tuple)):
            return list(names)
    there = [name for name in getattr(message, '__dict__', ()) if not name.startswith('_')]
    raise MessageError(
        f'{topic} names no joints: there is neither `name` nor `joint_names` in '
        + (', '.join(there) or type(message).__name__)
        + '. Leave out `joints`, and name elements such as data[0]'
    )


def names_a_joint_twice(message: Any, values: Values) -> bool:
    """Whether a message names one of the joints of the mapping more than once."""
    names = joint_names(message, values.topic) if values.joints else []
    return any(names.count(joint) > 1 for joint in values.joints or ())


def numbers(message: Any, values: Values) -> F64 | None:
    """The numbers of a message, in order; None if a joint is missing, or named twice.

    Raises:
        MessageError: a field does not exist or holds no numbers.
    """
    rows: list[int] | None = None
    if values.joints is not None:
        names = joint_names(message, values.topic)
        if any(names.count(joint) != 1 for joint in values.joints):
            return None
        rows = [names.index(joint) for joint in values.joints]
    arrays = []
    for path in values.fields:
        value = field(message, path, values.topic)
        try:
            array = np.atleast_1d(np.asarray(value, np.float64)).ravel()
        except (TypeError, ValueError):
            raise MessageError(f'{values.topic}: field {path!r} holds no numbers') from None
        if rows is not None:
            if len(array) <= max(rows):
                return None  # JointState leaves unknown fields empty
            array = array[rows]
        arrays.append(array)
    return np.concatenate(arrays)
