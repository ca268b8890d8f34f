"""The middleware settings of the processes of a run, unless the user sets others."""

import os
import re
from collections.abc import MutableMapping
from importlib import resources

_NAMESPACE = re.compile(r'/|(/[A-Za-z_][A-Za-z0-9_]*)+')

DEFAULTS: dict[str, str] = {
    # Discover nodes on this host only, unless the user asks for more.
    'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST',
    # Asynchronous publication adds a thread and a copy, and no better order.
    'RMW_FASTRTPS_PUBLICATION_MODE': 'SYNCHRONOUS',
}
"""Environment variables; those already set keep their values."""

PROFILE = 'FASTRTPS_DEFAULT_PROFILES_FILE'
_RANGE = 'ROS_AUTOMATIC_DISCOVERY_RANGE'
_TRANSPORTS = 'FASTDDS_BUILTIN_TRANSPORTS'
_CHOSEN = (
    *(PROFILE, 'FASTDDS_DEFAULT_PROFILES_FILE', _TRANSPORTS, 'ROS_DISCOVERY_SERVER'),
    *('ROS_STATIC_PEERS', 'ROS_LOCALHOST_ONLY'),
)


def set_defaults(environ: MutableMapping[str, str] = os.environ) -> None:
    """Set what is not set yet, before ROS begins."""
    for variable, value in DEFAULTS.items():
        environ.setdefault(variable, value)


def avoid_shared_memory(
    implementation: str, environ: MutableMapping[str, str] = os.environ
) -> None:
    """Let this process send by UDP alone, before ROS begins; who drives a robot must.

    In shared memory, Fast DDS waits up to a second for a reader that was killed or is held, and
    tries twice. It holds a lock meanwhile, without which the process sends nothing to anybody
    (`SharedMemGlobal::Port::healthy_check` below `RTPSParticipantImpl::sendSync`, Fast DDS 2.14).

    On this host alone, rmw_fastrtps always adds shared memory. So a profile in its place looks at
    this host only. A user who has chosen transports, profiles or peers keeps them.

    Args:
        implementation: the middleware of ROS; with another than Fast DDS nothing is done.
        environ: the environment of this process.
    """
    if not implementation.startswith('rmw_fastrtps') or any(environ.get(v) for v in _CHOSEN):
        return
    if environ.get(_RANGE) == 'LOCALHOST':
        profile = resources.files('codetr_ros.processes').joinpath('this_host_by_udp.xml')
        environ.update({PROFILE: str(profile), _RANGE: 'SYSTEM_DEFAULT'})
    else:
        environ[_TRANSPORTS] = 'UDPv4'


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
