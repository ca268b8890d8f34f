"""Which parameters a user has given to one node, and which to all nodes.

A parameter file for a whole system has a section `/**`, which every node reads: what a node does
not know there is meant for another. On the command line, and in a section with the name of the
node, it is a mistake. ROS merges all of them, so the arguments are looked through once more.
"""

from collections.abc import Iterator, Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

from rclpy.node import Node

from codetr_ros.config import flatten
from codetr_ros.ros import parameters
from codetr_ros.ros.own_parameters import OWN_OF_ROLE
from codetr_ros.system.parsing import ParseError, read_yaml
from codetr_ros.system.similar import did_you_mean

_PARAMETERS = 'ros__parameters'


def check_names(node: Node, role: str, arguments: Sequence[str] = ()) -> None:
    """Refuse parameters that do not exist, and log those that are for other nodes only.

    Args:
        node: the node with the parameters.
        role: one of `records.ROLES`.
        arguments: the command line that the parameters come from.

    Raises:
        ParameterError: names all that were given to this node itself, and those that exist.
    """
    known = parameters.known(role)
    others = {n for each in OWN_OF_ROLE for n in parameters.known(each)}
    unknown = {
        name: value
        for name, value in parameters.overrides(node).items()
        if name not in known
        and not node.has_parameter(name)
        and not name.startswith('qos_overrides.')
    }
    wrong = {
        name: value
        for name, value in unknown.items()
        if name in addressed(arguments, node.get_name())
    }
    if wrong:
        given = ', '.join(
            f'{name}={value!r}{did_you_mean(name, known)}' for name, value in sorted(wrong.items())
        )
        raise parameters.ParameterError(
            f'{node.get_fully_qualified_name()} has no parameter {given}. There are: '
            f'{", ".join(sorted(known))}'
        )
    foreign = [f'{name}{did_you_mean(name, known)}' for name in sorted(unknown.keys() - others)]
    if foreign:
        node.get_logger().warning(
            f'{len(foreign)} parameters given to all nodes are none of this one, and are left to '
            f'others: {", ".join(foreign)}'
        )


def addressed(arguments: Sequence[str], node: str) -> set[str]:
    """The names of the parameters that were given to a node itself.

    Args:
        arguments: the command line, which ROS has accepted.
        node: the node's name, without its namespace.

    Raises:
        ParameterError: a parameter file cannot be read, or is beyond the limits of a text.
    """
    names: set[str] = set()
    for flag, value in pairwise(arguments):
        if flag in ('-p', '--param'):
            names.add(value.partition(':=')[0].rpartition(':')[2])
        elif flag == '--params-file':
            for section, given in _sections(_content(Path(value))):
                if section.rpartition('/')[2] == node:
                    names |= {name for name, _ in flatten(given)}
    return names


def _content(path: Path) -> Any:
    """What is in a parameter file."""
    try:
        return read_yaml(path, unique=False)  # of a key that stands twice ROS takes one
    except ParseError as error:
        raise parameters.ParameterError(f'parameter file {path} {error}') from None
    except OSError as error:
        raise parameters.ParameterError(
            f'parameter file {path} cannot be read: {error.strerror}'
        ) from None


def _sections(content: Any, prefix: str = '') -> Iterator[tuple[str, Mapping[str, Any]]]:
    """The sections of a parameter file, each by the path of its nodes."""
    if not isinstance(content, Mapping):
        return
    for key, value in content.items():
        if key == _PARAMETERS and isinstance(value, Mapping):
            yield prefix, value
        else:
            yield from _sections(value, f'{prefix}/{key}')
