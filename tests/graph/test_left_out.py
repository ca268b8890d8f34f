"""A simulator that is silent for too long is left out of the run, and joins it again."""

import signal

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.offline.replay import replay
from helpers.builders import tiny
from helpers.nodes import Nodes, Witness

SETTINGS = tiny(simulators=3, steps=6000, phase_steps=150, warmup_steps=300, evaluate_every=0)


@pytest.mark.slow
def test_a_simulator_that_is_held_is_left_out_joins_again_and_the_bag_has_the_weights(tmp_path):
    with Nodes(SETTINGS, tmp_path / 'run') as nodes, Witness(nodes) as witness:
        first = [name for name in nodes.names if name != 'sim_3']
        for name in first:
            more = ['leave_out_after:=3.0'] if name == 'record' else []
            nodes.start(name, *more)
        witness.until(lambda: witness.follows(first))
        nodes.start('sim_3')
        witness.until(lambda: witness.committed(2))
        nodes.send(signal.SIGSTOP, 'sim_2')

        out = witness.until(lambda: next((c for c in witness.commits if c.dropped), None))
        nodes.send(signal.SIGSTOP, 'learner')  # or the run could be over too soon
        nodes.send(signal.SIGCONT, 'sim_2')
        there = witness.presence['sim_2']
        witness.until(lambda: witness.presence['sim_2'] is not there)
        nodes.send(signal.SIGCONT, 'learner')
        codes = nodes.wait()
        last = witness.until(
            lambda: witness.committed(SETTINGS.phases - 1) and witness.commits[-1]
        )
        log = nodes.log('record')
        counters = nodes.report('record')['counters']
    assert codes == dict.fromkeys(nodes.names, 0)
    assert out.dropped == ('sim_2',)
    assert (set(last.sources), last.dropped) == ({'sim', 'sim_2', 'sim_3'}, ())
    assert f'sim_2 is left out of phase {out.phase}: nothing has come from it for' in log
    assert 'joins the run again with phase' in nodes.log('sim_2')
    assert counters['phases of a source dropped'] == 1

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
