"""The launch file of a trained policy on a robot: what its node is given, and how it ends."""

import sys

import pytest

pytest.importorskip('launch_ros', reason='needs launch_ros')

from launch import LaunchContext, LaunchDescription, LaunchService
from launch.actions import ExecuteProcess, OpaqueFunction
from launch_ros.actions import Node

from codetr_ros.ros.own_parameters import own_parameters
from helpers.launching import launch_file, parameters


@pytest.fixture
def module():
    """The launch file."""
    return launch_file('act.launch.py')


@pytest.fixture
def context(module):
    """A launch with the arguments as they are unless they are given."""
    made = LaunchContext()
    for argument in module.generate_launch_description().get_launch_arguments():
        default = ''.join(part.text for part in argument.default_value)
        made.launch_configurations[argument.name] = default
    return made


def node_of(module, context):
    """The node that the launch starts."""
    (node,) = [made for made in module.nodes(context) if isinstance(made, Node)]
    return node


def test_each_parameter_of_the_node_is_an_argument_and_has_the_default_of_the_node(
    module, context
):
    context.launch_configurations['checkpoint'] = '2026'  # a folder may have such a name
    node = node_of(module, context)
    assert (node.node_package, node.node_executable) == ('learner_node', 'act')
    own = {name: each.default for name, each in own_parameters('act').items()}
    assert parameters(node, context) == own | {'checkpoint': '2026', 'use_sim_time': False}


def test_what_is_given_reaches_the_node_with_its_type(module, context):
    given = {'checkpoint': 'policy.safetensors', 'mapping': 'live.yaml'}
    context.launch_configurations.update(given | {'autostart': 'true', 'peer_deadline': '5.0'})
    reached = parameters(node_of(module, context), context)
    assert given.items() <= reached.items()
    assert reached['autostart'] is True
    assert reached['peer_deadline'] == 5.0


def test_without_a_policy_file_nothing_is_started(module, context):
    with pytest.raises(RuntimeError, match='checkpoint:=FILE is missing'):
        module.nodes(context)


@pytest.mark.parametrize(
    ('program', 'code'),
    [('raise SystemExit(0)', 0), ('raise SystemExit(1)', 1), ('import os; os.abort()', 1)],
    ids=['ends well', 'refuses the robot', 'crashes'],
)
def test_the_launch_ends_with_the_node_and_fails_with_it(module, context, program, code):
    starts = []

    def process(context):
        """The launch, with a small program in place of the node."""
        module.Node = lambda **given: ExecuteProcess(
            cmd=[sys.executable, '-c', program], name=given['executable']
        )
        context.launch_configurations['checkpoint'] = 'policy.safetensors'
        for name, (default, _) in module.ARGUMENTS.items():
            context.launch_configurations.setdefault(name, default)
        made = module.nodes(context)
        starts.append(made[-1])
        return made

    service = LaunchService(noninteractive=True)
    service.include_launch_description(LaunchDescription([OpaqueFunction(function=process)]))
    assert service.run() == code
    assert len(starts) == 1
