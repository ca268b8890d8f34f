"""Evaluation delays no phase: the run goes on although the evaluator does nothing at all."""

import signal

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from codetr_ros.cores import in_process
from helpers.builders import tiny
from helpers.nodes import Nodes, Witness, domain


@pytest.mark.slow
def test_an_evaluator_that_stands_still_delays_no_phase_and_makes_up_for_it(tmp_path):
    settings = tiny()
    last = settings.phases - 1
    with domain(), Nodes(settings, tmp_path / 'run') as nodes, Witness(nodes) as witness:
        nodes.start_before(witness)
        witness.until(lambda: witness.committed(0))
        nodes.send(signal.SIGSTOP, 'evaluate')
        witness.until(lambda: witness.committed(last))  # under a policy that it should evaluate
        nodes.send(signal.SIGCONT, 'evaluate')
        codes = nodes.wait()
    assert set(codes.values()) == {0}, codes
    said = nodes.report('evaluate')
    assert said['counters']['evaluations'] == 1 + sum(map(settings.evaluated, range(last + 1)))
    assert said['lost'] == said['refused'] == {}
    undisturbed = in_process.run(settings, 'calls')
    for name, digest in (('learner', 'policy_sha256'), ('reward', 'reward_model_sha256')):
        assert nodes.report(name)[digest] == getattr(undisturbed[name], digest)
