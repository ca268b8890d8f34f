"""What a simulator asks the recorder for when it joins a run that has begun, and where a learner
that was killed goes on.
"""

import logging
from types import SimpleNamespace

import numpy as np
import pytest

from codetr_ros.bags.definitions import decode, encode
from codetr_ros.bags.topics import RECORDED, topics_of_run
from codetr_ros.cores.simulator import Simulator
from codetr_ros.nodes import restoring
from codetr_ros.nodes.kept_run import KeptRun
from codetr_ros.nodes.peers import Peers
from codetr_ros.nodes.restoring import Returning, go_on, take_place
from codetr_ros.records import TOPICS, Commit
from codetr_ros.records.fields import type_name
from helpers.builders import commit, policy, presence, run, task_spec, tiny, transitions

SETTINGS = tiny(joiners=('arm_2',), steps=4000, phase_steps=10, warmup_steps=4000)
LATE = 20
"""The phase in which the newcomer announces itself."""


@pytest.fixture(params=['bag', 'memory'])
def kept(request, tmp_path):
    """A recorder's records of a run of `sim` alone, into which `arm_2` is then let."""
    names = {kind: f'/run/{TOPICS[kind]}' for kind in RECORDED}
    topics = dict(zip(RECORDED, topics_of_run(names, SETTINGS), strict=True))
    folder = tmp_path / 'bag' if request.param == 'bag' else None
    made = KeptRun(folder, topics, SETTINGS.ahead + 2, SETTINGS.phase_steps)
    made.open('run', lambda record, data: None)
    write(made, task_spec())
    for phase in range(LATE + 1):
        if phase == LATE:
            write(made, task_spec(source='arm_2'))
        out = () if phase == LATE else ('arm_2',)
        write(made, policy(phase=phase, sources=('arm_2', 'sim'), steps=np.array([0, 5])))
        write(made, transitions(sequence=phase, phase=phase, first_step=5 * phase, phase_end=True))
        numbers = np.array([phase], np.int64)
        write(made, commit(phase=phase, transitions=numbers, scores=numbers, dropped=out))
        made.flush()
    yield made
    made.close()


def write(kept, record):
    kept.write(record, encode(record), 0)


def newcomer():
    core = Simulator(run(SETTINGS), SETTINGS, 'arm_2')
    peers = Peers('sim')
    peers.note(presence('record', {'commits': LATE}), 0.0)
    return core, Returning(
        role='sim', name='arm_2', core=core, settings=SETTINGS, peers=peers,
        catch_up=lambda newest: None, begin_counting_anew=lambda: None, log=logging.getLogger(),
    )  # fmt: skip


def answered(steps, kept, newest):
    """Answer all that is asked; the phases that were asked for."""
    asked = []
    question = next(steps)
    while True:
        phase = min(question.phase, newest)
        asked.append(phase)
        sent = kept.read(phase, [type_name(kind) for kind in question.kinds])
        try:
            question = steps.send((phase, [decode(kind, data) for kind, data in sent]))
        except StopIteration:
            return asked


def test_one_that_the_run_goes_on_without_asks_for_nothing_before_it_is_let_in(kept):
    core, node = newcomer()
    assert set(answered(go_on(node), kept, LATE - 1)) == {LATE - 1}
    assert core.due == LATE
    core.receive(policy(phase=LATE, sources=('arm_2', 'sim'), steps=np.array([5, 5])))
    assert core.displaced


def test_one_that_is_let_in_asks_back_to_its_announcement_and_not_to_the_beginning(kept, caplog):
    core, node = newcomer()
    with caplog.at_level(logging.INFO):
        assert set(answered(take_place(node), kept, LATE)) == {LATE}
    assert core.due == LATE + 1
    assert core.is_new
    assert f'joins the run with phase {LATE + 1}' in caplog.text


def test_an_announcement_belongs_to_the_phase_that_is_committed_next(kept):
    kinds = [type_name(type(task_spec())), type_name(Commit)]
    for phase, sources in ((LATE, ['arm_2']), (LATE - 1, [])):
        *announced, last = [decode(kind, data) for kind, data in kept.read(phase, kinds)]
        assert [each.source for each in announced] == sources
        assert last.phase == phase


@pytest.mark.parametrize(('overlap', 'phase'), [(False, 5), (True, 4)])
def test_a_learner_publishes_the_permission_again_that_a_killed_recorder_may_have_lost(
    overlap, phase
):
    """That for phase 6 follows from phase 5, with overlap from phase 4: whatever later checkpoint
    it has.
    """
    core = Resumes()
    settings = tiny(overlap=overlap)
    node = SimpleNamespace(
        core=core, settings=settings, log=logging.getLogger(), catch_up=lambda newest: None
    )
    assert list(restoring._learner(node, 5)) == []
    assert core.resumed == [phase]


class Resumes:
    """A core that has a checkpoint of each phase."""

    def __init__(self):
        self.resumed = []

    def resume(self, phase):
        self.resumed.append(phase)
        return phase
