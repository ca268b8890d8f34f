"""`ros2 run reward_node reward`: learns from composite rewards and labels steps."""

import sys
from typing import TYPE_CHECKING

from codetr_ros.ros.signals import Stop

if TYPE_CHECKING:
    from codetr_ros.ros.joining import MakeCore


def load() -> 'MakeCore':
    """Import the core and return what makes it."""
    import torch._dynamo  # noqa: F401 - else the first optimiser imports it during the run: seconds

    from codetr_ros.cores.labeller import Labeller

    return Labeller


def main(argv: list[str] | None = None) -> int:
    """Entry point; the imports follow the signal handlers, since they take seconds."""
    stop = Stop().install(starting=True)
    from codetr_ros.ros.node import run_node

    return run_node('reward', 'reward', load, argv, stop)


if __name__ == '__main__':
    sys.exit(main())
