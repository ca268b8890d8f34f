"""The wiring of a robot's core: to the topics of its run, and through the driver to its own."""

from collections.abc import Sequence
from typing import Any, cast

from codetr_ros.cores.robot import Robot
from codetr_ros.robots import robot_facts
from codetr_ros.robots.robot_facts import RobotFacts
from codetr_ros.ros.drive import Drive
from codetr_ros.ros.gathering import IDLE, wait_for
from codetr_ros.ros.joining import Joined
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.wiring import Wiring


class RobotWiring(Wiring):
    """The wiring of a robot's core."""

    def __init__(self, member: Membership, joined: Joined) -> None:
        super().__init__(member, joined)
        self._driving = cast('Robot', joined.core).driving
        self._drive: Drive | None = None
        self._begun = False
        self._learner_at = 0.0

    def open(self) -> None:
        """Subscribe to the run's topics, and make the driver."""
        super().open()
        self._drive = Drive(self.member.link, self._driving)

    def complete(self) -> bool:
        """Wait for the robot's own topics, and open them; false if asked to stop meanwhile."""
        assert self._drive is not None
        if not wait_for(self.member, self._drive.driver.lacking):
            return False
        self._drive.configure()
        return True

    def show(self, given: Sequence[Any], doing: str) -> None:
        """Log how far the node has come, and why the robot is held."""
        super().show(given, doing)
        driving, drive = self._driving, self._drive
        assert drive is not None
        if not self._begun and driving.senses.size:
            self._begun = True
            self._write(drive)
            drive.begin(self.member.values)
        newest = max((p.received_at for p in self.member.peers.alive('learner')), default=0.0)
        if newest != self._learner_at:
            self._learner_at = newest
            driving.guard.learner(driving.clock())
        drive.log_held()

    def _write(self, drive: Drive) -> None:
        """Write what the robot is into the folder of the run: its policy is for this robot."""
        if self.member.folder is None:
            return
        driving = self._driving
        made = RobotFacts(
            mapping=driving.rules, types=drive.driver.types, sizes=driving.senses.sizes()
        )
        robot_facts.write(self.member.folder, self.member.link.name, made)

    def pause(self) -> float:
        """Seconds until the next control step is due, at most those that a signal waits."""
        return min(IDLE, self._driving.pause)

    def close(self) -> None:
        """Leave the robot with the safe command, also after an error."""
        if self._drive is not None:
            self._drive.close()
