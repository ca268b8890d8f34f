"""Nodes that are held (SIGSTOP) for a while, and the run ends as if nothing had happened."""

import signal
import time

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from codetr_ros.bags.verify import verify
from codetr_ros.cores import in_process
from helpers import holding
from helpers.builders import tiny
from helpers.nodes import Nodes, Witness

SETTINGS = tiny(steps=2400)
HELD = 6.0  # [s]
APART = 2.0  # [s] from one to the next: several are held at the same time


@pytest.mark.slow
def test_every_node_is_held_for_a_while_and_the_weights_are_the_same(tmp_path):
    undisturbed = in_process.run(SETTINGS, 'run')
    with (
        holding.held(tmp_path / 'held', 3) as hold,
        Nodes(SETTINGS, tmp_path / 'run') as nodes,
        Witness(nodes) as witness,
    ):
        nodes.start_before(witness)
        witness.until(lambda: witness.committed(2))
        held = {}
        for name in nodes.names:
            nodes.send(signal.SIGSTOP, name)
            held[name] = time.monotonic()
            hold.release()  # nothing ends without the first of them
            witness.until(lambda name=name: time.monotonic() - held[name] > APART)
        for name, since in held.items():
            witness.until(lambda since=since: time.monotonic() - since > HELD)
            nodes.send(signal.SIGCONT, name)
        codes = nodes.wait()
    assert codes == dict.fromkeys(nodes.names, 0)
    assert nodes.report('learner')['policy_sha256'] == undisturbed['learner'].policy_sha256
    model = undisturbed['reward'].reward_model_sha256
    assert nodes.report('reward')['reward_model_sha256'] == model
    assert not any(nodes.report(name)['lost'] for name in nodes.names)
    assert verify(nodes.folder / 'bag').findings.named == []
