"""A trained policy on a robot: `ros2 launch codetr_ros act.launch.py checkpoint:=FILE`.

The policy file is that of `codetr export`. The node waits for the robot's topics, compares the
robot with that of the training, and moves it once its lifecycle node `<name>_driver` is activated,
or at once with `autostart:=true`. No learner, recorder or torch is needed.

The launch ends with the node. Its exit code is other than 0 if the node has failed or was killed.
It is not started again: a robot that somebody had stopped would move.
"""

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    OpaqueFunction,
    RegisterEventHandler,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue

from codetr_ros.ros.launches import STOP_DEADLINE, NodeFailedError, check
from codetr_ros.ros.own_parameters import own_parameters

OWN = own_parameters('act')
ARGUMENTS = {
    'namespace': ('', 'namespace of the node'),
    'name': ('act', 'name of the node; its lifecycle node is <name>_driver'),
    'use_sim_time': ('false', 'true: take the time from /clock; never with a real robot'),
} | {name: (str(own.default).lower(), own.description) for name, own in OWN.items()}


def nodes(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """The node, and the end of the launch.

    Raises:
        NodeFailedError: no policy file is named.
    """
    value = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    if not value['checkpoint'].perform(context):
        raise NodeFailedError(
            'checkpoint:=FILE is missing, a policy file: make one with `codetr export RUN`'
        )
    given = {
        name: ParameterValue(value[name], value_type=type(own.default))
        for name, own in OWN.items()
    }
    given['use_sim_time'] = ParameterValue(value['use_sim_time'], value_type=bool)
    node = Node(
        package='learner_node',
        executable='act',
        name=value['name'],
        namespace=value['namespace'],
        output='screen',
        sigterm_timeout=STOP_DEADLINE,
        sigkill_timeout=STOP_DEADLINE,
        parameters=[given],
    )
    over = EmitEvent(event=Shutdown(reason='the node has ended'))
    failed = OnProcessExit(target_action=node, on_exit=check)
    ended = OnProcessExit(target_action=node, on_exit=[over])
    return [RegisterEventHandler(failed), RegisterEventHandler(ended), node]


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments, and start the node once they are known."""
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in ARGUMENTS.items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes)])
