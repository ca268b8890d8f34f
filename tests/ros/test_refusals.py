"""What a node refuses to begin, or to go on with: it says why and ends with exit code 1."""

import os
import re
import signal
import subprocess
import sys

import pytest
import yaml

from codetr_ros.bags.errors import BagError
from codetr_ros.config import IN_PROCESS_ONLY, SettingsError, load
from codetr_ros.cores.core import Part
from codetr_ros.learners.sac import SacError
from codetr_ros.nodes import errors
from codetr_ros.policy.network import NetworkError
from codetr_ros.processes import middleware
from codetr_ros.records import RecordError
from codetr_ros.rewards.base import RewardModelError
from codetr_ros.ros.joining import Joined
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.node import Node
from codetr_ros.ros.signals import Stop
from codetr_ros.ros.wiring import Wiring
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.checkpoints import CheckpointError
from codetr_ros.runs.reports import CoreReport
from codetr_ros.simulation.composite import CompositeError
from codetr_ros.simulation.tasks import TaskError
from helpers.builders import tiny
from helpers.playing import output, process


def refusal(*parameters, role='learner'):
    """What a node says that refuses these parameters."""
    with process(role, 'peer_deadline:=180.0', *parameters) as node:
        said = output(node)
    assert node.returncode == 1, said
    assert 'Traceback' not in said
    assert 'gave up' not in said
    return said


@pytest.mark.parametrize('method', ['true', 'ones', 'lirpg'])
def test_a_learner_refuses_a_method_that_runs_in_process_only(ros_domain, method):
    said = refusal(f'method:="{method}"')
    assert f"method = '{method}' {IN_PROCESS_ONLY[method]}" in said
    assert f'codetr train --in-process --method {method}' in said


def test_other_nodes_refuse_the_run_of_such_a_method_before_they_open_a_topic(play):
    play = play(settings=tiny(method='true'))
    with process('record') as node:
        play.until(lambda: node.poll() is not None)
        said = output(node)
    assert node.returncode == 1
    assert "/r/record: method = 'true' is a reference that looks at" in said
    assert 'Traceback' not in said
    assert {said.settings_hash for said in play.presence_of('record')} == {''}  # no core either


def test_a_reward_node_refuses_a_run_whose_learner_takes_the_scores_itself(play):
    play = play(settings=tiny(method='hc'), roles=('learner', 'sim'))
    with process('reward') as node:
        play.until(lambda: node.poll() is not None)
        said = output(node)
    assert node.returncode == 1
    assert "/r/reward: method = 'hc' learns from the scores in the learner" in said
    assert 'stop this one, or start the learner with another method' in said
    assert 'Traceback' not in said


def test_a_learner_refuses_a_task_that_does_not_exist_at_once(ros_domain):
    assert "there is no task 'Antt-v4' (close: Ant-v4" in refusal('task:=Antt-v4')


def test_a_learner_refuses_a_delay_beyond_the_horizon_at_once(ros_domain):
    said = refusal('task:=Reacher-v5', 'delay:=51')
    assert "delay = 51: task 'Reacher-v5' has a horizon of 50 steps" in said


def test_a_learner_refuses_the_folder_of_a_run_with_other_settings(ros_domain, tmp_path):
    run_folder.write_settings(tmp_path, load('quick').changed({'seed': 5}))
    said = refusal(f'folder:={tmp_path}')
    assert f'folder {tmp_path} holds another run, its config.yaml has other settings' in said
    assert 'give the parameter folder another one, or remove it' in said
    assert yaml.safe_load((tmp_path / 'config.yaml').read_text())['seed'] == 5


def test_a_learner_refuses_a_folder_with_checkpoints(ros_domain, tmp_path):
    run_folder.write_settings(tmp_path, load('quick'))
    (tmp_path / 'checkpoints' / 'learner-000007').mkdir(parents=True)
    said = refusal(f'folder:={tmp_path}')
    assert f'folder {tmp_path} holds another run, whose checkpoints are in' in said
    assert 'learner-000007' in said


def test_a_learner_takes_the_folder_that_codetr_train_has_made_for_it(ros_domain, tmp_path):
    folder = run_folder.create(tmp_path / 'run')
    run_folder.write_settings(folder, load('quick'))
    with process('learner', f'folder:={folder}', 'peer_deadline:=0.5') as node:
        said = output(node)
    assert 'holds another run' not in said
    assert 'gave up after 0.5 s: it waits for' in said


@pytest.mark.parametrize(
    'kind',
    [
        BagError, CheckpointError, CompositeError, NetworkError, RecordError, RewardModelError,
        SacError, SettingsError, TaskError, run_folder.RunFolderError, errors.NodeError,
    ],
)  # fmt: skip
def test_an_error_of_ours_is_told_in_its_own_words(kind):
    assert errors.explains_itself(kind('why'))
    assert errors.in_words(kind('why')) == 'why'


def test_any_other_error_is_told_with_its_kind():
    assert not errors.explains_itself(ValueError('why'))
    assert errors.in_words(ValueError('why')) == 'ValueError: why'


class Core(Part):
    """A core whose third slice fails."""

    subscribes = ()
    signal = None  # comes in the second slice: one in the first cuts it short, nothing is saved

    def __init__(self, error, stop):
        super().__init__()
        self.error = error
        self.stop = stop
        self.saved = False

    def work(self):
        yield []
        self.stop.signal = self.signal
        yield []
        raise self.error

    def close(self):
        self.saved = True

    def report(self):
        return CoreReport()


class Alone(Wiring):
    """The wiring of a node that lacks nobody."""

    def lacking(self):
        return []


def begun(play, stop, core):
    """A node with this core, in a run that needs nobody else."""
    play = play(roles=())
    member = Membership('learner', 'learner', stop)

    def join(member):
        member.introduce()
        member.run = play.spec
        member.serve(core)
        return Joined(play.spec, play.settings, core, None)

    return Node(member, join, Alone)


@pytest.mark.parametrize(
    ('error', 'traceback'),
    [(SacError('training has diverged'), False), (ZeroDivisionError('by zero'), True)],
    ids=['ours', 'a fault'],
)
def test_an_error_amid_a_slice_ends_the_node_without_saving(play, capfd, error, traceback):
    stop = Stop()
    core = Core(error, stop)
    assert begun(play, stop, core).run() == 1
    said = capfd.readouterr().err
    assert str(error) in said
    assert ('Traceback' in said) == traceback
    assert not core.saved


def test_a_node_that_is_stopped_between_two_slices_saves(play):
    stop = Stop()
    core = Core(SacError('not reached'), stop)
    core.signal = signal.SIGTERM
    assert begun(play, stop, core).run() == 0
    assert core.saved


SHOW = """
import os
from codetr_ros.processes import middleware
from codetr_ros.ros.node import Node, run_node

def show(node):
    print('shown', *(os.environ[name] for name in middleware.DEFAULTS))
    node.member.close()
    return 0

Node.run = show
run_node('record', 'record', None, [])
"""


def test_a_node_started_by_hand_looks_at_this_host_only_unless_the_user_says_otherwise(ros_domain):
    bare = {k: v for k, v in os.environ.items() if k not in middleware.DEFAULTS}

    def shown(environ):
        command = [sys.executable, '-c', SHOW]
        done = subprocess.run(command, env=environ, capture_output=True, text=True, check=True)
        (line,) = re.findall(r'^shown (.*)$', done.stdout, re.MULTILINE)
        return line.split()

    assert shown(bare) == ['LOCALHOST', 'SYNCHRONOUS']
    asked = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SUBNET'}
    assert shown(bare | asked) == ['SUBNET', 'SYNCHRONOUS']
