"""`ros2 run codetr_ros score`: scores segments in the place of people (setting `scorer`)."""

import sys
from typing import TYPE_CHECKING, Any

from codetr_ros.ros.signals import Stop

if TYPE_CHECKING:
    from codetr_ros.config import Settings
    from codetr_ros.cores.core import Core
    from codetr_ros.records import RunSpec
    from codetr_ros.ros.joining import MakeCore


def load() -> 'MakeCore':
    """Import the core and return what makes it."""
    from codetr_ros.cores.people import SimulatedPeople
    from codetr_ros.nodes.errors import NodeError

    def make(run: 'RunSpec', settings: 'Settings', name: str, _: Any) -> 'Core[Any]':
        if settings.scorer != 'simulated':
            raise NodeError(
                f'{name}: the scores of this run come from scorer = {settings.scorer!r}, not from '
                'simulated people: nothing has to be started here'
            )
        return SimulatedPeople(run, settings)

    return make


def main(argv: list[str] | None = None) -> int:
    """Entry point; the imports follow the signal handlers, since they take a while."""
    stop = Stop().install(starting=True)
    from codetr_ros.ros.node import run_node

    return run_node('score', 'score', load, argv, stop)


if __name__ == '__main__':
    sys.exit(main())
