"""Who is silent, as one sees it who may have been held himself."""

import pytest

from codetr_ros.nodes.attention import AWAY, Attention
from codetr_ros.nodes.peers import Peers
from codetr_ros.nodes.silence import Silence
from helpers.builders import presence, tiny

SETTINGS = tiny(simulators=2)


def watched(settings=SETTINGS, after=30.0):
    peers = Peers('record')
    for name in ('sim', 'sim_2'):
        peers.note(presence(node=f'/r/{name}', instance_id=name), 0.0)
    return peers, Silence(peers, settings, after)


def look(silence, first, last):
    """Look every second; what the last look finds."""
    found = {}
    for now in range(first, last + 1):
        found = silence.sources(float(now))
    return found


def test_a_simulator_is_silent_once_nothing_came_for_longer_than_the_deadline():
    peers, silence = watched()
    look(silence, 0, 20)
    peers.note(presence('sim'), 20.0)
    assert look(silence, 21, 30) == {}
    assert look(silence, 31, 31) == {'sim_2': 31.0}


def test_one_that_was_started_again_is_not_silent():
    peers, silence = watched()
    look(silence, 0, 29)
    peers.note(presence(node='/r/sim_2', instance_id='another'), 29.0)
    assert set(look(silence, 30, 40)) == {'sim'}


def test_who_was_held_himself_counts_silence_from_then_on():
    _, silence = watched()
    look(silence, 0, 5)
    assert silence.sources(100.0) == {}
    assert look(silence, 101, 130) == {}
    assert set(look(silence, 131, 131)) == {'sim', 'sim_2'}


def test_all_environments_of_a_silent_process_are_silent():
    _, silence = watched(tiny(simulators=2, envs=2))
    assert set(look(silence, 0, 31)) == {'sim-1', 'sim-2', 'sim_2-1', 'sim_2-2'}


@pytest.mark.parametrize('changes', [{'simulators': 1}, {'simulators': 1, 'envs': 3}])
def test_nobody_is_silent_where_there_is_nothing_to_go_on_with(changes):
    _, silence = watched(tiny(**changes))
    assert look(silence, 0, 100) == {}


def test_nobody_is_silent_without_a_deadline():
    _, silence = watched(after=0.0)
    assert look(silence, 0, 100) == {}


def test_who_looks_often_was_not_away():
    attention = Attention()
    assert [attention.was_away(now) for now in (5.0, 5.0 + AWAY, 20.0)] == [0.0, 0.0, 15.0 - AWAY]
