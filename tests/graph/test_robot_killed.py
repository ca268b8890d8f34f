"""Nodes of a run on a robot are killed while it moves, and started again; then all of them are
stopped, as for the night. The run goes on each time, and its bag teaches the same weights.
"""

import signal

import pytest

from codetr_ros import cli
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.verify import verify
from codetr_ros.records import CompositeReward, StepRewards, Transitions
from codetr_ros.runs import folder as run_folder
from helpers import nodes
from helpers.robot_runs import Person, RobotRun, robot_settings

pytestmark = pytest.mark.slow
ROLES = ('learner', 'reward', 'record', 'robot')


@pytest.fixture(scope='module', autouse=True)
def _domain():
    with nodes.domain():
        yield


def test_a_run_ends_well_and_is_replayed_though_its_nodes_were_killed_and_all_of_them_stopped(
    tmp_path,
):
    settings = robot_settings(steps=240, scorers=('robot', 'inspection'))
    folder = tmp_path / 'run'
    with RobotRun(settings, folder) as run:
        with Person(run) as person:
            run.begin('--late', '0.5')
            person.until(lambda: person.committed(0))
            person.until(person.moves)
            run.kill('robot')  # in the midst of a phase
            person.until(lambda: 'goes on where a node of this name ended' in run.log('robot'))
            person.until(lambda: person.committed(1))
            run.kill('record')
            person.until(lambda: 'goes on with' in run.log('record'))
            again = (
                f'record {nodes.NAMESPACE}/record is there again'  # else they end with an error
            )
            for name in ('learner', 'reward', 'robot'):
                person.until(lambda name=name: again in run.log(name))
            person.until(lambda: person.committed(2))
            person.ticks(15)
            for name in ('inspection', *ROLES):
                run.end(name, signal.SIGINT)
        ended = run.wait('inspection', *ROLES)
        assert {ended[name] for name in ROLES} == {0}
        before = scores(folder, 'inspection')
        run.inspect()
        run.again(*ROLES)
        codes = run.wait(*ROLES)
        assert {codes[name] for name in ROLES} == {0}, run.log('robot')
        assert run.report('robot')['counters']['times that the node was started again'] == 1
    found = verify(folder / run_folder.BAG)
    assert found.sound, found.findings.named
    records = [entry.record for entry in Bag(folder / run_folder.BAG).entries()]
    chunks = [record for record in records if isinstance(record, Transitions)]
    assert sum(chunk.steps for chunk in chunks) == settings.steps
    assert [chunk.sequence for chunk in chunks] == list(range(len(chunks)))
    own = scores(folder, 'robot')
    # each of them once; what the recorder missed while it was dead comes behind newer ones
    assert sorted(own) == list(range(len(own))) and len(own) > 3
    inspected = scores(folder, 'inspection')
    assert len(inspected) >= len(before) > 0
    assert sorted(before) == list(range(len(before)))
    assert inspected == before + list(range(len(before), len(inspected))), (
        'a scorer goes on behind its last number'
    )
    labelled = [record.phase for record in records if isinstance(record, StepRewards)]
    assert labelled == sorted(labelled)
    assert set(labelled) == set(range(settings.first_labelled, settings.phases))
    assert cli.main(['replay', str(folder), '--verify']) == 0


def scores(folder, scorer):
    """The numbers of a scorer's scores, in the order of the bag."""
    entries = Bag(folder / run_folder.BAG).entries((CompositeReward,))
    return [entry.record.sequence for entry in entries if entry.record.scorer == scorer]
