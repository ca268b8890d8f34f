"""What is observed is young, whole and finite; everything else is counted."""

from types import SimpleNamespace

import pytest

from codetr_ros.robots import senses
from helpers.robots import joints, rules


def stamp(now: float) -> SimpleNamespace:
    sec = int(now)
    return SimpleNamespace(stamp=SimpleNamespace(sec=sec, nanosec=round((now - sec) * 1e9)))


def test_nothing_is_observed_before_every_topic_has_brought_something():
    both = [*rules().observation, {'topic': '/odom', 'fields': ['x']}]
    made = senses.Senses(rules(observation=[dict(both[0]), both[1]]))
    made.take('/joint_states', joints(), 1.0)
    assert (made.lacking(), made.size, made.observe(1.0)) == (['/odom'], 0, None)
    made.take('/odom', SimpleNamespace(x=7.0), 1.0)
    assert made.observe(1.0).tolist() == [0, 0, 0, 0, 7] and made.size == 5


def test_joints_are_found_by_name_in_whatever_order():
    made = senses.Senses(rules())
    made.take('/joint_states', joints(1.0, 2.0, 3.0), 0.0)
    assert made.observe(0.0).tolist() == [1, 2, 3, 3]


def test_what_is_too_old_is_named_with_its_age():
    made = senses.Senses(rules())
    made.take('/joint_states', joints(), 0.0)
    assert made.old(0.25) == [] and made.observe(0.25) is not None
    assert made.old(0.5) == ['/joint_states is 0.50 s old'] and made.observe(0.5) is None


def test_by_header_the_age_is_that_of_the_stamp_and_a_late_message_is_no_newer():
    made = senses.Senses(rules(time='header'))
    new, late = joints(1.0), joints(2.0)
    new.header, late.header = stamp(10.0), stamp(9.9)
    made.take('/joint_states', new, 10.01)
    made.take('/joint_states', late, 10.02)
    assert made.observe(10.1)[0] == 1.0
    assert made.old(10.3) == ['/joint_states is 0.30 s old']


def test_stamps_of_another_clock_are_named_as_such():
    made = senses.Senses(rules(time='header'))
    simulated = joints(1.0)
    simulated.header = stamp(10.0)
    made.take('/joint_states', simulated, 1.7e9)
    assert 'its stamps are of another clock: set use_sim_time' in made.old(1.7e9)[0]


@pytest.mark.parametrize(
    ('message', 'what'),
    [
        (SimpleNamespace(name=['a'], position=[1.0], velocity=[1.0]), senses.NO_JOINTS),
        (SimpleNamespace(name=['a', 'a', 'b'], position=[1, 2, 3], velocity=[1, 2, 3]),
         senses.JOINT_TWICE),
        (joints(float('nan')), senses.NOT_FINITE),
        (SimpleNamespace(data=[1.0]), senses.UNREADABLE),
    ],
)  # fmt: skip
def test_what_cannot_be_used_is_counted_and_changes_nothing(message, what):
    made = senses.Senses(rules())
    made.take('/joint_states', joints(5.0), 0.0)
    made.take('/joint_states', message, 0.1)
    assert made.counts == {what: 1} and made.observe(0.1)[0] == 5.0


def test_after_a_clock_that_was_set_back_nothing_is_held():
    made = senses.Senses(rules())
    made.take('/joint_states', joints(), 50.0)
    made.forget()
    assert made.observe(1.0) is None
    made.take('/joint_states', joints(), 1.0)
    assert made.observe(1.0) is not None
