"""`ros2 run learner_node learner`: makes the run, permits its phases, learns from labels."""

import sys
from typing import TYPE_CHECKING

from codetr_ros.ros.signals import Stop

if TYPE_CHECKING:
    from codetr_ros.ros.joining import MakeCore


def load() -> 'MakeCore':
    """Import the core and return what makes it."""
    import torch._dynamo  # noqa: F401 - else the first optimiser imports it during the run: seconds

    from codetr_ros.cores.learner import Learner

    return Learner


def main(argv: list[str] | None = None) -> int:
    """Entry point; the imports follow the signal handlers, since they take seconds."""
    stop = Stop().install(starting=True)
    from codetr_ros.ros.node import run_node

    return run_node('learner', 'learner', load, argv, stop)


if __name__ == '__main__':
    sys.exit(main())
