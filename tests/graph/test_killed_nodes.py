"""Nodes that are killed are started again, and the run ends as if nothing had happened."""

import os
import signal

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from kills import nodes

from codetr_ros.runs import folder as run_folder
from helpers.builders import tiny
from helpers.holding import held
from helpers.runs import finish, start, train, until, write

SETTINGS = tiny(steps=1600)
DIGESTS = ('policy_sha256', 'reward_model_sha256')


@pytest.fixture(scope='module')
def undisturbed(tmp_path_factory):
    summary, _ = train(SETTINGS, tmp_path_factory.mktemp('undisturbed') / 'run')
    return [summary[name] for name in DIGESTS]


@pytest.mark.slow
@pytest.mark.parametrize(
    'roles',
    [('learner', 'sim'), ('record', 'reward'), ('learner', 'record', 'reward', 'sim')],
    ids='-'.join,
)
def test_nodes_killed_at_once_join_again_and_the_weights_are_the_same(
    tmp_path, undisturbed, roles
):
    folder = tmp_path / 'run'
    learnt = folder / run_folder.CHECKPOINTS / 'learner-000002'
    with held(tmp_path / 'held', 4) as hold:
        command = start(write(SETTINGS, folder), folder)
        try:
            until(learnt.is_dir, command, folder)
            there = nodes(folder)
            for role in roles:
                os.kill(there[role], signal.SIGKILL)
            hold.release()
            summary, said = finish(command, folder)
        finally:
            command.kill()
    assert [summary[name] for name in DIGESTS] == undisturbed
    again = {use['role']: use['restarts'] for use in summary['processes'].values()}
    assert {role for role, times in again.items() if times} == set(roles)
    assert all(f'{role} was ended by SIGKILL: starting it again' in said for role in roles)
    for log in (folder / 'logs').glob('*.log'):
        errors = [line for line in log.read_text().splitlines() if '[ERROR]' in line]
        assert errors == [], log.stem
