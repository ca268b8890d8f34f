"""`codetr train --resume` over topics: all processes killed at once, and runs that get longer."""

import json
import os
import re
import shutil
import signal
from pathlib import Path

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from kills import phase_of

from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.cores import in_process
from codetr_ros.nodes.outbox import KEPT_PHASES
from codetr_ros.offline.replay import replay
from codetr_ros.runs import origin
from helpers import slow_robots
from helpers.builders import tiny
from helpers.forked import codetr
from helpers.runs import finish, node_of, start, until, write

SETTINGS = tiny(steps=1600, threads=1, evaluate_every=400, task=slow_robots.POINT)


@pytest.fixture
def held(tmp_path, monkeypatch):
    """Returns a function that lets the robots of a run be slow: it must not be over when it is
    killed.
    """

    def hold(seconds, after=0):
        made = slow_robots.Held(tmp_path, seconds, after)
        for name, value in made.variables.items():
            monkeypatch.setenv(name, value)
        return made

    return hold


def digests(settings):
    """The weights of an undisturbed run of these settings."""
    reports = in_process.run(settings, 'undisturbed')
    return [reports['learner'].policy_sha256, reports['reward'].reward_model_sha256]


def weights(summary):
    return [summary['policy_sha256'], summary['reward_model_sha256']]


def resumed(folder: Path, *flags: str):
    """Go on with a run to its end; its summary."""
    flags = ('--resume', str(folder), '--no-film', *flags)
    return finish(codetr('train', *flags, environment=dict(os.environ)), folder)[0]


def kill(command, folder: Path) -> None:
    """Kill all processes of a run at once."""
    nodes = [node_of(folder, path.stem) for path in (folder / 'logs').glob('*.log')]
    for number in (signal.SIGSTOP, signal.SIGKILL):  # nobody notices that another is dead
        for process in (command.pid, *nodes):
            os.kill(process, number)
    command.communicate()


@pytest.mark.slow
@pytest.mark.parametrize('overlap', [False, True], ids=['lock-step', 'overlap'])
def test_a_run_all_of_which_is_killed_goes_on_and_gets_longer_and_has_the_same_weights(
    tmp_path, overlap, held
):
    settings, folder = SETTINGS.changed({'overlap': overlap}), tmp_path / 'run'
    robot = held(seconds=1.0, after=4 * settings.phase_steps)
    command = start(write(settings, folder), folder)
    until(lambda: phase_of(folder) >= 3, command, folder)
    kill(command, folder)
    robot.let_go()
    summary = resumed(folder)
    assert weights(summary) == digests(settings)
    assert len(origin.read(folder).resumed) == 1
    assert verify(folder / 'bag').sound
    assert summary['evaluations_missing'] == 0

    for name in ('logs', 'nodes'):
        shutil.rmtree(folder / name)  # they are made again
    longer = settings.changed({'steps': 2400})
    summary = resumed(folder, '--steps', '2400')
    assert weights(summary) == digests(longer)
    assert summary['steps'] == 2400
    assert verify(folder / 'bag').sound
    assert summary['evaluations_missing'] == 0
    assert json.loads((folder / 'summary.json').read_text())['settings']['steps'] == 2400


@pytest.mark.slow
def test_a_run_from_which_a_simulator_was_left_out_goes_on_and_gets_longer(tmp_path, held):
    """Its weights are those that learn again from what was recorded."""
    changes = {
        'overlap': True, 'simulators': 2, 'steps': 4000, 'phase_steps': 100, 'evaluate_every': 0,
    }  # fmt: skip
    folder, robots = tmp_path / 'run', held(seconds=0.02)
    command = start(write(SETTINGS.changed(changes), folder), folder, '--leave-out-after', '2')
    until(lambda: phase_of(folder) >= 3, command, folder)
    os.kill(node_of(folder, 'sim_2'), signal.SIGSTOP)
    log, out = folder / 'logs' / 'record.log', r'sim_2 is left out of phase (\d+)'
    (phase,) = until(lambda: re.findall(out, log.read_text())[:1], command, folder)
    until(lambda: phase_of(folder) > int(phase), command, folder)  # that is in the bag
    kill(command, folder)
    robots.let_go()
    for steps in (4000, 4500):
        summary = resumed(folder, '--steps', str(steps))
        assert summary['steps'] == steps
        assert verify(folder / 'bag').sound
        again = replay(Bag(folder / 'bag'), folder / 'checkpoints')
        assert (again.first, again.phases) == (None, steps // 100)
        learnt = again.reports
        assert weights(summary) == [
            learnt['learner'].policy_sha256,
            learnt['reward'].reward_model_sha256,
        ]
    assert summary['left_out']['sim_2'] >= 1


@pytest.mark.slow
def test_a_run_without_checkpoints_is_learnt_again_from_its_bag(tmp_path, held):
    """By both sides at once, over more phases than the reward node keeps labels of."""
    settings = SETTINGS.changed(
        {'overlap': True, 'steps': 2400, 'phase_steps': 100, 'evaluate_every': 0}
    )
    phases = settings.warmup_phases + KEPT_PHASES + 5
    folder, robot = tmp_path / 'run', held(seconds=1.0, after=phases * settings.phase_steps)
    command = start(write(settings, folder), folder)
    until(lambda: phase_of(folder) >= phases - 1, command, folder)
    kill(command, folder)
    robot.let_go()
    shutil.rmtree(folder / 'checkpoints')
    summary = resumed(folder)
    assert weights(summary) == digests(settings)
    assert verify(folder / 'bag').sound
    assert 'there is no checkpoint to go on from' in (folder / 'logs/learner.log').read_text()
