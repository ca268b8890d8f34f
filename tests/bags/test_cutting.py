"""Cutting a bag back to its last commit, so that the run can get longer."""

from collections import Counter

import numpy as np
import pytest

from codetr_ros.bags.cutting import cut
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.cores.recorder import Recorder
from codetr_ros.cores.simulator import Simulator
from codetr_ros.records import TOPICS, Commit, EpisodeResult, Metrics, Policy, TrueRewards
from codetr_ros.records.dropped import undropped
from helpers.builders import policy
from helpers.cores import slices
from helpers.leaving import WITH_TWO, bag_with_dropped_steps

BOTH = ('sim', 'sim_2')


def records(folder):
    return [entry.record for entry in Bag(folder).entries()]


def behind_last_commit(there):
    last = max(i for i, record in enumerate(there) if isinstance(record, Commit))
    return there[last + 1 :]


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """A bag of a run from which a simulator was left out, before and after it was cut: the first
    of these runs whose last true rewards come behind the last commit.
    """
    for seed in WITH_TWO:
        folder = tmp_path_factory.mktemp('cut') / 'bag'
        simulated, ended = bag_with_dropped_steps(folder, seed)
        assert ended.failures == [] and ended.errors == {}
        before = records(folder)
        if any(isinstance(record, TrueRewards) for record in behind_last_commit(before)):
            return folder, simulated, before, cut(folder)
    raise AssertionError('true rewards come before the last commit in all of these runs')


def test_what_a_simulator_published_and_no_commit_waited_for_stays(made):
    folder, _, before, left = made

    def of_simulators(there):
        late = (TrueRewards, EpisodeResult, Metrics)
        return Counter(
            type(r) for r in there if isinstance(r, late) and getattr(r, 'role', 'sim') == 'sim'
        )

    assert of_simulators(records(folder)) == of_simulators(before)
    assert left.left_out[f'/run/{TOPICS[Policy]}'] == 1  # the last, which permitted nothing more
    kinds = {finding.kind for finding in verify(folder).findings.named}
    assert kinds == {'metadata'}  # which whoever goes on with the bag writes


def test_recorder_and_simulators_go_on_behind_steps_that_were_dropped(made):
    folder, simulated, _, left = made
    settings = simulated.plan.settings.changed({'steps': 120})
    run, there = settings.run_spec('simtest'), records(folder)
    recorder = Recorder(run, settings, 'record')
    simulators = [Simulator(run, settings, name) for name in settings.simulator_names]
    for record in there:
        recorder.restore(record)
    for record in undropped(there):
        for simulator in simulators:
            simulator.restore(record)
    due = left.commit.phase + 1
    assert (recorder.phase, recorder.left_out) == (due, frozenset())
    steps = np.array(settings.shares_of(due), np.uint32)
    permit = policy(run_id=run.run_id, phase=due, sources=BOTH, steps=steps)
    recorder.receive(permit)
    for simulator in simulators:
        simulator.resume(due)
        simulator.receive(permit)
        for record in slices(simulator.work()):
            if isinstance(record, recorder.subscribes):
                recorder.receive(record)
    lacks = f'labels of phase {due - 1} from the reward node'
    assert recorder.waiting_for() == f'the rest of phase {due}: {lacks}'  # which are made again
