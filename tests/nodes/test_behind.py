"""A simulator that receives policies of phases which, as far as it knows, cannot have begun."""

import logging
from dataclasses import replace

import numpy as np
import pytest

from codetr_ros.cores.simulator import Simulator
from codetr_ros.nodes.behind import MOST, Behind
from codetr_ros.nodes.peers import Peers
from codetr_ros.nodes.traffic import Traffic
from helpers.builders import policy, presence, run, tiny

BOTH = ('sim', 'sim_2')
SETTINGS = tiny(simulators=2, steps=20_000, warmup_steps=20_000)


def permission(phase):
    return policy(phase=phase, sources=BOTH, steps=np.array([100, 100], np.uint32))


@pytest.fixture
def simulator():
    def make(settings=SETTINGS):
        core = Simulator(run(settings), settings, 'sim_2')
        traffic = Traffic(logging.getLogger())
        traffic.core, traffic.settings = core, settings
        return core, traffic, Behind(traffic, core, settings)

    return make


def test_it_goes_on_behind_what_is_committed_without_it(simulator):
    core, traffic, behind = simulator()
    for phase in range(3, 8):
        traffic.receive(permission(phase))
    assert behind.asks
    behind.answered(5)
    assert (core.due, core.displaced, behind.asks) == (6, True, False)
    assert not traffic.refused
    traffic.receive(permission(7))  # it has that one
    assert core.duplicated == {'policy': 1}


@pytest.mark.parametrize('settings_hash', ['', 'hash'], ids=['gave up', 'has finished'])
def test_it_has_finished_once_a_recorder_has_that_did_not_wait_for_it(simulator, settings_hash):
    core, traffic, behind = simulator()
    peers = Peers('sim')
    last = presence('record', settings_hash=settings_hash)
    peers.note(last, 0.0)
    traffic.receive(permission(50))
    assert not behind.over(peers) and not core.finished
    peers.note(replace(last, finished=True), 1.0)
    assert behind.over(peers) == core.finished == bool(settings_hash)
    assert behind.asks == (not settings_hash)


def test_it_stops_in_the_midst_of_a_phase_once_the_run_is_over(simulator):
    core, traffic, behind = simulator()
    traffic.receive(permission(0))
    work = core.work()
    next(work)
    chunk, *_ = next(work)
    assert not chunk.phase_end
    peers = Peers('sim')
    peers.note(presence('record', finished=True), 0.0)
    for _ in range(2):  # asked again, it is over still
        assert behind.over(peers)
    assert core.finished
    assert core.report().counters['phases left out'] == SETTINGS.phases - 1


def test_policies_that_nobody_can_have_published_yet_are_refused(simulator):
    core, traffic, behind = simulator()
    traffic.receive(permission(50))
    assert behind.asks
    behind.answered(None)
    assert (core.due, behind.asks, dict(traffic.refused)) == (0, False, {'policy': 1})


def test_policies_that_it_has_caught_up_with_since_they_came_are_taken(simulator):
    core, traffic, behind = simulator()
    for phase in range(3):  # it takes nothing out of those that wait: 2 cannot have begun
        traffic.receive(permission(phase))
    core.pass_over(2)  # as if it had run the phases before
    assert behind.asks
    behind.answered(1)
    assert (core.lacks_permission, behind.asks) == (False, False)
    assert not traffic.refused


def test_of_policies_that_are_held_those_are_refused_that_are_too_early_still(simulator):
    core, traffic, behind = simulator()
    for phase in (2, 50):
        traffic.receive(permission(phase))
    core.pass_over(1)
    behind.answered(0)
    core.pass_over(2)
    assert (core.lacks_permission, behind.asks) == (False, False)
    assert traffic.refused == {'policy': 1}


def test_nothing_is_asked_while_the_next_policy_is_there(simulator):
    _, traffic, behind = simulator()
    traffic.receive(permission(5))
    traffic.receive(permission(0))
    assert not behind.asks


def test_no_more_are_held_than_that(simulator):
    core, traffic, behind = simulator()
    for phase in range(2, 2 + MOST + 5):
        traffic.receive(permission(phase))
    behind.answered(3)
    assert core.due == 4
    assert core.lacks_permission  # the oldest were let go


def test_without_another_simulator_they_are_refused_at_once(simulator):
    _, traffic, behind = simulator(SETTINGS.changed({'simulators': 1}))
    one = policy(phase=9, sources=('sim_2',), steps=np.array([200], np.uint32))
    traffic.receive(one)
    assert not behind.asks
    assert dict(traffic.refused) == {'policy': 1}
