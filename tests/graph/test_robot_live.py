"""One run on a robot in real time, in real processes, that goes on while this and that goes wrong.

All tests of this module share it, in any order: the arm with its camera knows nothing of this
project, the run has a key, and the test is the person and the robot's heartbeat.
"""

import signal
from itertools import pairwise

import numpy as np
import pytest
from lifecycle_msgs.msg import State
from rclpy.parameter import Parameter
from rclpy.parameter_client import AsyncParameterClient
from std_msgs.msg import Empty

from codetr_ros.nodes import signing
from codetr_ros.records import Policy, Transitions
from helpers import nodes
from helpers.robot_runs import EXAMPLE, Person, RobotRun, robot_settings

pytestmark = pytest.mark.slow

LOW, HIGH, CHANGE = np.array([-1.0, -1.5]), np.array([1.2, 1.0]), 20.0
SCALE = np.array([1.5, 2.0])
HEARTBEAT = '/arm/heartbeat'
SETTINGS = robot_settings(
    steps=100_000, phase_steps=10, warmup_steps=40, memory_steps=2000,
    scorers=('robot', 'inspection'),
)  # fmt: skip
KINDS = {
    'noise': {'noise': 0.05},
    'latency': {'latency': 0.1},
    'jitter': {'jitter': 0.03},
    'dropped': {'dropped': 0.2},
    'stuck': {'stuck': 3.0, 'stuck_for': 0.3},
}


class Onlooker(Person):
    """A person who also reads the run, keeps the heartbeat going, and can let things go wrong."""

    def __enter__(self) -> 'Onlooker':
        super().__enter__()
        self.chunks: list[Transitions] = []
        self.policies: list[Policy] = []
        for kind, into in ((Transitions, self.chunks), (Policy, self.policies)):
            self.link.subscribe(
                kind, lambda k, data, into=into: into.extend(self.sound(k, data)), SETTINGS
            )
        node = self.link.node
        self.heart = node.create_publisher(Empty, HEARTBEAT, 10)
        self.beats = node.create_timer(0.1, lambda: self.heart.publish(Empty()))
        self.faults = AsyncParameterClient(node, '/arm')
        return self

    @property
    def steps(self) -> int:
        """Whole steps so far."""
        return sum(chunk.steps for chunk in self.chunks)

    def goes_on(self, steps: int = 10) -> None:
        """Wait for so many further steps."""
        wanted = self.steps + steps
        self.until(lambda: self.steps >= wanted)

    def let_go_wrong(self, **faults: float) -> None:
        """Let only this go wrong with the arm from now on."""
        wanted = dict.fromkeys(('noise', 'latency', 'jitter', 'dropped', 'stuck'), 0.0) | faults
        self.until(self.faults.services_are_ready)
        future = self.faults.set_parameters_atomically(
            [Parameter(name, value=value) for name, value in wanted.items()]
        )
        self.until(future.done)
        assert future.result().result.successful


@pytest.fixture(scope='module')
def going(tmp_path_factory):
    """The run, and the person who looks on."""
    live = {
        'limits': {'low': LOW.tolist(), 'high': HIGH.tolist(), 'change': CHANGE},
        'watchdog': {'learner': 0.0, 'heartbeat': HEARTBEAT, 'heartbeat_age': 0.5},
    }
    with nodes.domain():
        run = RobotRun(
            SETTINGS, tmp_path_factory.mktemp('robot') / 'run', key=signing.new_key(), **live
        )
        with run, Onlooker(run) as person:
            run.begin('--sound', '--late', '1.5', '--missing', '0.3')
            person.until(lambda: person.committed(1))
            yield run, person


@pytest.fixture
def run(going):
    return going[0]


@pytest.fixture
def person(going):
    return going[1]


@pytest.mark.parametrize('kind', KINDS)
def test_the_run_goes_on_whatever_is_wrong_with_the_arm_which_only_its_own_log_has(
    kind, run, person
):
    before = len(run.truth())
    person.let_go_wrong(**KINDS[kind])
    person.goes_on(30)
    person.let_go_wrong()
    lines = run.truth()[before:]
    changed = [line['faults'] for line in lines if 'faults' in line]
    assert changed[-2][kind] == KINDS[kind][kind]
    noted = {line['fault'] for line in lines if 'fault' in line}
    expected = {
        'dropped': {'command dropped', 'measurement dropped'},
        'stuck': {'joint stuck'},
    }
    assert noted == expected.get(kind, set())


def test_nothing_that_was_published_is_lost_or_refused_by_the_run(run, person):
    person.goes_on(20)
    assert {'robot', 'record', 'reward', 'learner'} <= set(person.counters)
    for name, counters in person.counters.items():
        bad = {k: n for k, n in counters.items() if k.split()[0] in ('lost', 'refused')}
        assert not bad, (name, bad)
    sequences = [chunk.sequence for chunk in person.chunks]
    # a test that is kept from listening misses some
    assert all(later > earlier for earlier, later in pairwise(sequences))


