"""A robot node whose time is that of a simulation: the test is the robot and publishes /clock."""

import pytest
from builtin_interfaces.msg import Time
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState

from helpers import nodes
from helpers.robot_runs import Person, RobotRun, robot_settings

pytestmark = pytest.mark.slow
ROLES = ('learner', 'reward', 'record', 'robot')
TICK = 0.01  # [s] of the simulation, every 4 ms of the machine: at most 2.5 times as fast
RATE = 20.0
PATIENCE = 1 / RATE
"""Simulated seconds that the simulation goes on without a command: a machine may be busy. By then
the next is due; a period later it would be missed."""


@pytest.fixture(scope='module', autouse=True)
def _domain():
    with nodes.domain():
        yield


class Simulation(Person):
    """A person beside a simulated robot of two joints."""

    def __enter__(self) -> 'Simulation':
        super().__enter__()
        node = self.link.node
        self.now = self.heard_at = 1000.0
        self.heard = 0  # commands
        self.clock = node.create_publisher(Clock, '/clock', 10)
        self.joints = node.create_publisher(JointState, '/joint_states', 10)
        self.ticking = node.create_timer(0.004, self.tick)
        self.ticking.cancel()
        return self

    def tick(self) -> None:
        """Let the simulation go on by a tick, unless the node is slower than it."""
        if len(self.commands) != self.heard:
            self.heard, self.heard_at = len(self.commands), self.now
        if self.heard and self.now - self.heard_at > PATIENCE:
            return
        self.now = round(self.now + TICK, 2)
        sec, hundredths = divmod(round(100 * self.now), 100)
        stamp = Time(sec=sec, nanosec=hundredths * 10**7)
        self.clock.publish(Clock(clock=stamp))
        message = JointState(name=['shoulder', 'elbow'], position=[0.1, 0.2], velocity=[0.0, 0.0])
        message.header.stamp = stamp
        self.joints.publish(message)

    def passes(self, seconds: float) -> None:
        """Wait for so much simulated time."""
        end = self.now + seconds
        self.until(lambda: self.now >= end)


def test_rate_watchdogs_and_deadlines_are_of_the_simulated_time(tmp_path):
    run = RobotRun(
        robot_settings(steps=200), tmp_path / 'run', simulated=True,
        reset={'by': 'nobody'}, watchdog={'learner': 0.0},
    )  # fmt: skip
    with run, Simulation(run) as person:
        for name in run.names:
            run.start(name)
        person.joints.publish(JointState())  # its topic is there; the time is not
        person.until(lambda: 'the time on /clock, which use_sim_time asks for' in waits(person))
        assert person.commands == []
        person.until(lambda: person.tick() or person.sees_commands())
        person.ticking.reset()
        person.until(person.moves)

        before, count = person.now, len(person.commands)
        person.passes(4.0)
        rate = (len(person.commands) - count) / (person.now - before)
        assert rate == pytest.approx(RATE, rel=0.1)

        person.ticking.cancel()
        person.until(lambda: '/clock stood still' in run.log('robot'))
        person.until(lambda: not any(person.commands[-1]))
        resting = len(person.commands)
        person.until(lambda: 'stood still' in waits(person))
        assert len(person.commands) == resting  # no control step is due
        person.ticking.reset()
        person.until(person.moves)
        person.until(lambda: None not in [run.codes()[name] for name in ROLES])
        assert {run.codes()[name] for name in ROLES} == {0}
        counters = run.report('robot')['counters']
        assert counters.get('control deadlines missed', 0) == 0
        # it stands still as well where the test does
        assert counters['episodes cut by clock'] >= 1


def waits(person: Person) -> str:
    """What the robot node waits for, as it publishes it."""
    there = person.presence.get('robot')
    return there.doing if there else ''
