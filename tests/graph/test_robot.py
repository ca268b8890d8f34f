"""A robot with topics of its own, in real processes and real time: what it is told, and when.

The arm knows nothing of this project; the person is a test.
"""

import signal

import numpy as np
import pytest
from std_msgs.msg import Bool

from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.records import Commit, CompositeReward, Transitions
from codetr_ros.runs import folder as run_folder
from helpers import nodes
from helpers.robot_runs import Person, RobotRun, robot_settings

pytestmark = pytest.mark.slow
ROLES = ('learner', 'reward', 'record', 'robot')


@pytest.fixture(scope='module', autouse=True)
def _domain():
    with nodes.domain():
        yield


def test_a_run_on_a_robot_ends_by_itself_and_records_what_was_commanded(tmp_path):
    settings = robot_settings()
    limits = {'change': 20.0}
    with RobotRun(settings, tmp_path / 'run', autostart=False, limits=limits) as run:
        with Person(run) as person:
            run.begin()
            person.until(lambda: 'is not moved before' in run.log('robot'))
            person.until(person.sees_commands)  # before the first goes out
            person.until(lambda: 'inspection' in person.readers('transitions'))
            person.activate()
            person.until(lambda: person.committed(2))
            commands = np.array(person.commands)
        assert {run.wait(*ROLES)[name] for name in ROLES} == {0}
        report = run.report('robot')
        truth = run.truth()
    found = verify(tmp_path / 'run' / run_folder.BAG)
    assert found.sound, found.findings.named
    records = [entry.record for entry in Bag(tmp_path / 'run' / run_folder.BAG).entries()]
    chunks = [r for r in records if isinstance(r, Transitions)]
    assert sum(r.steps for r in chunks) == settings.steps
    actions = np.concatenate([r.actions for r in chunks])
    told = {tuple(np.round(c / [1.5, 2.0], 5)) for c in commands}
    seen = [tuple(np.round(a.astype(float), 5)) in told for a in actions]
    assert np.mean(seen) > 0.95  # commands go out best effort
    assert (np.abs(np.diff(commands, axis=0)) <= 20.0 / 20 + 1e-9).mean() > 0.9
    assert report['counters']['commands changed by limit change'] > 0
    scores = [r for r in records if isinstance(r, CompositeReward)]
    assert {r.scorer for r in scores} == {'inspection'}
    assert len([r for r in records if isinstance(r, Commit)]) == 3
    assert any('attempt' in line for line in truth)


def test_it_does_not_move_before_it_is_activated_and_obeys_a_person(tmp_path):
    waiting = RobotRun(robot_settings(steps=4000), tmp_path / 'run', autostart=False)
    with waiting as run, Person(run) as person:
        run.begin(inspection=False)
        person.until(lambda: 'is not moved before' in run.log('robot'))
        assert person.commands == []
        person.activate()
        person.until(person.moves)

        assert person.call('pause', True).message == 'paused'
        person.until(person.rests)
        person.call('pause', False)
        person.until(person.moves)

        person.until(lambda: person.button.get_subscription_count() > 0)
        person.button.publish(Bool(data=True))
        person.until(person.rests)
        assert not person.call('resume').success  # the button is still pressed
        person.button.publish(Bool(data=False))
        person.ticks(6)
        assert person.rests()  # releasing the button is not resuming
        assert person.call('resume').success
        person.until(person.moves)

        assert person.call('stop').success
        person.until(person.rests)
        assert person.call('resume').success
        assert not person.call('ready').success  # no person resets this robot


@pytest.mark.parametrize(
    ('who', 'said'),
    [('arm', '/joint_states is'), ('learner', 'the learner was silent for')],
)
def test_silence_of_the_robot_or_the_learner_brings_the_safe_command(tmp_path, who, said):
    watchdog = {'learner': 1.5}
    watched = RobotRun(robot_settings(steps=4000), tmp_path / 'run', watchdog=watchdog)
    with watched as run, Person(run) as person:
        run.begin(inspection=False)
        person.until(person.moves)
        run.end(who, signal.SIGSTOP)
        person.until(lambda: said in run.log('robot'))
        person.until(person.rests)
        run.end(who, signal.SIGCONT)
        person.until(person.moves)  # it goes on by itself


def test_stopped_by_a_signal_it_leaves_the_robot_with_the_safe_command(tmp_path):
    with RobotRun(robot_settings(steps=4000), tmp_path / 'run') as run:
        with Person(run) as person:
            run.begin(inspection=False)
            person.until(person.moves)
            run.end('robot', signal.SIGTERM)
            person.until(lambda: run.codes()['robot'] is not None)
            person.until(lambda: not any(person.commands[-1]))  # and nobody sends another one
        assert run.codes()['robot'] == 0
