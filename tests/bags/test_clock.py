"""Where a clock went back, and where messages are merely out of order."""

import random
from pathlib import Path

import pytest

from codetr_ros.bags.clock import Clock
from codetr_ros.bags.errors import BagError, Place

MS = 1_000_000


def follow(*messages):
    """The clock after messages (topic, time [ms]), and the numbers of those that begin periods."""
    clock = Clock()
    for i, (topic, time) in enumerate(messages):
        clock.take(topic, time * MS, Place(Path('x.mcap'), i), i)
    return clock, [period.block for period in clock.periods]


def ticks(*topics, begin=0, end=1000, every=20):
    """Messages of topics in turn, 2 ms one after the other."""
    return [(t, at + 2 * i) for at in range(begin, end, every) for i, t in enumerate(topics)]


def test_a_file_written_topic_by_topic_has_one_clock():
    clock, begins = follow(*ticks('/a'), *ticks('/b'), *ticks('/c', every=300))
    assert begins == [0]
    assert clock.periods[0].late == 50 + 4 - 1  # the last of /b is later than all of /a


@pytest.mark.parametrize('begin', [0, 300, 700])
def test_a_clock_that_goes_back_begins_a_period(begin):
    first = ticks('/a', '/b')
    clock, begins = follow(*first, *ticks('/a', '/b', begin=begin))
    assert begins == [0, len(first)]
    assert clock.periods[1].fall.topic == '/a'
    assert [period.late for period in clock.periods] == [0, 0]


def test_a_short_attempt_of_twenty_messages_is_told_apart():
    once = ticks('/a', '/b', end=200)
    assert follow(*once, *once, *once)[1] == [0, 20, 40]


def test_one_late_message_is_out_of_order_only():
    clock, begins = follow(
        *ticks('/a', '/b'), ('/a', 100), *ticks('/a', '/b', begin=1000, end=1500)
    )
    assert begins == [0]
    assert clock.periods[0].late == 1
    assert clock.periods[0].lateness == (982 - 100) * MS


@pytest.mark.parametrize('most', [20, 100, 300])
def test_messages_written_by_threads_are_out_of_order_only(most):
    rng = random.Random(most)
    messages = sorted(ticks('/a', '/b', end=5000), key=lambda one: one[1] + rng.uniform(0, most))
    assert follow(*messages)[1] == [0]


def test_topics_that_do_not_agree_whether_the_clock_went_back_are_refused():
    first, second = ticks('/a', '/b'), [*ticks('/a'), *ticks('/b', begin=1000, end=2000)]
    with pytest.raises(BagError, match='/a goes back from 980000000 to .* other topics go on'):
        follow(
            *first, *(one for pair in zip(second[:50], second[50:], strict=True) for one in pair)
        )


def test_what_comes_while_a_fall_is_doubted_is_counted_once_it_is_refuted():
    first = ticks('/a', '/b')
    clock, begins = follow(*first, ('/a', 100), ('/new', 90), ('/b', 1002))
    assert begins == [0]
    assert clock.periods[0].late == 2
    assert '/new' in clock.periods[0].spans


@pytest.mark.parametrize('time', [0, 90])
@pytest.mark.parametrize('before', [[], [('/rare', 500)]])
def test_a_rare_topic_may_be_the_first_after_the_clock_went_back(time, before):
    first = [*before, *ticks('/a', '/b')]
    clock, begins = follow(*first, ('/rare', time), ('/rare', time + 1), *ticks('/a', '/b'))
    assert begins == [0, len(first)]
    assert '/rare' in clock.periods[1].spans
    assert ('/rare' in clock.periods[0].spans) == bool(before)
    assert clock.periods[0].lateness <= 500 * MS


def test_a_rare_topic_that_is_only_late_stays_in_its_period():
    clock, begins = follow(
        *ticks('/a', '/b'), ('/rare', 500), *ticks('/a', '/b', begin=1000, end=1200)
    )
    assert begins == [0] and clock.periods[0].late == 1
