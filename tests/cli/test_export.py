"""`codetr export`: the policy of a run's newest checkpoint becomes a file, or is refused."""

import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from codetr_ros import cli
from codetr_ros.cli import export
from codetr_ros.learners import registry
from codetr_ros.policy.acting import ActingPolicy
from codetr_ros.robots import policy_file, robot_facts
from codetr_ros.runs import checkpoints
from codetr_ros.runs import folder as run_folder
from helpers import policies
from helpers.builders import tiny
from helpers.robots import MAPPING

SETTINGS = tiny(
    task='robot/arm', pace='free', scorer='topic', evaluate_every=0, method='evidence', delay=5
)


@pytest.fixture
def run(tmp_path: Path) -> Path:
    """The folder of a run on a robot, with a checkpoint after its warm-up."""
    folder = tmp_path / 'run'
    folder.mkdir()
    run_folder.write_settings(folder, SETTINGS)
    robot_facts.write(folder, 'robot', policies.facts())
    save(folder, SETTINGS.warmup_phases)
    return folder


def save(folder: Path, phase: int) -> None:
    learner = registry.make(SETTINGS.changed({'seed': phase}), 4, 2)
    meta = {'run_id': 'r1', 'observation_size': 4, 'action_size': 2}
    checkpoints.save(folder / 'checkpoints', 'learner', phase, learner.state(), meta)


def mapping(tmp_path: Path, **live) -> str:
    path = tmp_path / 'mapping.yaml'
    made = MAPPING | {'live': MAPPING['live'] | live}
    made['action'] = made['action'] | {'low': [-1.5, -2.0], 'high': [1.5, 2.0]}
    path.write_text(yaml.safe_dump(made))
    return str(path)


def test_the_newest_policy_becomes_a_file_beside_the_checkpoints(run, capsys):
    save(run, SETTINGS.warmup_phases + 1)
    assert cli.main(['export', str(run)]) == 0
    out = capsys.readouterr().out
    path = run / 'policy.safetensors'
    assert f'-p checkpoint:={path}' in out
    assert 'position, velocity of /joint_states (sensor_msgs/msg/JointState), joints a, b' in out
    assert '10 times a second' in out
    for named in (path, run, checkpoints.latest(run / 'checkpoints', 'learner')):
        file = policy_file.load(policy_file.find(named))
        assert (file.described.run_id, file.described.settings_hash) == ('r1', SETTINGS.hash())
    learner = registry.make(SETTINGS.changed({'seed': SETTINGS.warmup_phases + 1}), 4, 2)
    seen = np.array([0.1, -0.2, 0.3, 1.0], np.float32)
    acted = ActingPolicy(learner.actor).act(seen)
    np.testing.assert_allclose(file.policy.act(seen, 0), acted, rtol=0, atol=1e-6)


def test_it_is_written_where_one_wants_it_and_replaces_what_is_there(run, tmp_path):
    out = tmp_path / 'new' / 'p.safetensors'
    for _ in range(2):
        assert cli.main(['export', str(run), '--out', str(out)]) == 0
    assert policy_file.load(out).test() <= 1e-6
    assert not (run / 'policy.safetensors').exists()


def test_a_mapping_stands_in_for_a_robot_node_that_had_another_folder(run, tmp_path, capsys):
    (run / 'robots' / 'robot.json').unlink()
    (run / 'robots').rmdir()
    assert cli.main(['export', str(run)]) == 2
    assert 'Give the mapping of the robot with --mapping FILE' in capsys.readouterr().err
    assert cli.main(['export', str(run), '--mapping', mapping(tmp_path)]) == 0
    assert policy_file.load(run / 'policy.safetensors').described.robot.types == {}


def test_a_mapping_that_is_not_the_one_of_the_run_is_refused(run, tmp_path, capsys):
    assert cli.main(['export', str(run), '--mapping', mapping(tmp_path, rate=20.0)]) == 2
    assert 'live.rate = 20.0, not 10.0' in capsys.readouterr().err
    watched = mapping(tmp_path, stop={'topic': '/stop'})
    assert cli.main(['export', str(run), '--mapping', watched]) == 0
    live = policy_file.load(run / 'policy.safetensors').described.robot.mapping.live
    assert live.stop.topic == '/stop'


def test_of_several_robots_one_is_named(run, capsys):
    robot_facts.write(run, 'other', policies.facts())
    assert cli.main(['export', str(run)]) == 2
    assert 'has 2 robots: give --robot and one of other, robot' in capsys.readouterr().err
    assert cli.main(['export', str(run), '--robot', 'third']) == 2
    assert "no robot 'third'" in capsys.readouterr().err
    assert cli.main(['export', str(run), '--robot', 'other']) == 0


def test_a_run_that_has_learnt_nothing_yet_is_refused(run, tmp_path, capsys):
    for path in (run / 'checkpoints').iterdir():
        path.rename(tmp_path / path.name)
    assert cli.main(['export', str(run)]) == 2
    assert 'holds no checkpoint of the learner' in capsys.readouterr().err
    assert cli.main(['export', str(tmp_path)]) == 2
    assert 'is not the folder of a run' in capsys.readouterr().err
    assert cli.main(['export', str(run), '--out', str(tmp_path)]) == 2
    assert 'is a folder: name a file' in capsys.readouterr().err


def test_a_run_on_a_robot_is_exported_and_not_evaluated(run, capsys):
    assert cli.main(['evaluate', str(run)]) == 2
    assert f'`codetr export {run}` writes its policy into a file' in capsys.readouterr().err


def test_after_a_run_the_command_that_acts_by_its_policy_is_named(run):
    assert f'{sys.executable} -m learner_node.act' in export.after_a_run(run) or (
        'ros2 run learner_node act' in export.after_a_run(run)
    )
    (run / 'robots' / 'robot.json').unlink()
    assert 'the policy was not exported: ' in export.after_a_run(run)
