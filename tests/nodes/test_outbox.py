"""What a node has published is kept for a while, for readers that lack some of it."""

import pytest

from codetr_ros.nodes.outbox import LABELS, Outbox
from helpers.builders import step_rewards, transitions


def labelled(outbox, phases):
    for phase in phases:
        outbox.keep(step_rewards(phase=phase), stamp=phase)


def test_labels_are_owed_until_a_reader_asks_for_those_of_a_later_phase():
    outbox = Outbox(phase_steps=5, phases=3)
    labelled(outbox, range(2))
    assert not outbox.owes, 'there is room for one phase more'
    labelled(outbox, [2])
    assert outbox.owes
    list(outbox.read(0, [LABELS]))
    assert outbox.owes, 'the answer may be lost: the reader asks again'
    list(outbox.read(1, [LABELS]))
    assert not outbox.owes, 'phase 0 may go'
    labelled(outbox, [3])
    assert outbox.owes


def test_a_reader_that_asks_for_labels_to_come_lacks_none_of_those_before():
    outbox = Outbox(phase_steps=5, phases=3)
    labelled(outbox, range(3))
    with pytest.raises(KeyError, match='nothing of phase 9 is kept'):
        outbox.read(9, [LABELS])
    assert not outbox.owes


def test_nobody_waits_for_readers_of_anything_but_labels():
    outbox = Outbox(phase_steps=5, phases=1)
    outbox.keep(transitions(), stamp=1)
    assert not outbox.owes
    labelled(outbox, [1])
    list(outbox.read(1))
    list(outbox.read(1, [LABELS, 'codetr_msgs/msg/Metrics']))
    assert outbox.owes, 'the recorder asks for all that was published'


def test_of_a_phase_between_others_there_may_be_nothing():
    """An evaluator has results of some policies only; who asks back from the newest goes on."""
    outbox = Outbox(phase_steps=5, phases=None)
    for phase in (0, 4):
        outbox.keep(transitions(phase=phase), stamp=phase)
    assert [len(list(outbox.read(phase))) for phase in range(5)] == [1, 0, 0, 0, 1]
    with pytest.raises(KeyError, match='nothing of phase 5 is kept; of these is: 0, 4'):
        outbox.read(5)
