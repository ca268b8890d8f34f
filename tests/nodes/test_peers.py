"""Which nodes of a run are there, have ended, or have given up."""

import pytest

from codetr_ros.nodes.peers import GAVE_UP, Peers
from helpers.builders import presence, tiny


def test_a_peer_that_has_finished_was_there_so_that_a_short_run_is_not_waited_for_again():
    settings = tiny()
    peers = Peers('evaluate')
    for role, count in settings.roles.items():
        if role != 'evaluate':
            assert count == 1
            assert any(role in missing for missing in peers.absent(settings, 'hash'))
            finished = presence(role, finished=True)
            peers.note(finished, 0.0)
    assert peers.absent(settings, 'hash') == []
    assert len(peers.absent(settings, 'of another run')) == 4


@pytest.mark.parametrize(('settings_hash', 'ending'), [('hash', 'ended'), ('', 'given up')])
def test_the_log_does_not_call_finished_what_gave_up(settings_hash, ending):
    peers = Peers('learner')
    assert peers.note(presence('sim'), 0.0) == 'sim /r/sim is there'
    last = presence('sim', settings_hash=settings_hash, finished=True)
    assert peers.note(last, 1.0) == f'sim /r/sim has {ending}'


def test_of_a_node_that_was_killed_and_started_again_only_the_newest_instance_counts():
    peers = Peers('record')

    def started(instance, finished):
        counts = {'metrics': 2}
        return presence(
            'evaluate', counts, instance_id=instance, settings_hash='', finished=finished
        )

    peers.note(started('killed', False), 1.0)
    assert peers.anybody_left()
    peers.note(started('started again', False), 2.0)
    assert peers.anybody_left()
    peers.note(started('started again', True), 3.0)
    assert not peers.anybody_left()
    assert [peer.presence.instance_id for peer in peers.newest()] == ['started again']


def test_a_last_presence_is_the_last_even_if_an_earlier_one_arrives_after_it():
    peers = Peers('record')
    for finished in (False, True, False):
        peers.note(presence('sim', finished=finished), 0.0)
    assert not peers.anybody_left()


def simulator(name, **changes):
    return presence('sim', node=f'/r/{name}', instance_id=name, **changes)


def test_a_simulator_that_may_join_takes_the_place_of_none_that_must_be_there():
    settings = tiny(joiners=('arm_2',))
    peers = Peers('record')
    peers.know(settings, 'record')
    peers.note(simulator('arm_2'), 0.0)
    assert any(missing.startswith('sim') for missing in peers.absent(settings, 'hash'))
    peers.note(simulator('sim'), 0.0)
    assert not any(missing.startswith('sim') for missing in peers.absent(settings, 'hash'))
    own = Peers('sim')
    own.know(settings, 'arm_2')
    assert any(missing.startswith('sim') for missing in own.absent(settings, 'hash'))


def test_a_simulator_that_comes_and_goes_may_die_without_failing_the_run():
    settings = tiny(joiners=('arm_2',))
    peers = Peers('record')
    peers.know(settings, 'record')
    for name in ('sim', 'arm_2'):
        peers.note(simulator(name), 0.0)
    last = {'finished': True, 'settings_hash': '', 'doing': f'{GAVE_UP}no room'}
    peers.note(simulator('arm_2', **last), 1.0)
    assert (peers.failed(), peers.cause()) == ([], '')
    peers.note(simulator('sim', **last), 2.0)
    assert peers.failed() == ['sim /r/sim has given up (no room)']
    assert peers.cause() == 'no room'
