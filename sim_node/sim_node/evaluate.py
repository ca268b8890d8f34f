"""`ros2 run sim_node evaluate`: evaluates the policies of the run without delaying it."""

import sys
from typing import TYPE_CHECKING

from codetr_ros.ros.signals import Stop

if TYPE_CHECKING:
    from codetr_ros.ros.joining import MakeCore


def load() -> 'MakeCore':
    """Import the core and return what makes it."""
    from codetr_ros.cores.evaluator import Evaluator

    return lambda run, settings, name, folder: Evaluator(run, settings, name)


def main(argv: list[str] | None = None) -> int:
    """Entry point; the imports follow the signal handlers, since they take seconds."""
    stop = Stop().install(starting=True)
    from codetr_ros.ros.node import run_node

    return run_node('evaluate', 'evaluate', load, argv, stop)


if __name__ == '__main__':
    sys.exit(main())
