"""`ros2 run sim_node robot`: drives a robot in place of a simulator, by its mapping file."""

import sys
from typing import TYPE_CHECKING

from codetr_ros.ros.signals import Stop

if TYPE_CHECKING:
    from codetr_ros.ros.joining import Joined, MakeCore
    from codetr_ros.ros.membership import Membership
    from codetr_ros.ros.wiring import Wiring


def load() -> 'MakeCore':
    """Import the core and return what makes it."""
    from codetr_ros.cores.robot import Robot, load_rules

    return lambda run, settings, name, folder, mapping: Robot(
        run, settings, name, load_rules(mapping)
    )


def main(argv: list[str] | None = None) -> int:
    """Entry point; the imports follow the signal handlers, since they take seconds."""
    stop = Stop().install(starting=True)
    from codetr_ros.ros.node import run_node

    def wire(member: 'Membership', joined: 'Joined') -> 'Wiring':
        from codetr_ros.ros.robot import RobotWiring

        return RobotWiring(member, joined)

    return run_node('sim', 'robot', load, argv, stop, wire, 'robot')


if __name__ == '__main__':
    sys.exit(main())
