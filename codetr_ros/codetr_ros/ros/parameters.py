"""Every setting of the run as a ROS parameter, with description and range, from the one
configuration.

The learner makes the run's settings from its parameters. All other nodes take them from the run
and refuse a parameter that contradicts it. Then they show the run's settings as read-only
parameters, so that `ros2 param list|describe|get` gives the same answer at every node.
"""

import types
import typing
from collections.abc import Mapping
from typing import Any, Literal

from annotated_types import Ge, Gt, Le, Lt, MaxLen, MinLen
from pydantic import BaseModel
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

from codetr_ros.config import Settings, SettingsError, load
from codetr_ros.config.base import Whole
from codetr_ros.config.threads import AUTO
from codetr_ros.ros.own_parameters import WITHOUT_RUN, own_parameters

Type = Parameter.Type
NOT_GIVEN = 0.0
"""Stands for None, 'not given', since a ROS parameter always has a value."""


class ParameterError(ValueError):
    """A parameter that is unknown, out of range or contradicts the run: the message names it, its
    value and the remedy.
    """


def _settings_fields(model: type[BaseModel], prefix: str = '') -> dict[str, Any]:
    fields: dict[str, Any] = {}
    for name, field in model.model_fields.items():
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel):
            fields |= _settings_fields(field.annotation, f'{prefix}{name}.')
        else:
            fields[prefix + name] = field
    return fields


FIELDS = _settings_fields(Settings)
"""Every setting by its dotted name."""


def known(role: str) -> set[str]:
    """The names of all parameters of a node of this role."""
    return set(own_parameters(role)) | (set() if role in WITHOUT_RUN else set(FIELDS))


def _bounds(field: Any) -> tuple[float | None, float | None, list[str]]:
    low: Any = None
    high: Any = None
    constraints = []
    for rule in field.metadata:
        if isinstance(rule, Whole):
            low, high = rule.ge, rule.le
        elif isinstance(rule, (Ge, Gt)):
            low = rule.ge if isinstance(rule, Ge) else rule.gt
            if isinstance(rule, Gt):
                constraints.append(f'greater than {low:g}')
        elif isinstance(rule, (Le, Lt)):
            high = rule.le if isinstance(rule, Le) else rule.lt
            if isinstance(rule, Lt):
                constraints.append(f'less than {high:g}')
        elif isinstance(rule, (MinLen, MaxLen)):
            least = isinstance(rule, MinLen)
            n = rule.min_length if least else rule.max_length  # type: ignore[union-attr]
            constraints.append(f'length at {"least" if least else "most"} {n}')
    return low, high, constraints


def _plain(annotation: Any) -> tuple[Any, bool]:
    """The first of several types, and whether None is allowed."""
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        inner = [a for a in typing.get_args(annotation) if a is not type(None)]
        return inner[0], type(None) in typing.get_args(annotation)
    return annotation, False


def descriptor(name: str, value: Any = None) -> ParameterDescriptor:
    """Type, description and range of a setting, from its pydantic field.

    Args:
        name: the setting.
        value: its value, which decides where a setting may be a number or text.
    """
    field = FIELDS[name]
    kind, optional = _plain(field.annotation)
    if isinstance(value, str) and kind is int:
        kind = str
    low, high, constraints = _bounds(field)
    shown = ParameterDescriptor(description=field.description or '', read_only=True)
    if typing.get_origin(kind) is Literal:
        shown.type = Type.STRING.value
        constraints.append('one of: ' + ', '.join(typing.get_args(kind)))
    elif typing.get_origin(kind) is tuple:
        element, _ = _plain(typing.get_args(kind)[0])
        of_text = typing.get_args(element)[0] is str
        shown.type = (Type.STRING_ARRAY if of_text else Type.INTEGER_ARRAY).value
    elif kind is bool:
        shown.type = Type.BOOL.value
    elif kind is int:
        shown.type = Type.INTEGER.value
        if low is not None and high is not None:
            shown.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    elif kind is float:
        shown.type = Type.DOUBLE.value
        if low is not None and high is not None:
            shown.floating_point_range = [
                FloatingPointRange(from_value=float(low), to_value=float(high))
            ]
    else:
        shown.type = Type.STRING.value
    if optional:
        constraints.append(f'{NOT_GIVEN:g}: not given')
    shown.additional_constraints = '; '.join(constraints)
    return shown


