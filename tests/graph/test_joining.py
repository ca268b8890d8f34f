"""Simulators join a running run by their names, leave it, and join it again."""

import os
import shlex
import signal
from dataclasses import dataclass
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.nodes.signing import VARIABLE
from codetr_ros.offline.replay import replay
from helpers.builders import tiny
from helpers.forked import Forked
from helpers.holding import held
from helpers.nodes import NAMESPACE, Nodes, Witness
from helpers.runs import finish, start, write

JOINERS = ('arm_3', 'arm_4')
SETTINGS = tiny(
    simulators=2, joiners=JOINERS, steps=4800, phase_steps=120, warmup_steps=240, evaluate_every=0
)


def go_on(hold, witness, found):
    """Let a held run go on, phase by phase, until a commit from now on is one that is looked for;
    that commit.
    """
    since = len(witness.commits)
    while not (there := [each for each in witness.commits[since:] if found(each)]):
        witness.until(lambda: witness.committed(hold.phase - 1))
        hold.before(hold.phase + 1)
    return there[0]


def instance_of(witness, name):
    return witness.presence[name].instance_id if name in witness.presence else ''


def join(start, hold, witness, names):
    """Start those that join, and let the run go on until a commit has steps of them."""
    before = {name: instance_of(witness, name) for name in names}
    for name in names:
        start(name)
    for name in names:
        witness.until(lambda n=name: instance_of(witness, n) != before[n])
        witness.until(lambda n=name: 'waits for permission' in witness.presence[n].doing)
    go_on(hold, witness, lambda commit: set(names) <= set(commit.sources) and not commit.dropped)


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
    with (
        held(tmp_path / 'held', 3) as hold,
        Nodes(SETTINGS, tmp_path / 'run') as nodes,
        Witness(nodes) as witness,
    ):
        first = [name for name in nodes.names if name != 'sim_2']
        for name in first:
            nodes.start(name, *(['leave_out_after:=3.0'] if name == 'record' else []))
        witness.until(lambda: witness.follows(first))
        nodes.start('sim_2')
        two = go_on(hold, witness, lambda commit: set(commit.sources) == {'sim', 'sim_2'})
        assert set(two.dropped) == set(JOINERS)
        join(nodes.start, hold, witness, JOINERS)
        nodes.send(signal.SIGKILL, 'arm_4')
        nodes.send(signal.SIGINT, 'arm_3')
        go_on(hold, witness, lambda commit: set(JOINERS) <= set(commit.dropped))
        left = nodes.wait(*JOINERS)
        assert [left[name] for name in JOINERS] == [0, -signal.SIGKILL]
        witness.until(lambda: 'sim /run_run/arm_3 has ended' in nodes.log('learner'))
        join(nodes.start, hold, witness, JOINERS)
        hold.release()
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


@dataclass
class Started:
    """A run that `codetr train` has started, as far as a witness asks for it."""

    folder: Path
    command: Forked
    key: str

    def codes(self):
        """The exit code of the command, None while it runs."""
        return {'train': self.command.poll()}


@pytest.mark.slow
def test_a_simulator_joins_by_the_command_that_codetr_train_prints(tmp_path, monkeypatch):
    key = '5a' * 32
    monkeypatch.setenv(VARIABLE, key)
    settings = SETTINGS.changed({'simulators': 1, 'joiners': ('arm_2',)})
    folder, log = tmp_path / 'run', tmp_path / 'arm_2.log'
    flags = ('--namespace', NAMESPACE, '--leave-out-after', '3', '--peer-deadline', '300')
    with held(tmp_path / 'held', 3) as hold:
        command = start(write(settings, folder), folder, *flags)
        try:
            with Witness(Started(folder, command, key)) as witness:
                lines = iter(command.stdout.readline, '')
                words = shlex.split(next(line for line in lines if '__node:=arm_2' in line))
                joiners = []

                def begin(name):
                    with log.open('ab') as output:
                        joiners.append(Forked(words, os.environ, output))

                witness.until(lambda: witness.committed(2))
                join(begin, hold, witness, ['arm_2'])
                assert 'joins the run with phase' in log.read_text()
                joiners[0].kill()
                go_on(hold, witness, lambda commit: 'arm_2' in commit.dropped)
                assert 'arm_2 is left out of phase' in (folder / 'logs' / 'record.log').read_text()
                join(begin, hold, witness, ['arm_2'])
                assert 'joins the run again with phase' in log.read_text()
                hold.release()
            summary, _ = finish(command, folder)
            assert joiners[1].wait(120) == 0
        finally:
            command.kill()
    assert summary['failure'] is None
    assert summary['left_out']['arm_2'] >= 1
    weights = [summary['policy_sha256'], summary['reward_model_sha256']]
    assert weights_again(folder, settings.phases) == weights
