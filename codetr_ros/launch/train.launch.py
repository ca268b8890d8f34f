"""The nodes of a run in one namespace: `ros2 launch codetr_ros train.launch.py config:=quick`.

The settings that people change most are arguments too: `task:=Hopper-v5 delay:=100`. All others
are in a file that `config` names.

The settings of the run decide which nodes it needs. They start in any order and wait for each
other. The launch ends with the recorder, which is the last node to end. A node that was killed is
started again, with a folder of the run so that it goes on; one that has ended by itself is not. If
a node fails otherwise, the launch ends the others and returns an exit code other than 0; only the
evaluator may fail, and its results are missing then. The launch starts all simulators of the run,
unless the argument `start_simulators` is false: then each is started by hand, on any machine and
with a name of its own, `ros2 run sim_node sim --ros-args -r __ns:=/codetr -r __node:=sim_2`.

On a robot (task robot/NAME) its node is started in place of simulators: `mapping:=FILE`.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any

from launch import LaunchContext, LaunchDescription, LaunchDescriptionEntity
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
    TimerAction,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.events.process import ProcessExited
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from codetr_ros.config import USUAL, Settings, from_text, load
from codetr_ros.nodes import signing
from codetr_ros.processes.launcher import ROBOT_NODE
from codetr_ros.processes.restarts import MOST, WITHIN, Restarts, wrong
from codetr_ros.records.roles import TABLE
from codetr_ros.ros.launches import STOP_DEADLINE, NodeFailedError, check, how_it_ended
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
    'restarts': (
        str(MOST),
        'how often a node that was killed is started again within restarts_within; 0: never',
    ),
    'restarts_within': (f'{WITHIN:g}', 'seconds'),
    'restart_delay': ('1.0', 'seconds until a node that was killed is started again'),
    'start_simulators': (
        'true',
        'false: simulators, or the robot node, are started by hand, on any machine',
    ),
    'mapping': ('', 'on a robot: the mapping file, which names its topics and limits'),
    'autostart': (
        'false',
        'on a robot: true moves it as soon as everybody is there; false: once it is activated',
    ),
}
ON_ROBOT = ('mapping', 'autostart')


@dataclass
class Started:
    """Starts a process, and again if it was killed.

    Attributes:
        name: of the node.
        make: makes the action that starts it.
        restarts: how often that may be.
        delay: seconds until then.
        needed: whether the run fails with it.
        at_the_end: what happens once it has ended by itself, and well.
    """

    name: str
    make: Callable[[], LaunchDescriptionEntity]
    restarts: Restarts
    delay: float
    needed: bool = True
    at_the_end: list[LaunchDescriptionEntity] = field(default_factory=list)

    def actions(self) -> list[LaunchDescriptionEntity]:
        """What starts it."""
        process = self.make()
        ended = OnProcessExit(target_action=process, on_exit=self.ended)
        return [RegisterEventHandler(ended), process]

    def ended(
        self, event: ProcessExited, context: LaunchContext
    ) -> list[LaunchDescriptionEntity] | None:
        """What follows once it has ended.

        Raises:
            NodeFailedError: the run has failed.
        """
        code, how = event.returncode, how_it_ended(event)
        if not context.is_shutdown and self.restarts.permit(self.name, code):
            again = f'{how}: starting it again (number {self.restarts.counts[self.name]})'
            return [LogInfo(msg=again), TimerAction(period=self.delay, actions=self.actions())]
        if code == 0:
            return self.at_the_end
        if not self.needed:
            return [LogInfo(msg=f'{how}: the run goes on without it')]
        check(event, context)
        return None


def restarts_of(context: LaunchContext) -> tuple[Restarts, float]:
    """How often a killed node is started again, and after how many seconds.

    Raises:
        NodeFailedError: an argument is refused.
    """

    def number(name: str) -> float:
        text = LaunchConfiguration(name).perform(context)
        try:
            return float(text)
        except ValueError:
            raise NodeFailedError(f'{name}:={text} must be a number') from None

    most, within, delay = map(number, ('restarts', 'restarts_within', 'restart_delay'))
    if most != int(most) or not 0 <= delay <= WITHIN:
        raise NodeFailedError(
            f'restarts:={most:g} must be a whole number, and restart_delay:={delay:g} from 0 to '
            f'{WITHIN:g} seconds'
        )
    if reason := wrong(int(most), within):
        raise NodeFailedError(reason)
    return Restarts(int(most), within), delay


def settings_of(context: LaunchContext) -> tuple[Settings, dict[str, Any]]:
    """The settings of the run, and those of them that are arguments of the launch.

    Raises:
        SettingsError: one is refused.
    """
    base = load(LaunchConfiguration('config').perform(context))
    given = {name: LaunchConfiguration(name).perform(context) for name in USUAL}
    return from_text(base, given, 'train.launch.py')


def moving(settings: Settings, context: LaunchContext) -> tuple[str, ...]:
    """The names of the simulators, or that of the node that drives the robot.

    Raises:
        NodeFailedError: a robot lacks its mapping, or a simulation has one.
    """
    mapping = LaunchConfiguration('mapping').perform(context)
    if settings.on_robot and not mapping:
        raise NodeFailedError(
            f'task = {settings.task} is that of a robot, which needs mapping:=FILE; '
            'docs/your-robot.md has an example. To start its node by hand: start_simulators:=false'
        )
    if mapping and not settings.on_robot:
        raise NodeFailedError(
            f'mapping:={mapping} is of a robot, and task = {settings.task} is none: set the task '
            'to robot/NAME, or leave the mapping out'
        )
    return (ROBOT_NODE,) if settings.on_robot else settings.simulator_names


def nodes(context: LaunchContext) -> list[LaunchDescriptionEntity]:
    """The nodes; only the learner gets settings, and the others take them from the run."""
    value = {name: LaunchConfiguration(name) for name in ARGUMENTS}
    settings, given = settings_of(context)
    shared = {name: value[name] for name in ('folder', 'run_id', 'peer_deadline')}
    own = {
        'learner': {'config': value['config'], **as_parameters(given)},
        'record': {'leave_out_after': value['leave_out_after']},
        ROBOT_NODE: {name: value[name] for name in ON_ROBOT},
    }
    named = {role: role for role in settings.roles if role != 'sim'}
    if value['start_simulators'].perform(context).lower() == 'true':
        named |= dict.fromkeys(moving(settings, context), 'sim')
    key = signing.environment()  # that only these nodes have
    restarts, delay = restarts_of(context)

    def node(name: str, role: str) -> Node:
        return Node(
            package=TABLE[role].package,
            executable=name if name == ROBOT_NODE else TABLE[role].executable,
            name=name if role == 'sim' else TABLE[role].executable,
            namespace=value['namespace'],
            output='screen',
            sigterm_timeout=STOP_DEADLINE,
            sigkill_timeout=STOP_DEADLINE,
            parameters=[shared | own.get(name if name == ROBOT_NODE else role, {})],
            additional_env=key,
        )

    over = EmitEvent(event=Shutdown(reason='the run is over'))
    processes = [
        Started(
            name,
            partial(node, name, role),
            restarts,
            delay,
            needed=not TABLE[role].dispensable,
            at_the_end=[over] if role == 'record' else [],
        )
        for name, role in named.items()
    ]
    return [action for process in processes for action in process.actions()]


def generate_launch_description() -> LaunchDescription:
    """Declare the arguments, and start the nodes once they are known."""
    described = {name: field.description for name, field in FIELDS.items()}
    usual = {name: ('', f'setting: {described[name]}; empty: as in config') for name in USUAL}
    declared = [
        DeclareLaunchArgument(name, default_value=default, description=description)
        for name, (default, description) in (ARGUMENTS | usual).items()
    ]
    return LaunchDescription([*declared, OpaqueFunction(function=nodes)])
