"""Simulators that are killed and started again, at any moment, are as if nothing had happened."""

import random
from dataclasses import replace

import pytest

from codetr_ros.simtest.disks import Trouble
from codetr_ros.simtest.network import Weather
from codetr_ros.simtest.plan import Death, all_settings, plan
from codetr_ros.simtest.process import Pace
from codetr_ros.simtest.run import carry_out


def deadly(number):
    """A run of one kind whose simulators are killed by what a number draws: several at once, and
    some twice in a row.
    """
    planned, draws = plan(number), random.Random(f'deaths {number}')
    names = planned.settings.simulator_names
    paces = {name: Pace(slice_seconds=0.2) for name in planned.paces}
    paces['learner'] = Pace(slice_seconds=2.0)
    deaths = []
    for _ in range(draws.randint(1, 3)):
        at = draws.uniform(1.0, 5)
        for name in draws.sample(names, draws.randint(1, len(names))):
            deaths.append(Death(name, at, draws.uniform(0.5, 10)))
    return replace(
        planned,
        paces=paces,
        weather=Weather(delay=0.02, reorder=True, doubled=0.1),
        disk=Trouble(),
        heals=True,
        deaths=tuple(deaths),
    )


def test_they_are_killed_in_most_of_these_runs():
    killed = [
        sum('is killed' in line for line in carry_out(deadly(number), kept=10_000).trace)
        for number in range(4)
    ]
    assert sum(map(bool, killed)) >= 3 and max(killed) > 1


@pytest.mark.parametrize('number', range(len(all_settings())))
def test_killed_simulators_come_back_and_the_weights_are_the_same(number):
    ended = carry_out(deadly(number), kept=10_000)
    assert ended.failures == []
    assert ended.errors == {}
