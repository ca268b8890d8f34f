"""The launch file: which nodes it starts, and what it gives them."""

import sys

import pytest

pytest.importorskip('launch_ros', reason='needs launch_ros')

from launch import LaunchContext, LaunchDescription, LaunchService
from launch.actions import EmitEvent, ExecuteProcess, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch.utilities import perform_substitutions
from launch_ros.actions import Node

from codetr_ros.config import USUAL, SettingsError
from codetr_ros.nodes.signing import VARIABLE, key_of
from helpers.launching import launch_file, parameters


@pytest.fixture
def module():
    """The launch file."""
    return launch_file('train.launch.py')


@pytest.fixture
def context(module, tmp_path):
    """Makes the context of a launch: settings in lines, and arguments by name."""

    def make(*lines, **given):
        config = tmp_path / 'config.yaml'
        config.write_text('\n'.join(lines or ['seed: 0']) + '\n')
        made = LaunchContext()
        for argument in module.generate_launch_description().get_launch_arguments():
            default = ''.join(part.text for part in argument.default_value)
            made.launch_configurations[argument.name] = default
        made.launch_configurations.update({'config': str(config)} | given)
        return made

    return make


@pytest.fixture
def started(module, context):
    """Package and executable of each node that the launch file starts under some settings."""
    make = context

    def start(*lines, **given):
        context = make(*lines, **given)
        nodes = [made for made in module.nodes(context) if isinstance(made, Node)]
        if given:
            return {node._Node__node_name: parameters(node, context) for node in nodes}
        return [(node.node_package, node.node_executable) for node in nodes]

    return start


def test_all_nodes_of_a_run_are_started(started):
    assert sorted(started('task: Pendulum-v1')) == [
        ('codetr_ros', 'record'),
        ('learner_node', 'learner'),
        ('reward_node', 'reward'),
        ('sim_node', 'evaluate'),
        ('sim_node', 'sim'),
    ]


@pytest.fixture
def keys(module, context):
    """The key of the run that each node is handed, by its name."""

    def read():
        made = context()
        found = {}
        for node in (each for each in module.nodes(made) if isinstance(each, Node)):
            handed = {
                perform_substitutions(made, name): perform_substitutions(made, value)
                for name, value in node.process_description.additional_env
            }
            found[node._Node__node_name] = key_of(handed)
        return found

    return read


def test_all_nodes_of_a_launch_are_handed_one_key_and_each_launch_makes_its_own(keys, monkeypatch):
    monkeypatch.delenv(VARIABLE, raising=False)
    first, second = keys(), keys()
    assert set(first) == {'sim', 'evaluate', 'record', 'reward', 'learner'}
    assert len(set(first.values())) == len(set(second.values())) == 1
    assert None not in first.values()
    assert first['sim'] != second['sim']


def test_the_key_that_is_there_is_handed_on_so_that_others_can_take_part(keys, monkeypatch):
    monkeypatch.setenv(VARIABLE, '5a' * 32)
    assert set(keys().values()) == {b'\x5a' * 32}


def test_nodes_that_a_run_does_not_need_are_not_started(started):
    names = [executable for _, executable in started('method: hc', 'evaluate_every: 0')]
    assert sorted(names) == ['learner', 'record', 'sim']


def test_each_usual_setting_is_an_argument_that_reaches_the_learner_with_its_type(started):
    given = {'task': 'Hopper-v5', 'delay': '25', 'sac.hidden': '[64, 32]', 'overlap': 'true'}
    nodes = started('method: hc', **given, method='rrd', simulators='2')
    assert set(nodes) == {'sim', 'sim_2', 'record', 'learner', 'reward', 'evaluate'}
    learner = nodes['learner']
    shown = {name: learner[name] for name in (*given, 'method', 'simulators')}
    assert shown == {
        'task': 'Hopper-v5',
        'delay': 25,
        'sac.hidden': (64, 32),
        'overlap': True,
        'method': 'rrd',
        'simulators': 2,
    }
    assert 'seed' not in learner
    assert 'task' not in nodes['sim_2']


def test_there_is_an_argument_for_each_usual_setting(module):
    arguments = {
        one.name: one for one in module.generate_launch_description().get_launch_arguments()
    }
    assert set(arguments) == {*module.ARGUMENTS, *USUAL}
    for name in USUAL:
        assert arguments[name].description.startswith('setting: ')


def test_simulators_that_are_started_by_hand_are_left_out(started):
    nodes = started(start_simulators='false', seed='1')
    assert set(nodes) == {'record', 'learner', 'reward', 'evaluate'}


ROBOT = ('task: robot/arm', 'pace: free', 'scorer: topic', 'evaluate_every: 0')


