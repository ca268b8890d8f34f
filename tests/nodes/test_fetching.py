"""A node asks for a phase again that stays incomplete: not at once, and not without end."""

from codetr_ros.nodes.fetching import AFTER, AGAIN, Fetching, Offered


def test_a_phase_is_asked_for_when_it_stays_incomplete_and_again_after_a_while():
    fetching = Fetching()
    times = [0.0, AFTER - 0.1, AFTER, AFTER + 1, AFTER + AGAIN]
    assert [fetching.due(3, now) for now in times] == [False, False, True, False, True]


def test_another_phase_or_a_whole_one_begins_the_wait_anew():
    fetching = Fetching()
    assert not fetching.due(3, 0.0)
    assert not fetching.due(None, AFTER)
    assert not fetching.due(3, AFTER + 1)
    assert not fetching.due(4, 2 * AFTER + 1)
    assert fetching.due(4, 3 * AFTER + 1)


def test_labels_that_another_node_offers_are_lost_only_if_they_do_not_arrive_for_a_while():
    offered = Offered()
    assert not offered.lost(3, 100.0)  # published a moment ago
    assert not offered.lost(3, 100.0 + AFTER - 0.1)
    assert offered.lost(3, 100.0 + AFTER)
    assert not offered.lost(4, 200.0)
