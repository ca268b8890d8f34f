"""`ros2 run codetr_ros record`: writes the bag of a run and commits its phases."""

import sys
from typing import TYPE_CHECKING

from codetr_ros.ros.signals import Stop

if TYPE_CHECKING:
    from codetr_ros.ros.joining import MakeCore


def load() -> 'MakeCore':
    """Import the core and return what makes it."""
    from codetr_ros.cores.recorder import Recorder

    return lambda run, settings, name, folder: Recorder(run, settings, name)


def main(argv: list[str] | None = None) -> int:
    """Entry point; the imports follow the signal handlers, since they take a while."""
    stop = Stop().install(starting=True)
    try:
        from codetr_ros.ros.node import run_node
        from codetr_ros.ros.recording import Recording
    except ModuleNotFoundError as error:
        # of all commands of nodes, an installation without ROS has only this one
        print(
            f'record: a node needs ROS 2 and the built workspace, but {error.name} cannot be '
            'imported. `codetr doctor` names what is missing',
            file=sys.stderr,
        )
        return 2

    return run_node('record', 'record', load, argv, stop, Recording)


if __name__ == '__main__':
    sys.exit(main())
