"""When a node gives up waiting, and which cause it names."""

import pytest

from codetr_ros.nodes.errors import NodeError, first_cause
from codetr_ros.nodes.ledger import Ledger
from codetr_ros.nodes.patience import Limit, Patience
from codetr_ros.nodes.peers import GAVE_UP, Peers
from codetr_ros.nodes.settling import Settling
from codetr_ros.nodes.waiting import Waiting
from helpers import builders
from helpers.builders import tiny

DEADLINE = 60.0
SETTINGS = tiny()


class Log:
    def warning(self, message):
        pass


def presence(role, doing='works', waiting=0.0, **changes):
    return builders.presence(role, doing=doing, waiting=waiting, **changes)


def a_node(role='sim', outside=False, **others):
    """A node whose peers were last received 1 s ago: what each does, and for how long it waits."""
    peers = Peers(role)
    for name, (doing, waiting) in others.items():
        peers.note(presence(name, doing, waiting), 199.0)
    return peers, Patience(f'/r/{role}', peers, ['policy'], Limit(DEADLINE), Log(), outside)


def test_a_node_gives_up_once_everybody_has_waited_beyond_the_deadline_and_names_who_for_what():
    waits = {'record': ('waits for 2 scores', 61.0), 'learner': ('waits for the commit', 60.5)}
    _, patience = a_node(**waits)
    with pytest.raises(NodeError) as caught:
        patience.check(200.0, 62.0, 'waits for a permission', {}, {})
    text = str(caught.value)
    assert text.startswith('/r/sim gave up after 62 s: it waits for a permission; nobody is left')
    assert 'record /r/record waits for 2 scores (61 s)' in text
    assert 'learner /r/learner waits for the commit (60 s)' in text


@pytest.mark.parametrize(
    'others',
    [
        {'record': ('waits', 61.0), 'learner': ('works', 0.0)},
        {'record': ('waits', 61.0), 'learner': ('waits', 59.0)},
    ],
    ids=['one works', 'one has not waited as long'],
)
def test_while_anything_is_under_way_a_node_waits_on(others):
    _, patience = a_node(**others)
    patience.check(200.0, 1000.0, 'waits', {}, {})


LOST = {'policy': 1}


def test_what_a_node_lacks_and_asks_for_in_vain_ends_its_wait_though_others_work():
    peers, patience = a_node(learner=('works', 0.0))
    asked_for = {'policy': 100.0}
    patience.check(199.0, 99.0, 'waits for a permission', LOST, asked_for)  # lost only now
    peers.note(presence('learner'), 259.0)
    with pytest.raises(NodeError, match="waits for a permission, and .* it: 1 of 'policy'"):
        patience.check(260.0, 160.0, 'waits for a permission', LOST, asked_for)


@pytest.mark.parametrize(
    'asked_for',
    [{}, {'commits': 0.0}, {'policy': 250.0}],
    ids=['asks for nothing', 'lacks something else', 'it is still to come'],
)
def test_what_is_lost_and_not_needed_ends_no_wait(asked_for):
    """A policy that is not to be evaluated, or that permits a phase which has gone by."""
    peers, patience = a_node('evaluate', learner=('works', 0.0))
    patience.check(200.0, 0.0, 'waits', LOST, asked_for)
    peers.note(presence('learner'), 300.0)
    patience.check(300.0, 100.0, 'waits', LOST, asked_for)


def test_what_has_come_is_a_reason_to_wait_for_the_rest():
    peers, patience = a_node('record', learner=('works', 0.0))
    asked_for = {'policy': 0.0}
    patience.check(200.0, 100.0, 'waits', {'policy': 3}, asked_for)
    peers.note(presence('learner'), 300.0)
    patience.check(300.0, 200.0, 'waits', {'policy': 2}, asked_for)
    peers.note(presence('learner'), 360.0)
    with pytest.raises(NodeError, match="2 of 'policy'"):
        patience.check(361.0, 261.0, 'waits', {'policy': 2}, asked_for)


