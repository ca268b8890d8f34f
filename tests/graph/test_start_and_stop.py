"""Nodes start in any order and stop when they are asked to, saving what they have."""

import os
import signal
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from rcl_interfaces.msg import ParameterType
from rosbags.highlevel import AnyReader

from codetr_ros.config import Settings, settled
from codetr_ros.processes import launcher
from codetr_ros.records import TOPICS, TrueRewards
from codetr_ros.records.roles import command, readers
from codetr_ros.runs import checkpoints
from codetr_ros.runs import folder as run_folder
from helpers.builders import tiny
from helpers.nodes import NAMESPACE, Nodes, Witness, domain
from helpers.runs import finish, logs, processes_of, start_installed, until, write

ENDLESS = 10_000_000  # steps
STOPS = (pytest.param(signal.SIGINT, marks=pytest.mark.slow), signal.SIGTERM)


def committed_phases(folder: Path) -> list[int]:
    """Phases that the bag of a run says are committed; the bag is whole and has its index."""
    bag = folder / run_folder.BAG
    assert (bag / 'metadata.yaml').is_file()
    with AnyReader([bag]) as reader:
        commits = [c for c in reader.connections if c.topic.endswith('/commits')]
        return [
            reader.deserialize(raw, connection.msgtype).phase
            for connection, _, raw in reader.messages(commits)
        ]


def check_saved(folder: Path) -> None:
    """Both learning nodes have a whole checkpoint of one of the last phases in the bag."""
    phases = committed_phases(folder)
    assert phases == list(range(len(phases)))
    for name in ('learner', 'reward'):
        newest = checkpoints.latest(folder / run_folder.CHECKPOINTS, name)
        assert newest is not None, name
        tensors, meta = checkpoints.load(newest)
        assert tensors
        assert len(phases) - 2 <= meta['phase'] <= len(phases) - 1, (name, len(phases))


# ---- starting


@pytest.mark.slow
def test_nodes_start_in_any_order_and_finish(tmp_path):
    settings = tiny()
    with (
        domain(),
        Nodes(settings, tmp_path / 'run', launcher.start_program) as nodes,
        Witness(nodes) as witness,
    ):
        for name in ('record', 'evaluate', 'sim', 'reward'):
            nodes.start(name)
            witness.until(lambda name=name: name in witness.presence)
            assert not witness.presence[name].run_id
        nodes.start('learner')
        codes = nodes.wait()
    assert codes == dict.fromkeys(nodes.names, 0), logs(tmp_path / 'run')
    assert committed_phases(tmp_path / 'run') == list(range(settings.phases))
    assert nodes.report('record')['lost'] == {}
    for name in nodes.names:
        assert nodes.report(name)['finished']


@pytest.mark.slow
def test_missing_nodes_are_named_with_what_starts_them_and_not_waited_for_in_silence(tmp_path):
    with domain(), Nodes(tiny(), tmp_path / 'run') as nodes:
        nodes.start('learner', 'peer_deadline:=1.0')
        codes = nodes.wait()
    said = nodes.log('learner')
    assert codes == {'learner': 1}
    assert f'{NAMESPACE}/learner gave up after 1 s: it waits for ' in said
    for role in ('sim', 'evaluate', 'reward', 'record'):
        assert f'{role} (start it with `{command(role)}` in this namespace)' in said
    assert 'A larger parameter peer_deadline (of `codetr train`: --peer-deadline)' in said
    assert 'Traceback' not in said
    assert nodes.report('learner')['error'] in said


def test_a_parameter_that_contradicts_the_run_is_refused_naming_both_values(tmp_path):
    with domain(), Nodes(tiny(delay=7), tmp_path / 'run') as nodes:
        nodes.start('learner')
        nodes.start('sim', 'delay:=9')
        nodes.wait('sim')
        nodes.send(signal.SIGTERM, 'learner')
        codes = nodes.wait()
    assert codes == {'learner': 0, 'sim': 1}
    said = nodes.log('sim')
    assert (
        f'{NAMESPACE}/sim: parameters contradict the run: delay = 9, but learner '
        f'{NAMESPACE}/learner has delay = 7. Leave them out'
    ) in said
    assert 'Traceback' not in said


# ---- in the middle


@dataclass
class Stopped:
    """A run that was stopped in the middle by a signal to every node, and what a witness saw."""

    number: signal.Signals
    nodes: Nodes
    seen: int  # commits before the signal
    codes: dict[str, int | None] = field(default_factory=dict)
    readers: dict[str, set[str]] = field(default_factory=dict)
    counters: dict[str, dict[str, str]] = field(default_factory=dict)
    parameters: dict[str, dict[str, Any]] = field(default_factory=dict)


COUNTED = {
    'learner': 'received transitions',
    'reward': 'received commits',
    'record': 'received composite_rewards',
    'sim': 'published transitions',
    'evaluate': 'received policy',
}


def due_readers(settings: Settings) -> dict[str, set[str]]:
    """The roles of this run that read each topic: nobody who scores is among them."""
    assert set(settings.roles) == set(COUNTED)
    return {topic: set(roles) & set(settings.roles) for topic, roles in readers().items()}


