"""Simulated runs whose simulators, or whose messages, take their time."""

from dataclasses import replace

from codetr_ros.simtest.disks import Trouble
from codetr_ros.simtest.losing import losing
from codetr_ros.simtest.network import Weather
from codetr_ros.simtest.place import Pace
from codetr_ros.simtest.plan import Plan, names_of


def slow_and_losing(seed: int) -> Plan:
    """A run that loses a fifth of everything, and whose evaluator waits beyond the deadline for
    policies: not all are evaluated, and what it has lost of the others nobody sends again.
    """
    planned = losing(seed)
    settings = planned.settings.changed({'steps': 56, 'evaluate_every': 24})
    paces = {
        name: Pace(slice_seconds=8.0 if role == 'sim' else 0.02)
        for name, role in names_of(settings).items()
    }
    return replace(planned, settings=settings, paces=paces, deaths=(), leave_out_after=0.0)


def far_apart(planned: Plan) -> Plan:
    """The same run, but that a message takes three seconds on average and may overtake others, and
    nothing else happens.
    """
    planned = replace(planned, paces={name: Pace() for name in planned.paces}, deaths=())
    planned = replace(planned, weather=Weather(delay=3.0, reorder=True), leave_out_after=0.0)
    return replace(planned, disk=Trouble(), checkpoints=Trouble(), heals=True)
