"""What the launch files share: how the end of a node ends a launch, and with which exit code."""

import signal

from launch import LaunchContext
from launch.events.process import ProcessExited

STOP_DEADLINE = '20'
"""Seconds from SIGINT to SIGTERM, and from there to SIGKILL, in which a node ends its slice and
writes a checkpoint, or leaves a robot with the safe command.
"""


class NodeFailedError(RuntimeError):
    """A node has failed, or an argument is refused. Of all that a launch file can do,
    only an error makes `ros2 launch` return another exit code than 0.
    """


def check(event: ProcessExited, context: LaunchContext) -> None:
    """End the launch with an error if a node has failed.

    Raises:
        NodeFailedError: it has an exit code other than 0, and was not merely ended by the SIGINT
            that ends a launch.
    """
    stopped = context.is_shutdown and event.returncode == -signal.SIGINT
    if event.returncode and not stopped:
        raise NodeFailedError(f'{how_it_ended(event)}: it has failed, see its output')


def how_it_ended(event: ProcessExited) -> str:
    """How a process ended, for people."""
    code = event.returncode
    how = f'ended with exit code {code}' if code >= 0 else f'was ended by signal {-code}'
    return f'{event.process_name} {how}'
