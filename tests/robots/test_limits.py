"""Commands keep to the limits, and what is recorded is what was commanded."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codetr_ros.robots.limits import Limiter
from helpers.robots import rules

POSITION = {
    'topic': '/joint_states',
    'fields': ['position'],
    'joints': ['a', 'b'],
    'low': [-1.0, -1.0],
    'high': [1.0, 2.0],
    'ahead': 0.5,
}


def limiter(kind: str = 'velocity', **limits) -> Limiter:
    command = {'type': 'std_msgs/msg/Float64MultiArray', 'kind': kind, 'safe': [0.0, 0.0]}
    return Limiter(rules({'command': command, 'limits': limits}))


def action(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def test_an_action_is_scaled_to_the_range_of_each_component():
    made = limiter().command(action(1.0, -0.5), None, None)
    assert (made.command.tolist(), made.changed_by) == ([1.5, -1.0], ())


def test_an_action_that_no_limit_changes_is_recorded_bit_for_bit():
    wanted = action(0.1, 1 / 3)
    assert limiter().command(wanted, None, None).action.tobytes() == wanted.tobytes()


def test_a_narrower_range_changes_the_command_and_what_is_recorded():
    made = limiter(low=-0.75, high=0.75).command(action(1.0, -0.1), None, None)
    assert made.command.tolist() == pytest.approx([0.75, -0.2])
    assert made.action.tolist() == pytest.approx([0.5, -0.1])
    assert made.changed_by == ('range',)


def test_a_command_changes_no_faster_than_allowed_from_the_one_that_was_sent():
    limited = limiter(change=[3.0, 100.0])  # at 10 Hz: 0.3 a step
    made = limited.command(action(1.0, 1.0), np.array([0.2, 0.0]), None)
    assert made.command.tolist() == pytest.approx([0.5, 2.0])
    assert made.changed_by == ('change',)


def test_a_velocity_leads_no_further_than_the_positions_allow():
    limited = limiter(position=POSITION)
    near = limited.command(action(1.0, 1.0), None, np.array([0.9, 0.0]))
    assert near.command.tolist() == pytest.approx([0.2, 2.0])  # 0.1 left, in half a second
    beyond = limited.command(action(1.0, -1.0), None, np.array([1.1, -3.0]))
    assert beyond.command.tolist() == [0.0, 0.0]
    back = limited.command(action(-1.0, 1.0), None, np.array([1.1, -3.0]))
    assert back.command.tolist() == [-1.5, 2.0]


def test_positions_have_the_last_word_against_the_rate_of_change():
    limited = limiter(position=POSITION, change=1.0)
    made = limited.command(action(1.0, 0.0), np.array([1.5, 0.0]), np.array([1.0, 0.0]))
    assert made.command.tolist() == [0.0, 0.0]
    assert made.changed_by == ('position',)  # a change of 1.5 in one step


def test_an_effort_pushes_no_joint_further_out():
    limited = limiter('effort', position=POSITION)
    made = limited.command(action(1.0, -1.0), None, np.array([1.0, 0.0]))
    assert made.command.tolist() == [0.0, -2.0]


def test_a_position_is_kept_within_the_limits_of_positions():
    made = limiter('position', position=POSITION).command(action(1.0, -1.0), None, None)
    assert made.command.tolist() == [1.0, -1.0]


numbers = st.tuples(*[st.floats(-1, 1, width=32)] * 2)


@given(numbers, st.tuples(*[st.floats(-2, 2)] * 2), st.tuples(*[st.floats(-3, 3)] * 2))
def test_whatever_is_asked_for_no_command_breaks_a_limit(wanted, before, positions):
    limited = limiter(low=[-1.0, -1.5], high=[1.5, 1.0], position=POSITION)
    made = limited.command(action(*wanted), np.array(before), np.array(positions))
    assert (made.command >= [-1.0, -1.5]).all() and (made.command <= [1.5, 1.0]).all()
    ahead = np.array(positions) + made.command * 0.5
    inside = (np.array(positions) >= [-1, -1]) & (np.array(positions) <= [1, 2])
    assert (~inside | ((ahead >= [-1 - 1e-9, -1 - 1e-9]) & (ahead <= [1 + 1e-9, 2 + 1e-9]))).all()
    assert (np.abs(made.action) <= 1).all()
    np.testing.assert_allclose(limited.scaled(made.action), made.command, atol=1e-6)


def test_the_safe_command_holds_the_measured_positions_where_so_mapped():
    command = {'type': 'a/msg/B', 'kind': 'position', 'safe': 'hold'}
    limited = Limiter(rules({'command': command, 'limits': {'position': POSITION}}))
    assert limited.safe(None) is None
    assert limited.safe(np.array([0.3, 0.4])).tolist() == [0.3, 0.4]
    assert limiter().safe(None).tolist() == [0.0, 0.0]
