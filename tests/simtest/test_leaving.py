"""Simulators that fall silent are left out, join again, and the bag says what was learnt from."""

from dataclasses import replace

import pytest

from codetr_ros.simtest.plan import DEADLINE
from codetr_ros.simtest.run import carry_out
from helpers.leaving import FOUR, TWO, leaving


def happened(outcome, what):
    return sum(what in line for line in outcome.trace)


@pytest.mark.parametrize('seed', [TWO, TWO + 8, TWO + 2 * 8])
def test_a_simulator_that_stalls_is_left_out_and_joins_again(seed):
    ended = carry_out(leaving(seed, {'sim_2': [(2.0, 6.0)]}), kept=10_000)
    assert ended.failures == []
    assert ended.errors == {}
    assert happened(ended, 'sim_2 is left out') == 1
    assert happened(ended, 'joins the run again') == 1
    again = next(i for i, line in enumerate(ended.trace) if 'joins the run again' in line)
    later = [line for line in ended.trace[again:] if 'sim_2' in line]
    assert any('publishes Transitions' in line for line in later)


def test_of_four_simulators_some_leave_and_join_while_the_run_goes_on():
    stalls = {'sim_2': [(2.0, 6.0)], 'sim_3': [(4.0, 9.0)], 'sim_4': [(3.0, 8.0)]}
    ended = carry_out(leaving(FOUR, stalls), kept=10_000)
    assert ended.failures == []
    assert ended.errors == {}
    assert {name for name in stalls if happened(ended, f'{name} is left out')} == set(stalls)


def test_two_simulators_join_a_running_run_of_two_by_their_names_alone():
    names = ('arm_3', 'arm_4')
    planned = leaving(
        TWO, {'sim_2': [(6.0, 5.0)]}, joiners=names, begins={'arm_3': 3.0, 'arm_4': 8.0}
    )
    ended = carry_out(planned, kept=20_000)
    assert ended.failures == []
    assert ended.errors == {}
    for name in names:
        assert any(f'{name} ' in line and 'publishes Transitions' in line for line in ended.trace)


@pytest.mark.parametrize(('seed', 'stall'), [(TWO, (1.5, 8.0)), (TWO + 2, (1.5, 9.0))])
def test_a_simulator_that_is_there_again_when_the_run_is_over_catches_up_and_ends(seed, stall):
    """It then runs the phase that it was left out of, and has the last permission by then."""
    planned = leaving(seed, {'sim_2': [stall]})
    planned = replace(planned, settings=planned.settings.changed({'steps': 24}))
    ended = carry_out(planned, kept=10_000)
    assert ended.failures == []
    assert ended.errors == {}
    assert happened(ended, 'sim_2 is left out') == 1


def test_a_run_ends_well_without_its_simulator_that_is_held_once_all_is_recorded():
    def single(stalls):
        planned = leaving(TWO, stalls)
        return replace(planned, settings=planned.settings.changed({'simulators': 1, 'steps': 24}))

    last = f'publishes Commit(phase={single({}).settings.phases - 1})'
    undisturbed = carry_out(single({}), kept=10_000)
    (at,) = [float(line.split()[0]) for line in undisturbed.trace if last in line]
    ended = carry_out(single({'sim': [(at, 3 * DEADLINE)]}), kept=10_000)
    assert ended.failures == []
    assert ended.errors == {}
    assert happened(ended, 'ends without sim') == 1