@pytest.fixture(scope='module', params=STOPS, ids=lambda number: number.name)
def stopped(request, tmp_path_factory):
    """Five nodes, looked at in the middle of their run and then asked to stop, all at once."""
    folder = tmp_path_factory.mktemp('stopped') / 'run'
    settings = tiny(steps=ENDLESS, memory_steps=10_000)
    with domain(), Nodes(settings, folder) as nodes, Witness(nodes) as witness:
        nodes.start_before(witness)
        witness.until(lambda: witness.committed(3))
        made = Stopped(request.param, nodes, 0)
        witness.until(  # discovery: the run may be in phase 3 before a visitor knows all of it
            lambda: all(witness.readers(t) >= roles for t, roles in due_readers(settings).items())
        )
        made.readers = {topic: witness.readers(topic) for topic in TOPICS.values()}
        made.parameters = {name: witness.parameters(name) for name in nodes.names}
        witness.until(lambda: all(counted(witness, name) >= 4 for name in nodes.names))
        made.counters = dict(witness.counters)
        made.seen = len(witness.commits)
        nodes.send(request.param)
        made.codes = nodes.wait()
        yield made


def counted(witness: Witness, name: str) -> int:
    """What a node says on /diagnostics of a topic that lives as long as the run."""
    return int(witness.counters.get(name, {}).get(COUNTED[name], 0))


def test_a_signal_ends_every_node_with_exit_code_0_and_no_traceback(stopped):
    assert stopped.codes == dict.fromkeys(stopped.nodes.names, 0)
    for name in stopped.nodes.names:
        said = stopped.nodes.log(name)
        assert f'stopped by {stopped.number.name}' in said
        assert 'Traceback' not in said
        assert 'FATAL' not in said
        report = stopped.nodes.report(name)
        assert report['finished'] is False and report['error'] is None


def test_a_signal_leaves_a_checkpoint_and_a_closed_bag(stopped):
    check_saved(stopped.nodes.folder)
    assert len(committed_phases(stopped.nodes.folder)) >= stopped.seen >= 4


def test_only_the_recorder_hears_the_true_rewards(stopped):
    assert stopped.readers[TOPICS[TrueRewards]] == {'record'}
    for topic, roles in due_readers(stopped.nodes.settings).items():
        assert stopped.readers[topic] - {'witness'} >= roles, topic


def test_every_parameter_is_listed_and_described_at_every_node(stopped):
    settings = settled(stopped.nodes.settings).flat()
    for name in stopped.nodes.names:
        shown = stopped.parameters[name]
        assert set(settings) < set(shown)
        for parameter, (value, descriptor) in shown.items():
            if parameter.startswith(('qos_overrides.', 'use_sim_time', 'start_type_')):
                continue  # the middleware's own
            assert descriptor.description, f'{name} {parameter}'
            assert descriptor.type != ParameterType.PARAMETER_NOT_SET
            assert descriptor.read_only
            if settings.get(parameter) is not None:
                due = settings[parameter]
                assert value == (list(due) if isinstance(due, tuple) else due), parameter


def test_diagnostics_count_what_was_published_and_received(stopped):
    assert set(stopped.counters) >= set(stopped.nodes.names)
    for name, topic in COUNTED.items():
        counters = {key: int(value) for key, value in stopped.counters[name].items()}
        assert counters[topic] >= 4, name
        assert counters['published presence'] >= 1
        assert not any(
            value
            for key, value in counters.items()
            if key.startswith(('lost', 'duplicated', 'refused'))
        )


# ---- the command


@pytest.fixture(scope='module', params=STOPS, ids=lambda number: number.name)
def interrupted(request, tmp_path_factory):
    """`codetr train`, interrupted once both nodes have saved a checkpoint."""
    folder = tmp_path_factory.mktemp('interrupted') / 'run'
    with domain():
        config = write(tiny(steps=ENDLESS, memory_steps=10_000), folder)
        command = start_installed(config, folder)
        try:
            until(lambda: saved_by_both(folder), command, folder)
            command.send_signal(request.param)
            summary, said = finish(command, folder, code=130)
        finally:
            command.kill()
        yield folder, summary, said


def saved_by_both(folder: Path) -> bool:
    """Whether both learning nodes have saved a checkpoint."""
    where = folder / run_folder.CHECKPOINTS
    return all(checkpoints.latest(where, name) for name in ('learner', 'reward'))


@pytest.mark.slow
def test_ctrl_c_ends_the_whole_run_and_keeps_what_was_done(interrupted):
    folder, summary, said = interrupted
    assert summary['interrupted'] and summary['failure'] is None
    assert 'Traceback' not in said + logs(folder)
    assert 'interrupted: what was done is kept' in said
    codes = {
        name: node['exit_code']
        for name, node in summary['processes'].items()
        if name != 'codetr'  # the command itself
    }
    assert len(codes) == 5 and set(codes.values()) == {0}, codes
    check_saved(folder)


@pytest.mark.slow
def test_ctrl_c_leaves_no_process_behind(interrupted):
    folder, _, _ = interrupted
    assert processes_of(folder) == []


@pytest.mark.slow
def test_a_killed_node_that_is_not_started_again_ends_the_run_which_names_it(tmp_path):
    folder = tmp_path / 'run'
    config = write(tiny(steps=ENDLESS, memory_steps=10_000), folder)
    command = start_installed(config, folder, '--restarts', '0')
    try:
        until(lambda: saved_by_both(folder), command, folder)
        for number, words in processes_of(folder):
            if 'lib/sim_node/sim' in words:
                os.kill(number, signal.SIGKILL)
        summary, said = finish(command, folder, code=1)
    finally:
        command.kill()
    assert summary['failure'] == 'sim was ended by SIGKILL'
    assert 'codetr: the run failed: sim was ended by SIGKILL' in said
    assert 'Traceback' not in said
    check_saved(folder)
    assert processes_of(folder) == []
