"""What has not arrived is counted by who has published it, and each message once."""

import pytest

from codetr_ros.nodes.ledger import Ledger
from helpers.builders import presence, task_spec, transitions

STEPS = [transitions(sequence=number) for number in range(9)]


def hear(ledger, stamp, published, instance='sim 1', node='/r/sim', now=0.0):
    """Let the ledger hear of a process how many steps it has published."""
    counts = {'transitions': published}
    ledger.note(presence('sim', counts, node=node, instance_id=instance), stamp, now)


@pytest.fixture
def ledger():
    """One whose only simulator has published five chunks, at 1 to 5 ns, of which 2 is lost."""
    made = Ledger(patience=5.0)
    for number in (1, 3, 4, 5):
        made.arrived(STEPS[number], 'sim 1', number)
    hear(made, 6, 5)
    return made


def test_what_is_counted_and_has_not_arrived_is_owed_at_once_and_lost_after_a_while(ledger):
    assert ledger.owed() == {'transitions': 1}
    assert ledger.owing() == ['/r/sim']
    assert ledger.lost(4.9) == {}
    assert ledger.lost(5.0) == {'transitions': 1}
    ledger.sent_again(STEPS[2], 'sim 1', 2)
    assert ledger.owed() == ledger.lost(9.0) == {}
    assert ledger.owing() == []


def test_what_came_early_and_was_set_aside_makes_up_for_no_loss(ledger):
    ledger.set_aside(STEPS[3])
    assert ledger.owed() == {'transitions': 2}
    for number in (1, 3, 4, 5):  # all that is kept is sent again, new or not
        ledger.sent_again(STEPS[number], 'sim 1', number)
    assert ledger.owed() == {'transitions': 1}


def test_a_message_that_comes_twice_or_comes_late_makes_up_for_no_loss(ledger):
    ledger.arrived(STEPS[4], 'sim 1', 4)
    ledger.sent_again(STEPS[7], 'sim 1', 7)
    ledger.arrived(STEPS[7], 'sim 1', 7)  # it was under way
    hear(ledger, 8, 6)
    assert ledger.owed() == {'transitions': 1}


def test_a_record_that_was_published_twice_is_to_come_twice():
    ledger, announced = Ledger(), task_spec()
    ledger.note_own('sim 1', {'task': 2}, 0.0)
    ledger.arrived(announced, 'sim 1', 1)
    assert ledger.owed() == {'task': 1}
    ledger.sent_again(announced, 'sim 1', 2)
    assert ledger.owed() == {}


def test_what_one_node_sends_makes_up_for_no_loss_of_another(ledger):
    for number in range(1, 4):
        ledger.arrived(STEPS[number], 'other 1', number)
    assert ledger.owed() == {'transitions': 1}
    hear(ledger, 9, 3, 'other 1', '/r/other')
    assert ledger.owed() == {'transitions': 1}
    assert ledger.owed(without=['sim 1']) == {}


def test_who_begins_late_is_owed_what_is_published_later_alone(ledger):
    ledger.arrived(STEPS[7], 'sim 1', 7)  # no presence counts it yet
    ledger.forgive()
    ledger.arrived(STEPS[2], 'sim 1', 2)  # it was under way
    ledger.sent_again(STEPS[0], 'sim 1', 0)
    hear(ledger, 9, 7)  # of numbers 7 and 8, one is there
    assert ledger.owed() == {'transitions': 1}


def test_of_a_node_that_was_started_again_only_what_the_new_process_publishes_is_owed(ledger):
    hear(ledger, 7, 0, 'sim 2')
    assert ledger.owed() == {}
    hear(ledger, 9, 1, 'sim 2')
    assert ledger.owed() == {'transitions': 1}


def test_who_names_no_sender_counts_for_nothing(ledger):
    ledger.arrived(STEPS[2], '', 2)
    assert ledger.owed() == {'transitions': 1}
