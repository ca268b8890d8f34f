"""`ros2 run sim_node sim`: simulates the task of the run under the policies it receives."""

import sys
from typing import TYPE_CHECKING

from codetr_ros.ros.signals import Stop

if TYPE_CHECKING:
    from codetr_ros.ros.joining import MakeCore


def load() -> 'MakeCore':
    """Import the core and return what makes it."""
    from codetr_ros.cores.simulator import Simulator

    return lambda run, settings, name, folder: Simulator(run, settings, name)


def main(argv: list[str] | None = None) -> int:
    """Entry point; the imports follow the signal handlers, since they take seconds."""
    stop = Stop().install(starting=True)
    from codetr_ros.ros.node import run_node
    from codetr_ros.ros.simulating import Simulating

    return run_node('sim', 'sim', load, argv, stop, Simulating)


if __name__ == '__main__':
    sys.exit(main())
