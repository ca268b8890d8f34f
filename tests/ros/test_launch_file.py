"""The launch file: which nodes it starts, and what it gives them."""

import sys
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path

import pytest

pytest.importorskip('launch_ros', reason='needs launch_ros')

from launch import LaunchContext, LaunchDescription, LaunchService
from launch.actions import EmitEvent, ExecuteProcess, RegisterEventHandler
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
from launch_ros.actions import Node

FILE = Path(__file__).resolve().parents[2] / 'codetr_ros' / 'launch' / 'train.launch.py'


@pytest.fixture
def module():
    """The launch file."""
    spec = spec_from_file_location('train_launch', FILE)
    made = module_from_spec(spec)
    spec.loader.exec_module(made)
    return made


@pytest.fixture
def started(module, tmp_path):
    """Package and executable of each node that the launch file starts under some settings."""

    def start(*lines):
        config = tmp_path / 'config.yaml'
        config.write_text('\n'.join(lines) + '\n')
        context = LaunchContext()
        for name, (default, _) in module.ARGUMENTS.items():
            context.launch_configurations[name] = default
        context.launch_configurations['config'] = str(config)
        nodes = [made for made in module.nodes(context) if isinstance(made, Node)]
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


def test_nodes_that_a_run_does_not_need_are_not_started(started):
    names = [executable for _, executable in started('method: hc', 'evaluate_every: 0')]
    assert sorted(names) == ['learner', 'record', 'sim']


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
