"""Simulated runs in which much is lost on every way, and nodes are killed besides."""

import random
from dataclasses import replace

from codetr_ros.simtest.disks import Trouble
from codetr_ros.simtest.network import Weather
from codetr_ros.simtest.place import Pace
from codetr_ros.simtest.plan import BUSY, Death, Plan, names_of, plan


def losing(seed: int, share: float = 0.2) -> Plan:
    """Draw a run whose network loses a share of all messages, whoever reads them, of all
    questions, and of all answers. One node is killed, or two, or one twice; and nothing else
    happens. It is a run of the kind that `plan` draws for the seed.

    Args:
        seed: from which it is drawn.
        share: of what never arrives, of each: from 0 to 1.
    """
    planned, draws = plan(seed), random.Random(f'losing {seed}')
    names = list(names_of(planned.settings))
    deaths = tuple(
        Death(
            name=draws.choice(names),
            at=draws.uniform(0.5, BUSY),
            seconds=draws.uniform(0.5, 10),
            power=draws.random() < 0.3,
        )
        for _ in range(draws.randint(1, 2))
    )
    paces = {
        name: Pace(begins=draws.uniform(0, 1), slice_seconds=draws.choice((0.02, 0.2)))
        for name in planned.paces
    }
    if draws.random() < 0.5:
        paces['learner'] = Pace(slice_seconds=1.0)
    weather = Weather(
        delay=0.02,
        reorder=draws.random() < 0.5,
        doubled=0.1,
        lost=share,
        overrun=share,
        unanswered=share,
    )
    return replace(
        planned,
        paces=paces,
        weather=weather,
        disk=Trouble(),
        checkpoints=Trouble(),
        heals=True,
        deaths=deaths,
    )