def test_the_policy_sees_the_joints_and_nothing_else(person):
    """What is known of faults stands in a file of the arm, and no topic carries it."""
    node = person.link.node
    own = {
        topic
        for name in ('robot', 'robot_driver')
        for topic, _ in node.get_subscriber_names_and_types_by_node(name, nodes.NAMESPACE)
        if not topic.startswith(nodes.NAMESPACE)
    }
    mapped = {'/joint_states', '/arm/late_score', '/arm/emergency_stop', HEARTBEAT}
    assert own - {'/parameter_events', '/clock'} == mapped
    assert {chunk.observations.shape[1] for chunk in person.chunks} == {4}


def test_no_command_of_the_wildest_policy_leaves_the_limits(person):
    person.goes_on(20)
    commands = np.array(person.commands)
    assert (commands >= LOW - 1e-9).all() and (commands <= HIGH + 1e-9).all()
    reached = (np.abs(commands - LOW) < 1e-9) | (np.abs(commands - HIGH) < 1e-9)
    assert reached.any()  # it wanted more
    # a safe command is sent at once; others change by no more than the limit in a period
    moving = np.array([(a, b) for a, b in pairwise(commands) if np.any(a) and np.any(b)])
    assert (np.abs(np.diff(moving, axis=1)) <= CHANGE / 20 + 1e-6).mean() > 0.98


def test_each_recorded_action_is_the_one_command_of_its_step_also_where_a_policy_arrived(person):
    wanted = len({policy.version for policy in person.policies}) + 2
    person.until(lambda: len({policy.version for policy in person.policies}) >= wanted)
    person.goes_on(20)
    said = [tuple(np.round(np.array(c) / SCALE, 5)) for c in person.commands]
    found = 0
    whole = person.chunks[1:-1]
    for chunk in whole:
        done = [tuple(np.round(action.astype(float), 5)) for action in chunk.actions]
        size = len(done)
        found += any(said[i : i + size] == done for i in range(len(said) - size + 1))
    assert found > 0.9 * len(whole)  # a test that is kept from listening misses commands


def test_where_no_new_policy_comes_for_too_long_it_gets_the_safe_command_until_one_does(
    run, person
):
    person.until(person.moves)
    run.end('learner', signal.SIGSTOP)
    person.until(lambda: 'the learner is 8 phases behind' in run.log('robot'))
    person.until(person.rests)
    run.end('learner', signal.SIGCONT)
    person.until(person.moves)


def test_without_the_heartbeat_it_gets_the_safe_command_until_it_beats_again(run, person):
    person.until(person.moves)
    person.beats.cancel()
    person.until(lambda: f'{HEARTBEAT} was silent for' in run.log('robot'))
    person.until(person.rests)
    person.beats.reset()
    person.until(person.moves)


def test_scores_of_the_robots_own_topic_come_late_or_never_and_join_a_later_commit(person):
    phases = {}

    def late() -> bool:
        for chunk in person.chunks:
            for step in range(chunk.first_step, chunk.first_step + chunk.steps):
                phases[chunk.episode, step] = chunk.phase
        taken = -1
        for commit in person.commits:
            before, taken = (
                taken,
                dict(zip(commit.scorers, commit.scores, strict=True)).get('robot', taken),
            )
            for score in person.scores:
                if score.scorer == 'robot' and before < score.sequence <= taken:
                    last = (score.episode, score.first_step + score.length - 1)
                    if phases.get(last, commit.phase) < commit.phase:
                        return True
        return False

    person.until(late)
    own = {(s.episode, s.first_step) for s in person.scores if s.scorer == 'robot'}
    everything = {(chunk.episode, chunk.first_step // 20 * 20) for chunk in person.chunks[:-10]}
    assert own and everything - own  # the camera has missed some
    person.until(lambda: {s.scorer for s in person.scores} == {'robot', 'inspection'})
    best = [s.value for s in person.scores if s.scorer == 'robot']
    assert min(best) > 0 and max(best) <= 20


def test_lifecycle_services_do_what_they_are_called(person):
    person.until(person.moves)
    assert person.state() == State.PRIMARY_STATE_ACTIVE
    assert not person.change('activate')  # it is, and the answer comes
    assert person.change('deactivate')
    assert person.state() == State.PRIMARY_STATE_INACTIVE
    person.until(lambda: not any(person.commands[-1]))  # the safe command
    seen = person.measurements
    person.until(lambda: person.measurements > seen + 5)  # what was under way has arrived
    count = len(person.commands)
    seen = person.measurements
    person.until(lambda: person.measurements > seen + 20)
    assert len(person.commands) == count  # and then none
    assert person.change('cleanup')
    assert person.state() == State.PRIMARY_STATE_UNCONFIGURED
    assert not person.change('activate')
    assert person.change('configure')
    assert len(person.commands) == count
    assert person.change('activate')
    person.goes_on()


def test_the_example_names_its_scorer():
    assert 'scorers: [inspection]' in (EXAMPLE / 'settings.yaml').read_text()
