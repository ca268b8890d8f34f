"""`ros2 run codetr_ros score`: scores segments in the place of people, or serves those who score,
as the setting `scorer` has it.
"""

import sys
from typing import TYPE_CHECKING, Any

from codetr_ros.ros.signals import Stop

if TYPE_CHECKING:
    from codetr_ros.config import Settings
    from codetr_ros.cores.core import Core
    from codetr_ros.records import RunSpec
    from codetr_ros.ros.joining import Joined, MakeCore
    from codetr_ros.ros.membership import Membership
    from codetr_ros.ros.wiring import Wiring


def load() -> 'MakeCore':
    """Import the cores and return what makes the one that the run needs."""
    from codetr_ros.cores.people import SimulatedPeople

    serve = load_services()

    def make(run: 'RunSpec', settings: 'Settings', name: str, folder: Any) -> 'Core[Any]':
        if settings.scorer == 'simulated':
            people = SimulatedPeople(run, settings)
            people.find_scales()
            return people
        return serve(run, settings, name, folder)

    return make


def load_services() -> 'MakeCore':
    """Import the core that serves scorers, and return what makes it."""
    from codetr_ros.cores.desks import Desks, not_by_others
    from codetr_ros.nodes.errors import NodeError

    def make(run: 'RunSpec', settings: 'Settings', name: str, _: Any) -> 'Core[Any]':
        if reason := not_by_others(settings):
            raise NodeError(f'{name}: {reason}')
        return Desks(run, settings)

    return make


def wire(member: 'Membership', joined: 'Joined') -> 'Wiring':
    """The wiring that fits the core."""
    from codetr_ros.cores.desks import Desks
    from codetr_ros.ros.scoring import ScoringServices
    from codetr_ros.ros.wiring import Wiring

    if isinstance(joined.core, Desks):
        return ScoringServices(member, joined, print)
    return Wiring(member, joined)


def main(argv: list[str] | None = None) -> int:
    """Entry point; the imports follow the signal handlers, since they take a while."""
    stop = Stop().install(starting=True)
    from codetr_ros.ros.node import run_node

    return run_node('score', 'score', load, argv, stop, wire)


if __name__ == '__main__':
    sys.exit(main())
