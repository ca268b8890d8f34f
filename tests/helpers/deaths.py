"""Simulated runs whose nodes are killed and started again."""

import random
from collections.abc import Collection
from dataclasses import replace

from codetr_ros.simtest.disks import Trouble
from codetr_ros.simtest.network import Weather
from codetr_ros.simtest.place import Pace
from codetr_ros.simtest.plan import Death, Plan, names_of

ROLES = ('sim', 'record', 'reward', 'learner', 'evaluate')


def deadly(planned: Plan, roles: Collection[str] = ROLES) -> Plan:
    """A run of one kind whose nodes of these roles are killed by what its seed draws: several at
    once, some twice in a row, and some with the power of their machines.
    """
    draws = random.Random(f'deaths {planned.seed}')
    dying = [name for name, role in names_of(planned.settings).items() if role in roles]
    paces = {name: Pace(slice_seconds=0.2) for name in planned.paces}
    paces['learner'] = Pace(slice_seconds=2.0)
    deaths = []
    for _ in range(draws.randint(2, 3)):
        at = draws.uniform(1.0, 6)
        for name in draws.sample(dying, draws.randint(min(1, len(dying)), len(dying))):
            seconds = draws.uniform(0.5, 10)
            deaths.append(Death(name, at, seconds, power=draws.random() < 0.3))
    return replace(
        planned,
        paces=paces,
        weather=Weather(delay=0.02, reorder=True, doubled=0.1),
        disk=Trouble(),
        checkpoints=Trouble(),
        heals=True,
        deaths=tuple(deaths),
    )
