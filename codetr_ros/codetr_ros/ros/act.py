"""The node that drives a robot by a trained policy: without a run, a learner or torch.

It reads and tests the policy's file, waits for the robot's topics, and refuses a robot that is
another than in training before any command leaves. From then on it is as the robot node is, but
that nothing is published, recorded or learnt from.
"""

import logging
import time
import traceback
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from codetr_ros.config import SettingsError
from codetr_ros.nodes import errors
from codetr_ros.nodes.errors import NodeError
from codetr_ros.robots import mapping, policy_file
from codetr_ros.robots.acting import driving
from codetr_ros.robots.driving import MISSED, Driving
from codetr_ros.robots.mapping import Mapping
from codetr_ros.robots.policy_file import PolicyFile
from codetr_ros.robots.same_robot import AnotherRobotError, check_mapping, check_sizes, check_types
from codetr_ros.ros import given, link, parameters
from codetr_ros.ros.drive import Drive
from codetr_ros.ros.gathering import IDLE, wait_for
from codetr_ros.ros.link import Link
from codetr_ros.ros.process import SHUTDOWN_DEADLINE, ToRos, in_ros
from codetr_ros.ros.signals import Stop

DIAGNOSE_EVERY = 1.0  # [s] between two messages on /diagnostics
UNREADABLE_FOR = 3.0
"""Seconds for which messages may come without being what the policy needs: a topic of joints may
have several publishers, each with joints of its own."""


