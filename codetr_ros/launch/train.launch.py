"""The nodes of a run in one namespace: `ros2 launch codetr_ros train.launch.py config:=quick`.

The settings that people change most are arguments too: `task:=Hopper-v5 delay:=100`. All others
are in a file that `config` names.

The settings of the run decide which nodes it needs. They start in any order and wait for each
other. The launch ends with the recorder, which is the last node to end. If a node fails, the
launch ends the others and returns an exit code other than 0. It starts all simulators of the run,
unless the argument `start_simulators` is false: then each is started by hand, on any machine and
with a name of its own, `ros2 run sim_node sim --ros-args -r __ns:=/codetr -r __node:=sim_2`.
"""

import signal
from typing import Any

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

from codetr_ros.config import USUAL, Settings, from_text, load
from codetr_ros.nodes import signing
from codetr_ros.records.roles import TABLE
from codetr_ros.ros.parameters import FIELDS, as_parameters

ARGUMENTS = {
    'namespace': ('codetr', 'namespace of the run; each run needs one of its own'),
    'config': ('quick', 'settings: a preset (quick, cpu, paper) or a YAML file'),
    'run_id': ('', 'id of the run; empty: made from the date'),
    'folder': ('', 'folder for bag, checkpoints and reports; empty: nothing is written'),
    'peer_deadline': ('60.0', 'seconds that nodes wait for each other'),
    'leave_out_after': (
        '30.0',
        'seconds of silence after which a simulator of several is left out; 0: never',
    ),
    'start_simulators': ('true', 'false: simulators are started by hand, on any machine'),
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


def settings_of(context: LaunchContext) -> tuple[Settings, dict[str, Any]]:
    """The settings of the run, and those of them that are arguments of the launch.

    Raises:
        SettingsError: one is refused.
    """
    base = load(LaunchConfiguration('config').perform(context))
    given = {name: LaunchConfiguration(name).perform(context) for name in USUAL}
    return from_text(base, given, 'train.launch.py')


def nodes(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """The nodes; only the learner gets settings, and the others take them from the run."""
    value = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    settings, given = settings_of(context)
    shared = {name: value[name] for name in ('folder', 'run_id', 'peer_deadline')}
    own = {
        'learner': {'config': value['config'], **as_parameters(given)},
        'record': {'leave_out_after': value['leave_out_after']},
    }
    named = {role: role for role in settings.roles if role != 'sim'}
    if value['start_simulators'].perform(context).lower() == 'true':
        named |= dict.fromkeys(settings.simulator_names, 'sim')
    key = signing.environment()  # that only these nodes have
    processes = {
        name: Node(
            package=TABLE[role].package,
            executable=TABLE[role].executable,
            name=name if role == 'sim' else TABLE[role].executable,
            namespace=value['namespace'],
            output='screen',
            sigterm_timeout=STOP_DEADLINE,
            sigkill_timeout=STOP_DEADLINE,
            parameters=[shared | own.get(role, {})],
            additional_env=key,
        )
        for name, role in named.items()
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
    described = {name: field.description for name, field in FIELDS.items()}
    usual = {name: ('', f'setting: {described[name]}; empty: as in config') for name in USUAL}
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in (ARGUMENTS | usual).items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes)])
