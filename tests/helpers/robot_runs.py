"""A run on a robot in real processes: the stand-in arm, the nodes, and a test that is the person.

The arm and the inspection are those of examples/robot_arm.
"""

import json
import os
import signal
import sys
import time
from pathlib import Path
from typing import Any

import yaml
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64MultiArray
from std_srvs.srv import SetBool, Trigger

from codetr_ros.config import Settings
from codetr_ros.nodes import signing
from codetr_ros.processes import launcher
from codetr_ros.runs import folder as run_folder
from helpers import nodes
from helpers.builders import tiny

EXAMPLE = Path(__file__).resolve().parents[2] / 'examples' / 'robot_arm'
DRIVER = f'{nodes.NAMESPACE}/robot_driver'
COMMANDS = '/arm/velocity_commands'
TRANSITIONS = {
    'configure': Transition.TRANSITION_CONFIGURE,
    'cleanup': Transition.TRANSITION_CLEANUP,
    'activate': Transition.TRANSITION_ACTIVATE,
    'deactivate': Transition.TRANSITION_DEACTIVATE,
}


def robot_settings(**changes: Any) -> Settings:
    """A run of some seconds at twenty steps a second."""
    small = {
        'task': 'robot/arm', 'pace': 'free', 'scorer': 'topic', 'evaluate_every': 0, 'steps': 120,
        'phase_steps': 40, 'warmup_steps': 80, 'delay': 20, 'method': 'evidence', 'requests': 0,
        'sac.compile': False, 'scorers': ('inspection',),
    }  # fmt: skip
    return tiny(**(small | changes))


def mapping(folder: Path, **live: Any) -> Path:
    """The example's mapping with other entries in its part `live`, as a file."""
    made = yaml.safe_load((EXAMPLE / 'live.yaml').read_text())
    made['live'] |= live
    path = folder / 'mapping.yaml'
    path.write_text(yaml.safe_dump(made))
    return path


class RobotRun(nodes.Nodes):
    """The processes of the run. A context manager: on leaving it, none is left.

    Args:
        settings: of the run.
        folder: of the run.
        autostart: whether the robot moves without being activated.
        key: the key of the run; None: there is none.
        simulated: whether the robot node takes its time from /clock.
        live: entries of the mapping's part `live`.
    """

    def __init__(
        self,
        settings: Settings,
        folder: Path,
        autostart: bool = True,
        key: str | None = None,
        simulated: bool = False,
        **live: Any,
    ) -> None:
        super().__init__(settings, folder)
        if key is not None:
            self._environment[signing.VARIABLE] = key
        file = mapping(folder, **live)
        robot = {'mapping': str(file), 'autostart': autostart, 'use_sim_time': simulated}
        made = launcher.commands(settings, nodes.RUN_ID, folder, robot=robot)
        self._commands = {command.name: command for command in made}
        self.names = tuple(self._commands)

    def begin(self, *others: str, inspection: bool = True) -> None:
        """Start the arm, the inspection and the nodes; `others` are arguments of the arm."""
        self.start_other('arm', 'stand_in.py', '--log', str(self.folder / 'truth.jsonl'), *others)
        if inspection:
            self.inspect()
        for name in self.names:
            self.start(name)

    def inspect(self) -> None:
        """Start the inspection."""
        ros = ('--ros-args', '-r', f'__ns:={nodes.NAMESPACE}')
        self.start_other('inspection', 'inspection.py', '--late', '0.5', *ros)

    def start_other(self, name: str, script: str, *arguments: str) -> None:
        """Start a process that is none of this project's."""
        self.start_python(name, str(EXAMPLE / script), *arguments)

    def start_python(self, name: str, *arguments: str) -> None:
        """Start a process of Python, as it is started outside of tests."""
        command = (sys.executable, *arguments)
        others = launcher.Processes(print)
        logs = self.folder / run_folder.LOGS
        others.start([launcher.Command(name, 'robot', command)], logs, self._environment)
        self._processes.nodes += others.nodes

    def truth(self) -> list[dict[str, Any]]:
        """What the arm noted: faults and attempts."""
        lines = (self.folder / 'truth.jsonl').read_text().splitlines()
        return [json.loads(line) for line in lines]

    def kill(self, name: str) -> None:
        """Kill a node, and start it again with what it had."""
        (node,) = [node for node in self._processes.nodes if node.name == name]
        os.kill(node.process.pid, signal.SIGKILL)
        node.process.wait(nodes.PATIENCE)
        self._processes.start_again(node)

    def again(self, *names: str) -> None:
        """Start nodes of the run again that have ended, with what they had."""
        for node in self._processes.nodes:
            if node.name in names:
                node.process.wait(nodes.PATIENCE)
                self._processes.start_again(node)

    def end(self, name: str, number: signal.Signals) -> None:
        """Send a signal to one process."""
        (node,) = [node for node in self._processes.nodes if node.name == name]
        os.kill(node.process.pid, number)


