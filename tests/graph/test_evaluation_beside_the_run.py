"""Evaluation delays no phase: the run goes on although the evaluator does nothing at all."""

import os
import signal

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from kills import phase_of

from codetr_ros.cores import in_process
from helpers import layout
from helpers.builders import tiny
from helpers.nodes import NAMESPACE, Nodes, Witness, domain
from helpers.runs import finish, node_of, start, until, write


def plotted(witness):
    """Whether all that the layout for Foxglove plots is there, with a type that can be plotted."""
    names = {NAMESPACE + name.removeprefix(layout.NAMESPACE) for name in layout.plotted()}
    assert len(names) >= 6
    seen = {}

    def found():
        seen.update(witness.link.node.get_topic_names_and_types())
        return names <= set(seen) and all(seen[n] == ['std_msgs/msg/Float64'] for n in names)

    return found


@pytest.mark.slow
def test_an_evaluator_that_stands_still_delays_no_phase_and_makes_up_for_it(tmp_path):
    settings = tiny(steps=3000)
    last = settings.phases - 1
    with domain(), Nodes(settings, tmp_path / 'run') as nodes, Witness(nodes) as witness:
        nodes.start_before(witness)
        witness.until(plotted(witness))
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


@pytest.mark.slow
@pytest.mark.parametrize('number', [signal.SIGKILL, signal.SIGSTOP])
def test_a_run_whose_evaluator_is_lost_for_good_ends_well_and_counts_what_is_missing(
    tmp_path, number
):
    settings, folder = tiny(steps=2000, threads=1), tmp_path / 'run'
    flags = ('--restarts', '0', '--peer-deadline', '5')
    command = start(write(settings, folder), folder, *flags)
    try:
        until(lambda: phase_of(folder) >= 2, command, folder)
        os.kill(node_of(folder, 'evaluate'), number)
        summary, said = finish(command, folder)
    finally:
        command.kill()
    undisturbed = in_process.run(settings, 'calls')
    assert summary['policy_sha256'] == undisturbed['learner'].policy_sha256
    assert summary['failure'] is None and summary['steps'] == settings.steps
    missing, there = summary['evaluations_missing'], len(summary['evaluations'])
    due = sum(map(settings.evaluated, range(settings.phases)))
    assert missing and there + missing - (summary['random'] is None) == due
    assert all(row['episodes'] == settings.evaluate_episodes for row in summary['evaluations'])
    assert summary['final_score'] is None or there
    for text in (said, (folder / 'report.html').read_text()):
        shown = ' '.join(text.split())
        assert f'{missing} of {due + 1} evaluations are missing or lack episodes' in shown
    assert 'the run goes on without it' in ' '.join(said.split())
