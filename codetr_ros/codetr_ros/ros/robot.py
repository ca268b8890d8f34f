"""The wiring of a robot's core: to the topics of its run, and through the driver to its own."""

import gc
import time
from collections.abc import Sequence
from typing import Any, cast

from codetr_ros.cores.robot import Robot
from codetr_ros.robots.guard import Hold
from codetr_ros.robots.reset import RESET
from codetr_ros.ros.driver import Driver, shown
from codetr_ros.ros.gathering import IDLE, wait_for
from codetr_ros.ros.joining import Joined
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.wiring import Wiring
from codetr_ros.system.scheduling import real_time

SAY_EVERY = 10.0  # [s] between two lines about the same reason for which the robot is held


class RobotWiring(Wiring):
    """The wiring of a robot's core."""

    def __init__(self, member: Membership, joined: Joined) -> None:
        super().__init__(member, joined)
        self._robot = cast('Robot', joined.core)
        node = member.link.node
        if node.get_parameter('use_sim_time').value:
            self._robot.use_clock(lambda: node.get_clock().now().nanoseconds / 1e9)
        else:
            # never set back while the node runs, and comparable with stamps of the system's clock
            ahead = time.time() - time.monotonic()
            self._robot.use_clock(lambda: time.monotonic() + ahead)
        self._driver: Driver | None = None
        self._begun = False
        self._learner_at = 0.0
        self._held = ''
        self._held_at = 0.0

    def open(self) -> None:
        """Subscribe to the run's topics, and make the driver."""
        super().open()
        self._driver = Driver(self.member.link, self._robot)

    def complete(self) -> bool:
        """Wait for the robot's own topics, and open them; false if asked to stop meanwhile."""
        driver = self._driver
        assert driver is not None
        if not wait_for(self.member, driver.lacking):
            return False
        driver.on_configure(None)  # raises what is wrong; a transition would hide it
        driver.trigger_configure()
        self.log.info(f'observes {shown(driver.topics())}')
        return True

    def show(self, given: Sequence[Any], doing: str) -> None:
        """Log how far the node has come, and why the robot is held."""
        super().show(given, doing)
        robot = self._robot
        if not self._begun and robot.senses.size:
            self._begin()
        newest = max((p.received_at for p in self.member.peers.alive('learner')), default=0.0)
        if newest != self._learner_at:
            self._learner_at = newest
            robot.guard.learner(robot.clock())
        self._log_held(robot.control.held if robot.control.active else None)

    def _log_held(self, held: Hold | None) -> None:
        """Log why the robot is held: at once, and again while it lasts; a reset, which every
        episode needs, only where it lasts.
        """
        kind, now = held.kind if held else '', time.monotonic()
        changed = kind != self._held
        lasts = not changed and held is not None and now - self._held_at > SAY_EVERY
        if changed or lasts:
            self._held, self._held_at = kind, now
        if held is not None and (lasts or (changed and kind != RESET)):
            self.log.warning(f'the robot is held: {held.why}')

    def _begin(self) -> None:
        self._begun = True
        self._hurry()
        assert self._driver is not None
        if self.member.values['autostart']:
            self._driver.trigger_activate()
        else:
            self.log.warning(
                f'the robot is not moved before {self._driver.get_fully_qualified_name()} is '
                'activated (`ros2 lifecycle set`, or the parameter autostart)'
            )

    def _hurry(self) -> None:
        """Let nothing delay a control step that can be kept from it."""
        gc.freeze()  # a collection would go through all of torch
        if self.member.values['real_time'] and (reason := real_time()):
            self.log.warning(f'control steps have no real-time scheduling: {reason}')

    def pause(self) -> float:
        """Seconds until the next control step is due, at most those that a signal waits."""
        return min(IDLE, self._robot.pause)

    def close(self) -> None:
        """Leave the robot with the safe command, also after an error."""
        self._robot.close()
        if self._driver is not None:
            self._driver.close()
