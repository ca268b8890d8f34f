"""The stand-in arm has faults drawn by its seed: noted in its log, and in no message."""

import sys
from pathlib import Path

import numpy as np
import pytest

EXAMPLE = Path(__file__).resolve().parents[2] / 'examples' / 'robot_arm'


@pytest.fixture(scope='module')
def arm():
    sys.path.insert(0, str(EXAMPLE))
    try:
        import arm

        yield arm
    finally:
        sys.path.remove(str(EXAMPLE))


def faults(arm, **changes):
    none = dict.fromkeys(('noise', 'latency', 'jitter', 'dropped', 'stuck', 'stuck_for'), 0.0)
    return arm.Faults(**(none | changes))


def driven(made, seconds: float, speeds=(0.5, 0.5)) -> list:
    """What is measured while the arm is told the same speeds twenty times a second."""
    measured = []
    for i in range(round(seconds / 0.005)):
        if i % 10 == 0:
            made.command(np.array(speeds))
        made.tick()
        if i % 4 == 3:
            measured.append(made.measured())
    return measured


def test_without_faults_it_moves_as_told_and_measures_where_it_is(arm):
    made = arm.Arm(0, faults(arm))
    measured = driven(made, 2.0)
    np.testing.assert_array_equal(measured[-1][0], made.joints)
    assert made.joints == pytest.approx([0.5 * 1.92] * 2, abs=0.01)  # 80 ms to get going
    assert made.log == []


def test_a_joint_sticks_and_only_the_log_has_it(arm):
    made = arm.Arm(3, faults(arm, stuck=0.5, stuck_for=0.4))
    measured = driven(made, 6.0)
    stuck = [line for line in made.log if line['fault'] == 'joint stuck']
    assert stuck and {line['joint'] for line in stuck} <= {0, 1}
    first = stuck[0]
    at = round(first['time'] / 0.02)
    positions = np.array([p for p, _ in measured])[:, first['joint']]
    assert positions[at + 1] == positions[at + 15]  # it does not move, and states so
    assert all(len(each) == 2 for each in measured)  # positions and speeds, and nothing else


def test_messages_get_lost_in_both_directions(arm):
    made = arm.Arm(0, faults(arm, dropped=0.2))
    measured = driven(made, 10.0)
    lost = sum(each is None for each in measured)
    assert lost == sum(line['fault'] == 'measurement dropped' for line in made.log) > 50
    assert sum(line['fault'] == 'command dropped' for line in made.log) > 20


def test_commands_arrive_late_by_latency_and_jitter(arm):
    made = arm.Arm(0, faults(arm, latency=0.05, jitter=0.02))
    made.command(np.array([1.0, 0.0]))
    moved = []
    for _ in range(20):
        made.tick()
        moved.append(bool(made.speed[0]))
    assert 0.05 <= (moved.index(True) + 1) * 0.005 <= 0.075


def test_measurements_are_noisy(arm):
    made = arm.Arm(0, faults(arm, noise=0.01))
    off = np.array([made.measured()[0] - made.joints for _ in range(2000)])
    assert off.std() == pytest.approx(0.01, rel=0.05)


def test_the_same_seed_has_the_same_faults(arm):
    logs = []
    for seed in (5, 5, 6):
        made = arm.Arm(seed)
        driven(made, 5.0)
        logs.append(made.log)
    assert logs[0] == logs[1] != logs[2]
