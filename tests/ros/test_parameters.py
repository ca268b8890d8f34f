import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from codetr_ros.config import Settings, load
from codetr_ros.ros import given, parameters


@pytest.fixture
def make_node():
    context = Context()
    rclpy.init(context=context)
    nodes = []

    def make(**given):
        overrides = [
            Parameter(name.replace('__', '.'), value=value) for name, value in given.items()
        ]
        nodes.append(
            Node(
                'n',
                namespace='/r',
                context=context,
                parameter_overrides=overrides,
                use_global_arguments=False,
            )
        )
        return nodes[-1]

    yield make
    for node in nodes:
        node.destroy_node()
    context.try_shutdown()


def test_every_setting_is_a_described_read_only_parameter_with_its_value(make_node):
    node, settings = make_node(), load('paper')
    parameters.declare_settings(node, settings)
    for name, value in settings.flat().items():
        shown = node.describe_parameter(name)
        assert shown.description
        assert shown.read_only
        stored = node.get_parameter(name).value
        if value is not None:
            assert (tuple(stored) if isinstance(value, tuple) else stored) == value
    refused = node.set_parameters([Parameter('delay', value=7)])[0]
    assert not refused.successful
    assert 'read-only' in refused.reason


def test_ranges_and_choices_come_from_the_configuration():
    delay = parameters.descriptor('delay').integer_range[0]
    assert (delay.from_value, delay.to_value) == (1, 100_000)
    discount = parameters.descriptor('sac.discount').floating_point_range[0]
    assert (discount.from_value, discount.to_value) == (0.0, 1.0)
    assert parameters.descriptor('composite').additional_constraints.startswith('one of: sum, ')
    assert 'greater than 0' in parameters.descriptor('sac.tau').additional_constraints
    assert '0: not given' in parameters.descriptor('r_max').additional_constraints


@pytest.mark.parametrize('delay', ['10:50', 'episode'])
def test_a_delay_that_is_no_number_is_a_parameter_of_text(make_node, delay):
    settings = parameters.own_settings(make_node(delay=delay), 'quick')
    assert settings.delay == delay
    node = make_node()
    parameters.declare_settings(node, settings)
    assert node.get_parameter('delay').value == delay
    parameters.check_against_run(make_node(delay=delay), settings, 'learner /r/learner')
    with pytest.raises(parameters.ParameterError, match=f'/r/learner has delay = {delay!r}'):
        parameters.check_against_run(make_node(delay=25), settings, 'learner /r/learner')


def test_threads_that_a_node_leaves_to_the_machine_contradict_no_run(make_node):
    settings = parameters.own_settings(make_node(threads='auto'), 'quick')
    assert settings.threads == 'auto'
    run = settings.changed({'threads': 2})
    parameters.check_against_run(make_node(threads='auto'), run, 'learner /r/learner')
    parameters.check_against_run(make_node(threads=2), run, 'learner /r/learner')
    with pytest.raises(parameters.ParameterError, match='/r/learner has threads = 2'):
        parameters.check_against_run(make_node(threads=1), run, 'learner /r/learner')
    node = make_node()
    parameters.declare_settings(node, run)
    assert node.get_parameter('threads').value == 2
    (threads,) = parameters.descriptor('threads', 2).integer_range
    assert (threads.from_value, threads.to_value) == (1, 256)


def test_an_unknown_parameter_is_refused_with_its_name_and_value(make_node):
    with pytest.raises(
        parameters.ParameterError,
        match=r'/r/n has no parameter dealy=7 \(did you mean delay\?\). There are: .*delay',
    ):
        given.check_names(make_node(dealy=7), 'learner', ['--ros-args', '-p', 'dealy:=7'])


def test_a_parameter_of_another_role_is_unknown(make_node):
    arguments = ['-p', 'n:bag:=x', '-p', 'use_sim_time:=true']
    with pytest.raises(parameters.ParameterError, match="no parameter bag='x'"):
        given.check_names(make_node(bag='x'), 'sim', arguments)
    given.check_names(make_node(bag='x', use_sim_time=True), 'record', arguments)


FILE = """
/**:
  ros__parameters: {camera: {rate: 30}, bag: /tmp/bag, delay: 7, config: quick}
/r/n:
  ros__parameters: {sac: {tua: 0.1}}
"/*/m":
  ros__parameters: {other: 1}
r:
  n: {ros__parameters: {inner: 1}}
"""


def test_a_parameter_file_for_all_nodes_may_hold_what_others_need(make_node, tmp_path):
    file = tmp_path / 'all.yaml'
    file.write_text(FILE)
    arguments = ['--ros-args', '--params-file', str(file)]
    assert given.addressed(arguments, 'n') == {'sac.tua', 'inner'}
    shared = {'camera__rate': 30, 'bag': '/tmp/bag', 'delay': 7, 'config': 'quick'}
    for role in ('sim', 'learner', 'record'):
        given.check_names(make_node(**shared), role, arguments)
    with pytest.raises(
        parameters.ParameterError, match=r'no parameter sac.tua=0.1 \(did you mean sac.tau\?\)'
    ):
        given.check_names(make_node(sac__tua=0.1, **shared), 'learner', arguments)


def test_the_learner_makes_its_settings_from_config_and_parameters(make_node):
    node = make_node(delay=7, sac__hidden=[8, 9], sac__discount=1, r_max=0.0)
    settings = parameters.own_settings(node, 'quick')
    assert settings == load('quick').changed(
        {'delay': 7, 'sac.hidden': (8, 9), 'sac.discount': 1.0}
    )


def test_a_setting_out_of_range_is_refused_by_name_and_value(make_node):
    with pytest.raises(parameters.ParameterError, match='/r/n: parameter: delay = 0'):
        parameters.own_settings(make_node(delay=0), 'quick')


def test_a_parameter_that_contradicts_the_run_is_refused_naming_both_values_and_nodes(make_node):
    settings = Settings(delay=25)
    parameters.check_against_run(
        make_node(delay=25, sac__tau=0.005), settings, 'learner /r/learner'
    )
    with pytest.raises(parameters.ParameterError) as refused:
        parameters.check_against_run(make_node(delay=50, seed=3), settings, 'learner /r/learner')
    assert '/r/n' in str(refused.value)
    assert 'delay = 50, but learner /r/learner has delay = 25' in str(refused.value)
    assert 'seed = 3, but learner /r/learner has seed = 0' in str(refused.value)


def test_own_parameters_have_types_and_ranges(make_node):
    values = parameters.declare_own(make_node(run_id=5, peer_deadline=3), 'record')
    assert values == {
        'run_id': '5',
        'folder': '',
        'peer_deadline': 3.0,
        'bag': '',
        'leave_out_after': 30.0,
        'bag_split_mb': 1000.0,
        'bag_keep_free_mb': 64.0,
    }
    with pytest.raises(
        parameters.ParameterError, match='peer_deadline = -1 must be a number from 0'
    ):
        parameters.declare_own(make_node(peer_deadline=-1), 'sim')
