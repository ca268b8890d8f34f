"""A simulator that is silent for too long is left out of the run, and joins it again."""

import signal

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.offline.replay import replay
from codetr_ros.records import Commit
from helpers import slow_robots
from helpers.builders import tiny
from helpers.nodes import Nodes, Witness

SETTINGS = tiny(
    simulators=3, steps=6000, phase_steps=150, warmup_steps=300, evaluate_every=0,
    task=slow_robots.POINT,
)  # fmt: skip


@pytest.mark.slow
def test_a_simulator_that_is_held_is_left_out_joins_again_and_the_bag_has_the_weights(
    tmp_path, monkeypatch
):
    held = slow_robots.Held(tmp_path, 0.02)
    for name, value in held.variables.items():
        monkeypatch.setenv(name, value)
    with Nodes(SETTINGS, tmp_path / 'run') as nodes, Witness(nodes) as witness:
        first = [name for name in nodes.names if name != 'sim_3']
        for name in first:
            more = ['leave_out_after:=3.0'] if name == 'record' else []
            nodes.start(name, *more)
        witness.until(lambda: witness.follows(first))
        nodes.start('sim_3')
        witness.until(lambda: witness.committed(2))
        nodes.send(signal.SIGSTOP, 'sim_2')
        out = witness.until(
            lambda: next((c for c in witness.commits if 'sim_2' in c.dropped), None)
        )
        nodes.send(signal.SIGCONT, 'sim_2')
        # the run is slow until then, or it could be over too soon
        witness.until(lambda: 'joins the run again with phase' in nodes.log('sim_2'))
        held.let_go()
        codes = nodes.wait()
        log = nodes.log('record')
        counters = nodes.report('record')['counters']
    assert codes == dict.fromkeys(nodes.names, 0)
    assert f'sim_2 is left out of phase {out.phase}: nothing has come from it for' in log
    commits = [entry.record for entry in Bag(nodes.folder / 'bag').entries((Commit,))]
    # on a slow machine others may be left out, too
    dropped = sum(len(set(c.dropped) & set(c.sources)) for c in commits)
    assert counters['phases of a source dropped'] == dropped > 0
    assert any(
        c.phase > out.phase and 'sim_2' in c.sources and 'sim_2' not in c.dropped for c in commits
    )

    bag = nodes.folder / 'bag'
    found = verify(bag)
    assert found.findings.named == []
    assert found.sound
    again = replay(Bag(bag), nodes.folder / 'checkpoints')
    assert again.first is None
    assert again.phases == SETTINGS.phases
    assert again.same['checkpoint of the learner'] > 0
    learnt = again.reports
    assert learnt['learner'].policy_sha256 == nodes.report('learner')['policy_sha256']
    assert learnt['reward'].reward_model_sha256 == nodes.report('reward')['reward_model_sha256']
