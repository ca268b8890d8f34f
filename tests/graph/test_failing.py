"""A run that fails is seen by whoever has started its nodes: by their exit codes and logs."""

import json
import signal
import subprocess
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from codetr_ros import cli
from codetr_ros.runs import folder as run_folder
from helpers.builders import tiny
from helpers.disks import small_disk
from helpers.nodes import NAMESPACE, Nodes, Witness, domain

ENDLESS = tiny(steps=10_000_000, memory_steps=10_000, evaluate_every=0)


@pytest.fixture(scope='module')
def deserted(tmp_path_factory):
    """Nodes whose simulator was killed in the middle, and which then were asked to end, as `ros2
    launch` does.
    """
    folder = tmp_path_factory.mktemp('deserted') / 'run'
    with domain(), Nodes(ENDLESS, folder) as nodes, Witness(nodes) as witness:
        for name in nodes.names:
            nodes.start(name)
        # lines come once a second at the most: one of an update may be later than its phase
        witness.until(lambda: witness.committed(3) and ': critic_loss ' in nodes.log('learner'))
        # held, or they would give up by themselves, if it took long until they are asked
        nodes.send(signal.SIGSTOP, 'reward', 'record', 'learner')
        nodes.send(signal.SIGKILL, 'sim')
        nodes.wait('sim')
        nodes.send(signal.SIGINT)
        nodes.send(signal.SIGCONT)
        nodes.wait()
    return nodes


def test_nodes_that_are_stopped_after_one_has_died_do_not_end_as_if_all_were_well(deserted):
    assert deserted.codes() == {'sim': -9, 'reward': 1, 'record': 1, 'learner': 1}
    for name in ('reward', 'record', 'learner'):
        why = f'stopped by SIGINT before the run was over: sim {NAMESPACE}/sim has died'
        assert deserted.report(name)['error'] == why
        assert why in deserted.log(name)
        assert 'Traceback' not in deserted.log(name)


def test_their_run_has_a_report_that_says_so(deserted, capsys):
    assert cli.main(['report', str(deserted.folder)]) == 0
    summary = json.loads((deserted.folder / run_folder.SUMMARY).read_text())
    assert summary['steps'] >= 4 * ENDLESS.phase_steps
    assert 'learner: stopped by SIGINT before the run was over' in summary['failure']
    assert summary['failure'] in capsys.readouterr().out


def test_each_node_logs_how_far_it_has_come(deserted):
    for name in ('sim', 'reward', 'record', 'learner'):
        assert f'phase 1 of {ENDLESS.phases} is done, ' in deserted.log(name)
    assert ': critic_loss ' in deserted.log('learner')


def test_a_node_that_has_given_up_is_one_that_has_failed(tmp_path):
    """The learner's disk is no disk any more, and it says why; the others are then stopped."""
    folder = tmp_path / 'run'
    with domain(), Nodes(ENDLESS, folder) as nodes, Witness(nodes) as witness:
        for name in nodes.names:
            nodes.start(name)
        witness.until(lambda: witness.committed(2))
        checkpoints = folder / run_folder.CHECKPOINTS
        checkpoints.rename(tmp_path / 'away')
        checkpoints.touch()
        nodes.wait('learner')
        gave_up = f'learner {NAMESPACE}/learner has given up'
        witness.until(lambda: all(gave_up in nodes.log(name) for name in ('sim', 'record')))
        nodes.send(signal.SIGINT)
        codes = nodes.wait()
    assert codes['learner'] == codes['sim'] == codes['record'] == 1, codes
    assert 'Traceback' not in nodes.log('learner')
    for name in ('sim', 'record'):  # they have ended because of it, and name what it met
        assert str(checkpoints) in nodes.report(name)['error']


def test_a_folder_that_cannot_be_written_is_refused_at_once_and_in_one_line(tmp_path):
    with domain(), small_disk(tmp_path / 'disk', 1) as disk:
        nodes = Nodes(ENDLESS, tmp_path / 'run')
        subprocess.run(['mount', '-o', 'remount,ro', str(disk)], check=True)
        with nodes:
            for name in nodes.names:
                nodes.start(name, f'folder:={disk / "run"}')
            codes = nodes.wait()
    assert codes == dict.fromkeys(nodes.names, 1)
    for name in nodes.names:
        (line,) = [line for line in nodes.log(name).splitlines() if 'FATAL' in line]
        assert f"{NAMESPACE}/{name}: parameter folder = '{disk / 'run'}': {disk} cannot" in line
        assert 'Read-only file system. Mount the disk so that it can be written' in line
        assert 'Traceback' not in nodes.log(name)


def test_a_parameter_file_for_all_nodes_of_a_system_does_for_ours(tmp_path: Path):
    file = tmp_path / 'system.yaml'
    file.write_text(
        '/**:\n  ros__parameters: {camera_rate: 30, bag_split_mb: 9.0, frozen: false}\n'
        '/camera:\n  ros__parameters: {exposure: 3}\n'
    )
    with domain(), Nodes(ENDLESS, tmp_path / 'run') as nodes, Witness(nodes) as witness:
        for name in nodes.names:
            nodes.start(name, file=file)
        witness.until(lambda: witness.committed(0))
        nodes.send(signal.SIGTERM)
        codes = nodes.wait()
    assert codes == dict.fromkeys(nodes.names, 0), ''.join(map(nodes.log, nodes.names))
    for name in nodes.names:
        assert '1 parameters given to all nodes are none of this one' in nodes.log(name)
        assert 'camera_rate' in nodes.log(name)