class Act:
    """The node.

    Attributes:
        stop: true once the process is asked to stop.
        link: its connection to ROS.
        log: its logger.
        doing: what it does now, for people.
        waits_since: monotonic time [s] since which it has waited for that; None while it works.
        deadline_is: what the user sets `deadline` with, for errors.

    Args:
        name: node name unless remapped.
        stop: true once the process is asked to stop.
        arguments: the command line from which it has its parameters.
    """

    def __init__(self, name: str, stop: Stop, arguments: Sequence[str]) -> None:
        self.stop = stop
        self.link = Link(name)
        self.log = self.link.node.get_logger()
        self.doing = 'starting'
        self.waits_since: float | None = None
        self.deadline_is = 'parameter peer_deadline'
        self._arguments = arguments
        self._values: dict[str, Any] = {}
        self._driving: Driving | None = None
        self._drive: Drive | None = None
        self._diagnosed_at = 0.0
        self._unreadable_since: float | None = None

    @property
    def deadline(self) -> float:
        """Seconds to wait for the robot's topics; 0: for ever."""
        return float(self._values['peer_deadline'])

    def run(self) -> int:
        """Do everything from the parameters to the last command; returns the exit code."""
        code = 0
        try:
            self._begin()
            self._act()
        except Exception as problem:  # noqa: BLE001 - the robot must be left with the safe command
            code = 1
            own = errors.explains_itself(problem)
            self.log.fatal(str(problem) if own else traceback.format_exc())
        return self._end(code)

    # ---- before any command leaves

    def _begin(self) -> None:
        node = self.link.node
        given.check_names(node, 'act', self._arguments)
        self._values = parameters.declare_own(node, 'act')
        file = self._file()
        rules = self._rules(file)
        self._driving = driving(file, rules)
        self._drive = Drive(self.link, self._driving)
        driver = self._drive.driver
        driver.refusal = 'the robot has not been compared with that of the policy yet'
        driver.expected = file.described.robot.types
        if not wait_for(self, driver.lacking):
            return
        there = dict(driver.get_topic_names_and_types())
        taken = {topic: there.get(topic, []) for topic in driver.topics()}
        check_types(file.described.robot, taken, file.name)
        self._drive.configure()
        if not wait_for(self, self._unseen):
            return
        robot, size = file.described.robot, file.network.observation_size
        check_sizes(robot, self._driving.senses.sizes(), size, file.name)
        driver.refusal = ''
        self.log.info('the robot is the one that the policy was trained on')
        self._drive.begin(self._values)

    def _file(self) -> PolicyFile:
        """The policy file, once it has passed its own test."""
        path = self._values['checkpoint']
        if not path:
            raise NodeError(
                f'{self.link.full_name} needs the parameter checkpoint, a policy file: make one '
                'with `codetr export RUN`'
            )
        file = policy_file.load(policy_file.find(Path(path)))
        apart = file.test()
        said, network = file.described, file.network
        self.log.info(
            f'{file.name}: run {said.run_id}, task {said.task}, after phase {said.phase} '
            f'({said.steps} steps); {network.observation_size} observations, '
            f'{network.action_size} actions; its test differs by {apart:.1g}, at most '
            f'{said.tolerance:g} is allowed'
        )
        return file

    def _rules(self, file: PolicyFile) -> Mapping:
        """The mapping of the robot: that of the policy, or one that may stand in its place."""
        trained = file.described.robot.mapping
        path = self._values['mapping']
        rules = trained
        if path:
            rules = mapping.load(Path(path))
            episodes = file.network.segment_steps > 0
            check_mapping(trained, rules, path, file.name, episodes)
        if rules.live is None:
            raise SettingsError(
                f'{path or file.name}: the mapping has no part `live`, without which no robot is '
                'driven: docs/your-robot.md has an example'
            )
        return rules

    def _unseen(self) -> list[str]:
        """What was not received yet, in words.

        Raises:
            AnotherRobotError: messages come, and are not what the policy needs.
        """
        assert self._driving is not None
        senses, now = self._driving.senses, time.monotonic()
        lacking = ', '.join(senses.lacking())
        if not lacking:
            return []
        if senses.fault and self._unreadable_since is None:
            self._unreadable_since = now
        if self._unreadable_since is not None and now - self._unreadable_since > UNREADABLE_FOR:
            raise AnotherRobotError(
                f'this is another robot than the one that the policy was trained on: for '
                f'{UNREADABLE_FOR:g} s no message on {lacking} was what it needs; {senses.fault}. '
                'Start the driver of that robot, or train a policy for this one'
            )
        return [f'the first message on {lacking}']

    # ---- from then on

    def _act(self) -> None:
        driving, drive = self._driving, self._drive
        if driving is None or drive is None:
            return
        self.doing, self.waits_since = 'acts', None
        driving.begin()
        while not self.stop:
            self.turn(min(IDLE, driving.pause))
            driving.step()
            drive.log_held()

    def turn(self, wait: float = 0.0) -> None:
        """Give ROS its turn: take what arrived, and publish counts when they are due.

        Args:
            wait: seconds to block for something to arrive, if nothing has.
        """
        self.link.handle(wait)
        now = time.monotonic()
        if now - self._diagnosed_at < DIAGNOSE_EVERY:
            return
        self._diagnosed_at = now
        driving = self._driving
        held = driving.control.held if driving and driving.control.active else None
        level = link.OK if held is None else link.WARN
        counts = dict(driving.counts()) if driving else {}
        text = held.why if held else self.doing
        self.link.diagnose(level, text, {'acting:': counts})

    def _end(self, code: int) -> int:
        """Leave the robot with the safe command; returns the exit code."""
        try:
            if self._drive is not None:
                self._drive.close()
        except Exception:  # noqa: BLE001 - the counts must still be logged
            code = 1
            self.log.fatal(f'at the end: {traceback.format_exc()}')
        if self._driving is not None:
            counts = {n: c for n, c in sorted(self._driving.counts().items()) if c or n == MISSED}
            late = self._driving.deadlines.metrics()
            self.log.info(
                ', '.join(f'{count} {name}' for name, count in counts.items())
                + f'; control steps were late by {late["late_ms_p50"]:.2f} ms (half of them), '
                f'{late["late_ms_p99"]:.2f} ms (99 %), {late["late_ms_max"]:.2f} ms (the latest)'
            )
        if self.stop.signal and not code:
            self.log.info(f'stopped by {self.stop.signal.name}')
        try:
            self.stop.end_within(SHUTDOWN_DEADLINE, code)
        except OSError as problem:
            self.log.warning(f'nothing will end this process if its middleware hangs: {problem}')
        self.link.close()
        return code


def run_act(argv: Iterable[str] | None = None, stop: Stop | None = None) -> int:
    """The main function of the node.

    Args:
        argv: command line without the program; None: that of the process.
        stop: handlers of signals that are installed already; None: install them here.

    Returns:
        Exit code: 0 after SIGINT or SIGTERM; 1 after an error, a refused file or robot among them;
        2 for arguments that ROS cannot read.
    """

    def be_it(arguments: Sequence[str], stop: Stop) -> int:
        node = Act('act', stop, arguments)
        logging.getLogger('codetr_ros').addHandler(ToRos(node.log))
        return node.run()

    return in_ros('act', argv, stop, be_it, punctual=True)
