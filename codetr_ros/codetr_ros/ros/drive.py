"""How a node drives a robot, learning or not: from the robot's topics to its last safe command."""

import gc
import time
from typing import Any

from codetr_ros.robots.driving import Driving
from codetr_ros.robots.guard import CLOCK, Hold
from codetr_ros.robots.reset import RESET
from codetr_ros.ros.driver import Driver, shown
from codetr_ros.ros.link import Link
from codetr_ros.system.scheduling import real_time

SAY_EVERY = 10.0  # [s] between two lines about the same reason for which the robot is held
STILL = 1.0
"""Seconds of the machine for which a simulated clock may stand still before the robot is held."""


class Drive:
    """Holds the driver of a robot, and logs what holds the robot.

    Args:
        link: the connection of the node.
        driving: what drives the robot.
    """

    def __init__(self, link: Link, driving: Driving) -> None:
        self._driving = driving
        node = link.node
        self._log = node.get_logger()
        self._simulated = bool(node.get_parameter('use_sim_time').value)
        self._ticked = 0.0, time.monotonic()  # the simulated time [s], and since when it stands
        if self._simulated:
            driving.use_clock(lambda: node.get_clock().now().nanoseconds / 1e9)
        else:
            # never set back while the node runs, and comparable with stamps of the system's clock
            ahead = time.time() - time.monotonic()
            driving.use_clock(lambda: time.monotonic() + ahead)
        self.driver = Driver(link, driving)
        self._held = ''
        self._held_at = 0.0

    def configure(self) -> None:
        """Open the robot's topics, once they are there.

        Raises:
            NodeError: a type is not installed, or a command cannot be made of it.
        """
        self.driver.on_configure(None)  # raises what is wrong; a transition would hide it
        self.driver.trigger_configure()
        self._driving.use_clock(self._driving.clock)  # a simulated one has jumped from 0
        self._log.info(f'observes {shown(self.driver.topics())}')

    def begin(self, values: dict[str, Any]) -> None:
        """Let the robot be driven: at once, or when somebody activates the driver.

        Args:
            values: the node's own parameters `autostart` and `real_time`.
        """
        gc.freeze()  # nothing may delay a control step, and a collection goes through all of torch
        if values['real_time'] and not self._simulated and (reason := real_time()):
            self._log.warning(f'control steps have no real-time scheduling: {reason}')
        if values['autostart']:
            self.driver.trigger_activate()
        else:
            self._log.warning(
                f'the robot is not moved before {self.driver.get_fully_qualified_name()} is '
                'activated (`ros2 lifecycle set`, or the parameter autostart)'
            )

    def log_held(self) -> None:
        """Log why the robot is held, and hold it where a simulated clock has stopped."""
        if self._simulated:
            self._watch_clock()
        control = self._driving.control
        self._note(control.held if control.active else None)

    def _watch_clock(self) -> None:
        """Send the safe command where the clock has stopped: no control step is due any more."""
        now, wall = self._driving.clock(), time.monotonic()
        simulated, since = self._ticked
        if now != simulated:
            self._ticked = now, wall
        elif wall - since > STILL and not self._driving.guard.interrupted:
            self._driving.interrupt(CLOCK, f'/clock stood still for more than {STILL:g} s')

    def _note(self, held: Hold | None) -> None:
        """Log why the robot is held: at once, and again while it lasts; a reset, which every
        episode needs, only where it lasts.
        """
        kind, now = held.kind if held else '', time.monotonic()
        changed = kind != self._held
        lasts = not changed and held is not None and now - self._held_at > SAY_EVERY
        if changed or lasts:
            self._held, self._held_at = kind, now
        if held is not None and (lasts or (changed and kind != RESET)):
            self._log.warning(f'the robot is held: {held.why}')

    def close(self) -> None:
        """Leave the robot with the safe command, also after an error."""
        self._driving.close()
        self.driver.close()