def test_who_has_just_done_his_part_may_have_published_what_is_awaited():
    peers, patience = a_node(record=('waits', 61.0))
    peers.note(presence('learner', finished=True), 150.0)
    peers.note(presence('learner', finished=True), 199.0)  # it stays, and answers
    patience.check(200.0, 100.0, 'waits for a permission', {}, {})
    peers.note(presence('record', 'waits', 72.0), 210.0)
    peers.note(presence('learner', finished=True), 210.0)
    with pytest.raises(NodeError, match='nobody is left who could end that'):
        patience.check(211.0, 111.0, 'waits for a permission', {}, {})


def test_a_wait_begins_anew_when_a_node_waits_for_something_else():
    waiting = Waiting()
    assert waiting.seconds('waits for a commit', 100.0) == 0.0
    assert waiting.seconds('waits for a commit', 150.0) == 50.0
    assert waiting.seconds('waits for the rest of a phase', 160.0) == 0.0
    assert waiting.since == 160.0
    waiting.over()
    assert waiting.since is None
    assert waiting.seconds('waits for the rest of a phase', 170.0) == 0.0


def test_where_a_node_may_wait_for_a_person_nobody_waits_in_vain():
    _, patience = a_node(outside=True, record=('waits', 500.0), learner=('waits', 500.0))
    patience.check(200.0, 500.0, 'waits', {}, {})


def test_a_node_that_waits_alone_gives_up_at_the_deadline():
    peers, patience = a_node('evaluate')
    peers.note(presence('record', finished=True), 10.0)
    patience.check(200.0, 60.0, 'waits', {}, {})
    with pytest.raises(NodeError, match='all others have ended or are silent'):
        patience.check(200.0, 61.0, 'waits', {}, {})


def test_the_first_cause_goes_from_node_to_node():
    own = NodeError('/r/record gave up: no room')
    cause = first_cause(own, 'record /r/record')
    assert cause == '/r/record gave up: no room'
    assert first_cause(OSError('gone'), 'record /r/record') == 'record /r/record: OSError: gone'
    peers, patience = a_node('learner')
    peers.note(presence('record', GAVE_UP + cause, finished=True, settings_hash=''), 100.0)
    with pytest.raises(NodeError, match='What came first: /r/record gave up: no room') as caught:
        patience.check(200.0, 80.0, 'waits for a commit', {}, {})
    assert first_cause(caught.value, 'learner /r/learner') == cause
    assert 'no room' in peers.absent(SETTINGS, 'hash')[-1]
    assert peers.failed() == []  # it never took part


def evaluator(silent, **changes):
    """A recorder that is about to end, and an evaluator that has published two results."""
    peers = Peers('record')
    counts = {'published': {'episodes': 2}}
    peers.note(presence('evaluate', **(counts | changes)), 200.0 - silent)
    return Settling('/r/record', peers, Limit(DEADLINE))


@pytest.mark.parametrize(
    ('silent', 'changes', 'without'),
    [
        (1.0, {'finished': True, 'doing': 'has finished'}, []),
        (61.0, {}, ['evaluate /r/evaluate']),
    ],
    ids=['has finished', 'is silent'],
)
def test_a_run_ends_with_or_without_its_evaluator(silent, changes, without):
    settling = evaluator(silent, **changes)
    assert settling.check({}, 300.0, 200.0) == (True, 'has finished')
    assert settling.without == without


def test_an_evaluator_that_works_is_waited_for_and_what_a_dead_one_has_published_is_not():
    settled, doing = evaluator(1.0).check({}, 300.0, 200.0)
    assert not settled and 'waits for the end of evaluate /r/evaluate' in doing
    dead, ledger = evaluator(61.0), Ledger()
    for role in ('evaluate', 'sim'):
        counts = {'published': {'episodes': 2}}
        ledger.note(presence(role, **counts), 1, 139.0)
    gone = [peer.presence.instance_id for peer in dead.gone(200.0)]
    missing = ledger.owed(without=gone)
    assert missing == {'episodes': 2}  # of the simulator
    with pytest.raises(NodeError, match='2 of episodes'):
        dead.check(missing, 300.0, 200.0)


