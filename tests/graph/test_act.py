"""A trained policy on a robot in real processes and real time: no run, no learner, no torch."""

import signal

import numpy as np
import pytest

from helpers import nodes
from helpers.act_runs import ActRun
from helpers.robot_runs import COMMANDS, Person

pytestmark = pytest.mark.slow


@pytest.fixture(scope='module', autouse=True)
def _domain():
    with nodes.domain():
        yield


def test_it_drives_the_arm_at_its_rate_within_its_limits_and_obeys_silence_and_people(tmp_path):
    live = {'limits': {'low': -0.8, 'high': 0.8, 'change': 4.0}, 'reset': {'by': 'nobody'}}
    with ActRun(tmp_path / 'run', **live, episode_steps=10_000) as run, Person(run) as person:
        run.begin()
        run.act('robot', run.policy())
        person.until(lambda: 'is not moved before' in run.log('robot'))
        person.until(person.sees_commands)
        person.link.handle(0.2)
        assert person.commands == []
        person.activate()
        person.until(lambda: person.took(40, 1.8, 4.0))  # two seconds at 20 Hz
        person.until(person.moves)
        assert 'libtorch' not in run.mapped('robot')
        commands = np.array(person.commands)
        assert (np.abs(commands) <= 0.8).all()
        # it stops at once, where this machine keeps the arm or the node waiting
        changes = np.diff(commands, axis=0)[commands[1:].any(axis=1)]
        assert (np.abs(changes) <= 4.0 / 20 + 1e-9).all()

        run.end('arm', signal.SIGSTOP)
        person.until(person.rests)
        person.until(lambda: '/joint_states is' in run.log('robot'))
        run.end('arm', signal.SIGCONT)
        person.until(person.moves)  # it goes on by itself

        assert person.call('stop').success
        person.until(person.rests)
        assert person.call('resume').success
        person.until(person.moves)
        assert person.change('deactivate')
        person.until(lambda: not any(person.commands[-1]))
        person.activate()
        person.until(person.moves)

        run.end('robot', signal.SIGTERM)
        person.until(lambda: run.codes()['robot'] is not None)
        person.until(lambda: not any(person.commands[-1]))
        assert run.codes()['robot'] == 0
        assert 'commands changed by limit change' in run.log('robot')
        assert 'control deadlines missed' in run.log('robot')
        assert 'control steps were late by' in run.log('robot')


def test_it_refuses_another_robot_before_any_command_leaves(tmp_path):
    with ActRun(tmp_path / 'run') as run, Person(run) as person:
        run.begin()
        rules = run.rules
        (seen,) = rules.observation
        wrist = seen.model_copy(update={'joints': ('shoulder', 'wrist')})
        assert rules.live is not None
        slow = rules.live.model_copy(update={'rate': 10.0})
        floats = rules.live.command.model_copy(update={'type': 'std_msgs/msg/Float32MultiArray'})
        other = rules.live.model_copy(update={'command': floats})
        mapping = f'mapping:={run.folder / "mapping.yaml"}'
        run.act('rate', run.policy(rules.model_copy(update={'live': slow})), mapping)
        run.act('types', run.policy(joint_states='std_msgs/msg/String'), 'autostart:=true')
        lost = rules.model_copy(update={'observation': (wrist,)})
        run.act('joints', run.policy(lost), 'autostart:=true')
        takes = rules.model_copy(update={'live': other})
        run.act('command', run.policy(takes), 'autostart:=true')
        run.act('nobody', run.policy(), 'checkpoint:=/nowhere')
        codes = run.wait('rate', 'types', 'joints', 'command', 'nobody')
        del codes['arm']
        assert set(codes.values()) == {1}
        assert 'live.rate = 20.0, not 10.0' in run.log('rate')
        assert '/joint_states is of type sensor_msgs/msg/JointState here, and was std' in run.log(
            'types'
        )
        assert (
            '/joint_states names the joints elbow, gripper, shoulder, and the mapping wants '
            'position, velocity of shoulder, wrist' in run.log('joints')
        )
        assert f'{COMMANDS} is of type std_msgs/msg/Float64MultiArray here' in run.log('command')
        assert 'policy file /nowhere cannot be read' in run.log('nobody')
        person.link.handle(0.2)
        assert person.commands == []