def test_on_a_robot_its_node_is_started_in_place_of_a_simulator(started):
    nodes = started(*ROBOT, mapping='live.yaml', autostart='true')
    assert set(nodes) == {'robot', 'record', 'learner', 'reward'}
    assert {name: nodes['robot'][name] for name in ('mapping', 'autostart')} == {
        'mapping': 'live.yaml',
        'autostart': True,
    }
    assert 'mapping' not in nodes['learner']
    assert started(*ROBOT, mapping='live.yaml')['robot']['autostart'] is False
    assert set(started(*ROBOT, start_simulators='false')) == {'record', 'learner', 'reward'}


def test_a_robot_without_a_mapping_and_a_mapping_without_a_robot_are_refused(started):
    with pytest.raises(RuntimeError, match=r'robot/arm .* mapping:=FILE'):
        started(*ROBOT)
    with pytest.raises(RuntimeError, match=r'live.yaml .* Pendulum-v1'):
        started('task: Pendulum-v1', mapping='live.yaml')


def test_a_setting_that_is_refused_is_named(started):
    with pytest.raises(SettingsError, match='train.launch.py.*delay.*-3'):
        started(delay='-3')


@pytest.mark.parametrize(
    ('program', 'failure'),
    [
        ('raise SystemExit(0)', None),
        ('raise SystemExit(3)', 'ended with exit code 3'),
        ('import os; os.kill(os.getpid(), 9)', 'was ended by signal 9'),
    ],
    ids=['ends well', 'fails', 'is killed'],
)
def test_a_node_that_fails_ends_the_launch_with_another_exit_code_than_0(module, program, failure):
    node = ExecuteProcess(cmd=[sys.executable, '-c', program], name='sim')
    other = ExecuteProcess(cmd=[sys.executable, '-c', 'import time; time.sleep(600)'])
    ends = OnProcessExit(target_action=node, on_exit=[EmitEvent(event=Shutdown())])
    service = LaunchService(noninteractive=True)
    failed = OnProcessExit(target_action=node, on_exit=module.check)
    service.include_launch_description(
        LaunchDescription([RegisterEventHandler(failed), RegisterEventHandler(ends), node, other])
    )
    assert service.run() == (failure is not None)


COUNTED = """
import os, sys
with open(sys.argv[1], 'a') as file:
    file.write('started\\n')
with open(sys.argv[1]) as file:
    times = len(file.readlines())
"""


@pytest.mark.parametrize(
    ('program', 'most', 'starts', 'fails'),
    [
        ('if times < 3: os.kill(os.getpid(), 9)', 5, 3, False),
        ('os.kill(os.getpid(), 9)', 2, 3, True),
        ('os.kill(os.getpid(), 9)', 0, 1, True),
        ('', 5, 1, False),
        ('sys.exit(3)', 5, 1, True),
    ],
    ids=['is killed twice', 'is killed too often', 'never again', 'ends well', 'gives a reason'],
)
def test_a_node_is_started_again_only_if_it_was_killed(
    module, tmp_path, program, most, starts, fails
):
    file = tmp_path / 'starts'
    made = []

    def make():
        made.append(
            ExecuteProcess(cmd=[sys.executable, '-c', COUNTED + program, str(file)], name='sim')
        )
        return made[-1]

    other = ExecuteProcess(cmd=[sys.executable, '-c', 'import time; time.sleep(600)'])
    over = [EmitEvent(event=Shutdown())]
    node = module.Started('sim', make, module.Restarts(most), 0.01, at_the_end=over)
    service = LaunchService(noninteractive=True)
    service.include_launch_description(LaunchDescription([*node.actions(), other]))
    assert bool(service.run()) == fails
    assert len(file.read_text().splitlines()) == len(made) == starts


def test_an_evaluator_that_fails_does_not_end_the_launch(module):
    failing = ExecuteProcess(cmd=[sys.executable, '-c', 'raise SystemExit(3)'], name='evaluate')
    after = [EmitEvent(event=Shutdown())]
    last = ExecuteProcess(cmd=[sys.executable, '-c', 'import time; time.sleep(1)'], name='record')
    restarts = module.Restarts(0)
    nodes = [
        module.Started('evaluate', lambda: failing, restarts, 0.0, needed=False),
        module.Started('record', lambda: last, restarts, 0.0, at_the_end=after),
    ]
    service = LaunchService(noninteractive=True)
    actions = [action for node in nodes for action in node.actions()]
    service.include_launch_description(LaunchDescription(actions))
    assert service.run() == 0


@pytest.mark.parametrize(
    'given', [{'restarts': '-1'}, {'restarts': '1.5'}, {'restart_delay': 'soon'}]
)
def test_numbers_of_restarts_that_cannot_be_are_refused(started, module, given):
    (name,) = given
    with pytest.raises(RuntimeError, match=name):
        started(**given)