def _outward(value: Any) -> Any:
    if value is None:
        return NOT_GIVEN
    return list(value) if isinstance(value, tuple) else value


def as_parameters(values: Mapping[str, Any]) -> dict[str, Any]:
    """Settings by dotted name as the values of parameters."""
    return {name: _outward(value) for name, value in values.items()}


def _inward(name: str, value: Any) -> Any:
    _, optional = _plain(FIELDS[name].annotation)
    if optional and value == NOT_GIVEN:
        return None
    return value if isinstance(value, (str, bool, int, float)) else list(value)


def overrides(node: Node) -> dict[str, Any]:
    """The parameters that the user gave on the command line or in a parameter file."""
    # rclpy offers no public way to see overrides before they are declared
    given = node._parameter_overrides  # noqa: SLF001
    return {name: parameter.value for name, parameter in given.items()}


def declare_own(node: Node, role: str) -> dict[str, Any]:
    """Declare the node's own parameters and return their values.

    Raises:
        ParameterError: one is of the wrong type or out of range.
    """
    given = overrides(node)
    values: dict[str, Any] = {}
    for name, own in own_parameters(role).items():
        value = given.get(name, own.default)
        if isinstance(own.default, str):
            value = str(value)  # a run id of digits only arrives as a number
        elif isinstance(own.default, bool):
            if not isinstance(value, bool):
                raise ParameterError(
                    f'{node.get_fully_qualified_name()}: parameter {name} = {value!r} must be '
                    f'true or false ({own.description})'
                )
        elif (
            isinstance(value, bool)
            or not isinstance(value, (int, float))
            or not own.low <= value <= own.high
        ):
            raise ParameterError(
                f'{node.get_fully_qualified_name()}: parameter {name} = {value!r} must be a '
                f'number from {own.low:g} to {own.high:g} ({own.description})'
            )
        else:
            value = float(value)
        node.declare_parameter(name, value, own.descriptor(), ignore_override=True)
        values[name] = value
    return values


def declare_settings(node: Node, settings: Settings) -> None:
    """Declare every setting as a read-only parameter with the run's value."""
    for name, value in settings.flat().items():
        shown = descriptor(name, value)
        node.declare_parameter(
            name,
            Parameter(name, Type(shown.type), _outward(value)).value,
            shown,
            ignore_override=True,
        )


def own_settings(node: Node, config: str) -> Settings:
    """The settings that a learner's parameters ask for: its `config`, changed by those given one
    by one.

    Raises:
        ParameterError: a setting is refused; names it, its value and what is allowed.
    """
    given = {
        name: _inward(name, value) for name, value in overrides(node).items() if name in FIELDS
    }
    try:
        return load(config).changed(given, f'{node.get_fully_qualified_name()}: parameter')
    except SettingsError as error:
        raise ParameterError(str(error)) from None


def check_against_run(node: Node, settings: Settings, owner: str) -> None:
    """Refuse a parameter that contradicts the run's settings.

    Args:
        node: the node with the parameters.
        settings: the settings of the run.
        owner: name of the learner that announced the run.

    Raises:
        ParameterError: names every such parameter, both values and both nodes.
    """
    given: Mapping[str, Any] = {
        name: value for name, value in overrides(node).items() if name in FIELDS
    }
    name_of_node = node.get_fully_qualified_name()
    run = settings.flat()
    wrong = []
    for name, value in given.items():
        if (name, value) == ('threads', AUTO):
            continue  # the learner decides what it is
        try:
            same = (
                settings.changed({name: _inward(name, value)}, f'{name_of_node}: parameter')
                == settings
            )
        except SettingsError as error:
            raise ParameterError(str(error)) from None
        if not same:
            wrong.append(f'{name} = {value!r}, but {owner} has {name} = {run[name]!r}')
    if wrong:
        raise ParameterError(
            f'{name_of_node}: parameters contradict the run: {"; ".join(wrong)}. Leave them out '
            f'(the node takes them from the run) or start {owner} with them'
        )
