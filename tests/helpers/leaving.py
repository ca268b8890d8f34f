"""Simulated runs whose simulators fall silent, are left out and join again."""

import logging
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import torch

from codetr_ros.simtest.disks import Trouble
from codetr_ros.simtest.network import Weather
from codetr_ros.simtest.place import Pace
from codetr_ros.simtest.plan import Plan, all_settings, plan
from codetr_ros.simtest.run import Outcome, Simulated

WITH_TWO = [i for i, each in enumerate(all_settings()) if each.simulators == 2]
TWO = WITH_TWO[0]
FOUR = next(i for i, each in enumerate(all_settings()) if each.simulators == 4)


def leaving(
    seed: int,
    stalls: dict[str, list[tuple[float, float]]],
    slow: str = '',
    joiners: tuple[str, ...] = (),
    begins: Mapping[str, float] | None = None,
) -> Plan:
    """A run of many phases whose learner takes its time, and whose simulators stall.

    Args:
        seed: of the plan.
        stalls: from when and for how long simulators take no turn, by name [s].
        slow: a simulator that takes so long for a chunk that it stalls within a phase.
        joiners: names of simulators that need not be there at the start.
        begins: when they start [s].
    """
    planned = plan(seed)
    settings = planned.settings.changed(
        {'steps': 80, 'evaluate_every': 0, 'delay': 3, 'joiners': joiners}
    )
    paces = {name: Pace(slice_seconds=0.02) for name in planned.paces}
    paces['learner'] = Pace(slice_seconds=1.0)
    paces |= {
        name: Pace(slice_seconds=0.2 if name == slow else 0.02, stalls=list(each))
        for name, each in stalls.items()
    }
    paces |= {name: Pace(begins=at) for name, at in (begins or {}).items()}
    weather = Weather(delay=0.01, reorder=True, doubled=0.1)
    return replace(
        planned,
        settings=settings,
        paces=paces,
        weather=weather,
        disk=Trouble(),
        checkpoints=Trouble(),
        deaths=(),
        leave_out_after=3.0,
        heals=True,
    )


def bag_with_dropped_steps(folder: Path, seed: int = TWO) -> tuple[Simulated, Outcome]:
    """A run from which `sim_2` was left out in the midst of a phase, and its bag in a folder."""
    torch.set_num_threads(1)
    before = logging.root.manager.disable
    logging.disable(logging.CRITICAL)
    try:
        planned = leaving(seed, {'sim_2': [(2.0, 6.0)]}, slow='sim_2')
        simulated = Simulated(planned, folder, 100)
        return simulated, simulated.run()
    finally:
        logging.disable(before)