class Person(nodes.Witness):
    """Somebody who watches the commands of the robot, and may stop it."""

    def __enter__(self) -> 'Person':
        super().__enter__()
        self.commands: list[list[float]] = []
        self.times: list[float] = []
        self.measurements = 0
        node = self.link.node
        node.create_subscription(JointState, '/joint_states', self._measured, QoSProfile(depth=10))
        node.create_subscription(
            Float64MultiArray,
            COMMANDS,
            lambda message: self.link.store(self._commanded, list(message.data), time.monotonic()),
            QoSProfile(depth=10_000),  # as many as come while this process stands still
        )
        self.button = node.create_publisher(Bool, '/arm/emergency_stop', 1)
        return self

    def call(self, service: str, data: bool | None = None) -> Any:
        """Call a service of the robot node; its answer."""
        kind = Trigger if data is None else SetBool
        request = kind.Request() if data is None else kind.Request(data=data)
        return self._ask(kind, service, request)

    def activate(self) -> None:
        """Let the robot move."""
        assert self.change('activate')

    def change(self, transition: str) -> bool:
        """Ask for a transition of the lifecycle; whether it was made."""
        request = ChangeState.Request()
        request.transition.id = TRANSITIONS[transition]
        return bool(self._ask(ChangeState, 'change_state', request).success)

    def state(self) -> int:
        """The state of the lifecycle, one of those of `lifecycle_msgs/State`."""
        return int(self._ask(GetState, 'get_state', GetState.Request()).current_state.id)

    def _ask(self, kind: Any, service: str, request: Any) -> Any:
        client = self.link.node.create_client(kind, f'{DRIVER}/{service}')
        self.until(client.service_is_ready)
        future = client.call_async(request)
        self.until(future.done)
        return future.result()

    def _commanded(self, command: list[float], now: float) -> None:
        self.commands.append(command)
        self.times.append(now)

    def _measured(self, message: JointState) -> None:
        self.measurements += 1

    def sees_commands(self) -> bool:
        """Whether commands would arrive here."""
        return self.link.node.count_publishers(COMMANDS) > 0

    def moves(self) -> bool:
        """Whether one of the last two commands moves the arm."""
        return any(any(command) for command in self.commands[-2:])

    def rests(self) -> bool:
        """Whether the last five commands were the safe one, and there are so many."""
        return len(self.commands) >= 5 and not any(any(c) for c in self.commands[-5:])

    def took(self, count: int, least: float, most: float) -> bool:
        """Whether the last commands came at a rate: so many further ones within so many seconds.
        They do, sooner or later, also where this process or the robot's stands still now and then.
        """
        times = self.times[-count - 1 :]
        return len(times) > count and least < times[-1] - times[0] < most

    def ticks(self, count: int) -> None:
        """Wait for so many further commands."""
        before = len(self.commands)
        self.until(lambda: len(self.commands) >= before + count)
