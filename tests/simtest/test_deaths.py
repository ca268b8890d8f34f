"""Nodes of every role that are killed and started again, at any moment, are as if nothing had
happened.
"""

from dataclasses import replace

import pytest

from codetr_ros.simtest.disks import Trouble
from codetr_ros.simtest.plan import Death, all_settings, plan
from codetr_ros.simtest.run import carry_out
from helpers.deaths import ROLES, deadly
from helpers.leaving import TWO, leaving

RRD = next(i for i, each in enumerate(all_settings()) if each.method == 'rrd')
EACH = (*((role,) for role in ROLES), ROLES)
"""One role at a time, then all."""


@pytest.mark.parametrize('roles', EACH, ids=' '.join)
def test_killed_nodes_come_back_and_the_weights_are_the_same(roles):
    ended = carry_out(deadly(plan(1), roles), kept=20_000)
    assert ended.failures == []
    assert ended.errors == {}
    assert any('is started again' in line for line in ended.trace)


@pytest.mark.slow
@pytest.mark.parametrize('number', range(len(all_settings())))
def test_they_do_in_every_kind_of_run(number):
    ended = carry_out(deadly(plan(number)))
    assert ended.failures == []
    assert ended.errors == {}


def test_a_checkpoint_that_is_torn_is_passed_over_and_the_weights_are_the_same():
    planned = deadly(plan(RRD), ())
    deaths = tuple(Death(name, 9.0, 1.0, power=True) for name in ('reward', 'learner'))
    ended = carry_out(replace(planned, deaths=deaths), kept=20_000)
    assert ended.failures == []
    assert ended.errors == {}
    assert sum(' torn' in line for line in ended.trace) == 2
    assert any('goes on from' in line or 'no checkpoint' in line for line in ended.trace)


@pytest.mark.parametrize('power', [False, True])
@pytest.mark.parametrize('call', [0, 3, 11])
def test_whoever_is_killed_within_a_call_of_its_disk_comes_back_and_the_weights_are_the_same(
    call, power
):
    planned = deadly(plan(RRD), ())
    trouble = Trouble(kills_in=call, power=power)
    ended = carry_out(replace(planned, disk=trouble, checkpoints=trouble), kept=20_000)
    assert ended.failures == []
    assert ended.errors == {}
    assert sum('is killed' in line for line in ended.trace) == 2


def test_a_full_disk_of_checkpoints_ends_the_run_by_an_error_that_names_it():
    planned = replace(deadly(plan(RRD), ()), checkpoints=Trouble(room=4000), heals=False)
    ended = carry_out(planned)
    assert ended.failures == []
    assert any('No space left on device' in error for error in ended.errors.values())


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
