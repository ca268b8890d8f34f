"""The nodes of a run in one namespace: `ros2 launch codetr_ros train.launch.py config:=quick`.

The settings of the run decide which nodes it needs. They start in any order and wait for each
other. The launch ends with the recorder, which is the last node to end. If a node fails, the
launch ends the others and returns an exit code other than 0. It starts one simulator: a run with
the setting `simulators` above 1 waits until the others are started by hand, each with a
name of its own, `ros2 run sim_node sim --ros-args -r __ns:=/codetr -r __node:=sim_2`.
"""

import signal

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    OpaqueFunction,
    RegisterEventHandler,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from codetr_ros.config import load
from codetr_ros.records.roles import TABLE

ARGUMENTS = {
    'namespace': ('codetr', 'namespace of the run; each run needs one of its own'),
    'config': ('quick', 'settings: a preset (quick, cpu, paper) or a YAML file'),
    'run_id': ('', 'id of the run; empty: made from the date'),
    'folder': ('', 'folder for bag, checkpoints and reports; empty: nothing is written'),
    'peer_deadline': ('60.0', 'seconds that nodes wait for each other'),
}
STOP_DEADLINE = '20'
"""Seconds from SIGINT to SIGTERM, and from there to SIGKILL, in which a node ends its slice and
writes a checkpoint.
"""


class NodeFailedError(RuntimeError):
    """A node of the run has failed. Of all that a launch file can do, only an error makes `ros2
    launch` return another exit code than 0.
    """


def check(event: ProcessExited, context: LaunchContext) -> None:
    """End the launch with an error if a node has failed.

    Raises:
        NodeFailedError: it has an exit code other than 0, and was not merely ended by the SIGINT
            that ends a launch.
    """
    stopped = context.is_shutdown and event.returncode == -signal.SIGINT
    if event.returncode and not stopped:
        code = event.returncode
        how = f'ended with exit code {code}' if code > 0 else f'was ended by signal {-code}'
        raise NodeFailedError(f'{event.process_name} {how}: the run has failed, see its output')


def nodes(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """The nodes; only the learner gets settings, and the others take them from the run."""
    value = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    shared = {name: value[name] for name in ('folder', 'run_id', 'peer_deadline')}
    processes = {
        role: Node(
            package=TABLE[role].package,
            executable=TABLE[role].executable,
            name=TABLE[role].executable,
            namespace=value['namespace'],
            output='screen',
            sigterm_timeout=STOP_DEADLINE,
            sigkill_timeout=STOP_DEADLINE,
            parameters=[shared | ({'config': value['config']} if role == 'learner' else {})],
        )
        for role in load(value['config'].perform(context)).roles
    }
    end = RegisterEventHandler(
        OnProcessExit(
            target_action=processes['record'],
            on_exit=[EmitEvent(event=Shutdown(reason='the run is over'))],
        )
    )
    failed = [
        RegisterEventHandler(OnProcessExit(target_action=process, on_exit=check))
        for process in processes.values()
    ]
    return [*failed, end, *processes.values()]


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments, and start the nodes once they are known."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes)])
