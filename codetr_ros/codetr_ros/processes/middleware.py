"""The middleware settings of the processes of a run, unless the user sets others."""

import re

_NAMESPACE = re.compile(r'/|(/[A-Za-z_][A-Za-z0-9_]*)+')

DEFAULTS: dict[str, str] = {
    # Discover nodes on this host only, unless the user asks for more.
    'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    # Asynchronous publication adds a thread and a copy, and no better order.
    'RMW_FASTRTPS_PUBLICATION_MODE': 'SYNCHRONOUS',
}
"""Environment variables; those already set keep their values."""


def wrong_namespace(given: str) -> str | None:
    """Why a value of `--namespace` is no ROS namespace; None if it is one."""
    if _NAMESPACE.fullmatch(given):
        return None
    return (
        f'--namespace {given!r} must be a ROS namespace: /name, of letters, digits and _, not '
        'beginning with a digit'
    )


def wrong_seconds(flag: str, given: float, zero: str = 'for ever') -> str | None:
    """Why a value is no deadline of nodes; None if it is one."""
    if 0 <= given <= LONGEST_DEADLINE:
        return None
    return f'{flag} {given:g} must be from 0 to {LONGEST_DEADLINE:g} seconds; 0: {zero}'


LONGEST_DEADLINE = 86_400.0
"""The most seconds that nodes can be made to wait for each other."""
