"""Simulated runs whose simulators take their time, where much is lost."""

from dataclasses import replace

from codetr_ros.simtest.losing import losing
from codetr_ros.simtest.plan import Plan, names_of
from codetr_ros.simtest.process import Pace


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