def test_a_run_whose_evaluator_has_given_up_ends_well():
    peers = Peers('record')
    peers.note(presence('evaluate'), 100.0)
    last = presence('evaluate', f'{GAVE_UP}no such task', finished=True, settings_hash='')
    peers.note(last, 150.0)
    settling = Settling('/r/record', peers, Limit(DEADLINE))
    assert settling.check({}, 1.0, 200.0) == (True, 'has finished')
    assert settling.without == ['evaluate /r/evaluate']


@pytest.mark.parametrize(
    'last',
    [{}, {'finished': True, 'doing': 'has finished'}],
    ids=['is silent', 'has ended'],
)
def test_nobody_gives_up_because_of_a_simulator_that_was_left_out(last):
    """While the others work, however long that takes."""
    settings = tiny(simulators=1, joiners=('arm_2',))
    for left_out in ((), ('arm_2',)):
        peers = Peers('record')
        peers.note(presence('sim'), 199.0)
        peers.note(presence('learner'), 199.0)
        peers.note(presence('sim', node='/r/arm_2', instance_id='arm_2', **last), 50.0)
        patience = Patience(
            '/r/record', peers, ['policy', 'transitions'], Limit(DEADLINE), Log(),
            left_out=lambda peer, out=left_out: peer.left_out(settings, out),
        )  # fmt: skip
        if left_out:
            patience.check(200.0, 100.0, 'waits for a permission', {}, {})
        else:
            with pytest.raises(NodeError, match='sim /r/arm_2'):
                patience.check(200.0, 100.0, 'waits for a permission', {}, {})


def test_all_environments_of_a_simulator_must_be_left_out():
    settings = tiny(simulators=2, envs=2)
    peers = Peers('record')
    peers.note(presence('sim', node='/r/sim_2'), 0.0)
    (peer,) = peers.newest()
    assert not peer.left_out(settings, ['sim_2-1'])
    assert peer.left_out(settings, ['sim_2-1', 'sim_2-2'])


def test_a_simulator_that_is_held_when_all_is_recorded_is_waited_for_no_longer_than_the_deadline():
    peers = Peers('record')
    peers.note(presence('sim', doing='waits for permission'), 140.0)
    peers.note(presence('learner', finished=True, doing='has finished'), 141.0)
    recorded = Settling('/r/record', peers, Limit(DEADLINE), recorded=lambda peer: True)
    assert recorded.check({}, 59.0, 199.0)[0] is False
    assert recorded.check({}, 61.0, 201.0) == (True, 'has finished')
    assert recorded.without == ['sim /r/sim']
    with pytest.raises(NodeError, match='1 of true_rewards. The bag lacks that'):
        recorded.check({'true_rewards': 1}, 61.0, 201.0)
    unknown = Settling('/r/record', peers, Limit(DEADLINE))
    with pytest.raises(NodeError, match='waits for the end of sim /r/sim'):
        unknown.check({}, 61.0, 201.0)
    forever = Settling('/r/record', peers, Limit(0.0), recorded=lambda peer: True)
    assert forever.check({}, 1000.0, 2000.0)[0] is False


def test_a_recorder_to_which_something_came_waits_for_the_rest_as_long_again():
    peers = Peers('record')
    peers.note(presence('learner', finished=True, doing='has finished'), 100.0)
    settling = Settling('/r/record', peers, Limit(DEADLINE))
    lacks = ({'metrics': 2}, {'metrics': 1}, {'metrics': 1})
    for missing, now in zip(lacks, (110.0, 165.0, 220.0), strict=True):
        assert settling.check(missing, now - 100.0, now)[0] is False
    with pytest.raises(NodeError, match='1 of metrics. The bag lacks that'):
        settling.check({'metrics': 1}, 126.0, 226.0)
