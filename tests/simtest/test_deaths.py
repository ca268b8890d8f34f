"""Simulators that are killed and started again, at any moment, are as if nothing had happened."""

import random
from dataclasses import replace

import pytest

from codetr_ros.simtest.disks import Trouble
from codetr_ros.simtest.network import Weather
from codetr_ros.simtest.plan import Death, all_settings, plan
from codetr_ros.simtest.process import Pace
from codetr_ros.simtest.run import carry_out
from helpers.leaving import TWO, leaving


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


@pytest.mark.parametrize(('seconds', 'left_out'), [(0.5, 0), (2.0, 0), (8.0, 1)])
def test_a_killed_simulator_is_left_out_only_if_it_is_not_there_again_in_time(seconds, left_out):
    planned = leaving(TWO, {}, slow='sim_2')
    death = Death('sim_2', 2.6, seconds)
    ended = carry_out(replace(planned, deaths=(death,)), kept=10_000)
    assert ended.failures == []  # the weights are the undisturbed ones if nothing was dropped
    assert ended.errors == {}
    assert sum('sim_2       is killed' in line for line in ended.trace) == 1
    assert sum('sim_2 is left out' in line for line in ended.trace) == left_out
    again = next(i for i, line in enumerate(ended.trace) if 'is started again' in line)
    later = [line for line in ended.trace[again:] if ' sim_2 ' in line]
    assert any('publishes Transitions' in line for line in later)
