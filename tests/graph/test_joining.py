"""Simulators join a running run by their names, leave it, and join it again."""

import os
import shlex
import signal
from contextlib import contextmanager

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from kills import phase_of

from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.nodes.signing import VARIABLE
from codetr_ros.offline.replay import replay
from helpers.builders import tiny
from helpers.forked import Forked
from helpers.nodes import Nodes, Witness
from helpers.runs import finish, node_of, start, until, write

JOINERS = ('arm_3', 'arm_4')
SETTINGS = tiny(
    simulators=2, joiners=JOINERS, steps=4800, phase_steps=120, warmup_steps=240, evaluate_every=0
)


@contextmanager
def going_on(nodes):
    """Let the run go on for a while. Else it is held, so that it is not over before others have
    started.
    """
    nodes.send(signal.SIGCONT, 'learner')
    yield
    nodes.send(signal.SIGSTOP, 'learner')


def join(nodes, witness):
    """Start those that join, and wait until a commit has steps of them."""
    since = len(witness.commits)
    before = {name: witness.presence.get(name) for name in JOINERS}
    for name in JOINERS:
        nodes.start(name)
    witness.until(lambda: all(witness.presence.get(n) is not before[n] for n in JOINERS))
    with going_on(nodes):
        witness.until(lambda: any(has_all(commit) for commit in witness.commits[since:]))


def has_all(commit):
    return set(JOINERS) <= set(commit.sources) and not commit.dropped


def weights_again(folder, phases):
    """The weights that learn again from the bag of a run, which must be sound."""
    found = verify(folder / 'bag')
    assert found.findings.named == []
    assert found.sound
    again = replay(Bag(folder / 'bag'), folder / 'checkpoints')
    assert (again.first, again.phases) == (None, phases)
    learnt = again.reports
    return [learnt['learner'].policy_sha256, learnt['reward'].reward_model_sha256]


@pytest.mark.slow
def test_two_then_four_simulators_join_leave_and_join_again(tmp_path):
    with Nodes(SETTINGS, tmp_path / 'run') as nodes, Witness(nodes) as witness:
        first = [name for name in nodes.names if name != 'sim_2']
        for name in first:
            nodes.start(name, *(['leave_out_after:=3.0'] if name == 'record' else []))
        witness.until(lambda: witness.follows(first))
        nodes.start('sim_2')
        with going_on(nodes):
            witness.until(lambda: witness.committed(2))
        assert set(witness.commits[-1].sources) == {'sim', 'sim_2'}
        assert set(witness.commits[-1].dropped) == set(JOINERS)
        join(nodes, witness)
        nodes.send(signal.SIGKILL, 'arm_4')
        nodes.send(signal.SIGINT, 'arm_3')
        with going_on(nodes):
            witness.until(lambda: set(JOINERS) <= set(witness.commits[-1].dropped))
        left = nodes.wait(*JOINERS)
        assert [left[name] for name in JOINERS] == [0, -signal.SIGKILL]
        assert 'sim /run_run/arm_3 has ended' in nodes.log('learner')
        join(nodes, witness)
        nodes.send(signal.SIGCONT, 'learner')
        codes = nodes.wait()
    assert codes == dict.fromkeys((*nodes.names, *JOINERS), 0)
    for name in JOINERS:
        assert 'joins the run with phase' in nodes.log(name)
        assert 'joins the run again with phase' in nodes.log(name)
    weights = [
        nodes.report('learner')['policy_sha256'],
        nodes.report('reward')['reward_model_sha256'],
    ]
    assert weights_again(nodes.folder, SETTINGS.phases) == weights


@contextmanager
def held(folder):
    """Hold the learner, so that the run is not over before others have started."""
    learner = node_of(folder, 'learner')
    os.kill(learner, signal.SIGSTOP)
    try:
        yield
    finally:
        os.kill(learner, signal.SIGCONT)


@pytest.mark.slow
def test_a_simulator_joins_by_the_command_that_codetr_train_prints(tmp_path, monkeypatch):
    monkeypatch.setenv(VARIABLE, '5a' * 32)
    settings = SETTINGS.changed({'simulators': 1, 'joiners': ('arm_2',)})
    folder, log = tmp_path / 'run', tmp_path / 'arm_2.log'
    command = start(write(settings, folder), folder, '--leave-out-after', '3')
    try:
        lines = iter(command.stdout.readline, '')
        words = shlex.split(next(line for line in lines if '__node:=arm_2' in line))
        until(lambda: phase_of(folder) >= 2, command, folder)

        def join(news):
            with held(folder), log.open('ab') as output:
                joiner = Forked(words, os.environ, output)
                started = log.read_text().count('is there')
                until(lambda: log.read_text().count('is there') > started, command, folder)
            until(lambda: news in log.read_text(), command, folder)
            return joiner

        join('joins the run with phase').kill()
        out = 'arm_2 is left out of phase'
        until(lambda: out in said_by(folder, 'record'), command, folder)
        joiner = join('joins the run again with phase')
        summary, _ = finish(command, folder)
        assert joiner.wait(120) == 0
    finally:
        command.kill()
    assert summary['failure'] is None
    assert summary['left_out']['arm_2'] >= 1
    weights = [summary['policy_sha256'], summary['reward_model_sha256']]
    assert weights_again(folder, settings.phases) == weights


def said_by(folder, name):
    log = folder / 'logs' / f'{name}.log'
    return log.read_text() if log.exists() else ''
