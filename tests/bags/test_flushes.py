"""How long a bag takes to get to the disk."""

import pytest

from codetr_ros.bags import flushes
from codetr_ros.bags.flushes import NEWEST, Flushes


def test_the_time_and_the_longest_are_of_all_flushes_and_the_median_of_the_newest(monkeypatch):
    clock = iter([0.0, 5.0, *(t for i in range(NEWEST) for t in (10.0 + i, 10.5 + i))])
    monkeypatch.setattr(flushes.time, 'perf_counter', lambda: next(clock))
    some = Flushes()
    assert (some.seconds, some.times().median, some.times().max) == (0.0, 0.0, 0.0)
    for _ in range(NEWEST + 1):
        with some.timed():
            pass
    assert some.seconds == 5.0 + 0.5 * NEWEST
    assert (some.times().median, some.times().max) == (500.0, 5000.0)


def test_a_flush_that_fails_is_not_counted():
    some = Flushes()
    with pytest.raises(OSError, match='full'), some.timed():
        raise OSError('full')
    assert some.seconds == 0.0
