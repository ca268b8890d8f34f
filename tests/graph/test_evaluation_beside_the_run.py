"""Evaluation delays no phase: the run goes on although the evaluator does nothing at all."""

import os
import signal
from contextlib import ExitStack

import pytest

pytest.importorskip('rclpy', reason='needs ROS')

from kills import phase_of

from codetr_ros.cores import in_process
from helpers import layout
from helpers.builders import tiny
from helpers.holding import held
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
    with (
        domain(),
        held(tmp_path / 'held', 5) as hold,
        Nodes(settings, tmp_path / 'run') as nodes,
        Witness(nodes) as witness,
    ):
        nodes.start_before(witness)
        witness.until(plotted(witness))
        nodes.send(signal.SIGSTOP, 'evaluate')
        hold.release()
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
def test_runs_whose_evaluators_are_lost_for_good_end_well_and_count_what_is_missing(tmp_path):
    settings, numbers = tiny(steps=2000, threads=1), (signal.SIGKILL, signal.SIGSTOP)
    folders = [tmp_path / number.name for number in numbers]
    with ExitStack() as cleanup:  # one waits for its evaluator while the other begins
        runs = [
            lost(settings, folder, number, cleanup)
            for folder, number in zip(folders, numbers, strict=True)
        ]
        ended = [finish(command, folder) for command, folder in zip(runs, folders, strict=True)]
    undisturbed = in_process.run(settings, 'calls')
    for folder, (summary, said) in zip(folders, ended, strict=True):
        assert summary['policy_sha256'] == undisturbed['learner'].policy_sha256
        check_missing(settings, folder, summary, said)


def lost(settings, folder, number, cleanup):
    """A run that goes on behind its second phase without its evaluator."""
    with held(folder.with_suffix('.held'), 3):
        # no node may be given up that the machine lets stand still meanwhile
        flags = ('--restarts', '0', '--peer-deadline', '20')
        command = start(write(settings, folder), folder, *flags)
        cleanup.callback(command.kill)
        until(lambda: phase_of(folder) >= 1, command, folder)
        os.kill(node_of(folder, 'evaluate'), number)
    return command


def check_missing(settings, folder, summary, said):
    """The evaluations that are missing are counted, wherever people look."""
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
