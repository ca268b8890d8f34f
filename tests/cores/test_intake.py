"""What the consumers refuse at the door, and that they take in exactly what a commit names, in
order.
"""

import numpy as np
import pytest

from codetr_ros.cores.intake import Intake
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import RecordError
from helpers.builders import (
    ACTION,
    OBSERVATION,
    commit,
    run,
    score,
    task_spec,
    tiny,
    transitions,
)
from helpers.commits import STEPS, chunk, committed


def intake(**changes) -> Intake:
    settings = tiny(**(STEPS | changes))
    return Intake(run(settings), settings, scores=True)


def known(**changes) -> Intake:
    made = intake(**changes)
    made.receive(task_spec())
    return made


def memory() -> Trajectories:
    return Trajectories(OBSERVATION, ACTION, 7, 1000, 1000)


NAN = np.array([[0, 0, 0]] * 3 + [[0, np.nan, 0]] + [[0, 0, 0]] * 2, np.float32)


@pytest.mark.parametrize(
    ('record', 'said'),
    [
        (
            transitions(run_id='other'),
            r"is of run 'other', this is run 'run'.*namespace of its own",
        ),
        (transitions(observations=NAN), r'observations\[3, 1\] is nan: all values must be finite'),
        (transitions(actions=np.full((5, ACTION), np.inf, np.float32)), r'actions\[0, 0\] is inf'),
        (
            transitions(observations=np.zeros((6, OBSERVATION + 1), np.float32)),
            r"observations have shape \(6, 4\), \(6, 3\) expected of task a task as 'sim'",
        ),
        (
            transitions(steps=5, actions=np.zeros((4, ACTION), np.float32)),
            r'actions have shape \(4, 2\), \(5, 2\)',
        ),
        (transitions(first_step=998), 'step 1003 lies beyond the horizon 1000'),
        (transitions(source='stranger'), "'stranger' is no simulator of this run; these are: sim"),
        (transitions(sequence=400), "out of sequence: .* 0 is the next of 'sim'"),
        (score(value=float('nan')), 'value is nan: a composite reward must be finite'),
        (
            score(value=-1e101),
            'value is -1e.101: a composite reward must be from -1e.100 to 1e.100',
        ),
        (score(length=8), 'length is 8: a segment has 1 to 7 steps'),
        (score(length=0), 'length is 0'),
        (score(run_id='other'), "is of run 'other'"),
        (commit(run_id='other'), "is of run 'other'"),
        (
            task_spec(source='second'),
            "'second' is one simulator too many: the run has simulators=1",
        ),
        (task_spec(protocol_version=99), "'sim' speaks protocol 99, this node 2"),
        (task_spec(source='x', action_size=5), "'x' has action_size=5, 'sim' has 2"),
    ],
)
def test_what_cannot_be_is_refused_by_name_value_and_source_and_changes_nothing(record, said):
    it, m = known(), memory()
    with pytest.raises(RecordError, match=said):
        it.receive(record)
    it.receive(chunk())
    it.receive(committed(chunk()))
    assert it.take(0, m) and m.steps == 5


def test_nothing_enters_the_memory_before_its_commit():
    it, m = known(), memory()
    it.receive(chunk())
    assert not it.take(0, m) and m.steps == 0 and it.missing is None


def test_what_belongs_to_a_later_phase_waits_outside():
    it, m = known(), memory()
    it.receive(chunk())
    it.receive(chunk(1))
    first = committed(chunk())
    it.receive(first)
    assert it.take(0, m) and m.steps == 5
    it.receive(committed(chunk(1), before=[first]))
    assert it.take(1, m) and m.steps == 10


def test_the_order_of_arrival_does_not_matter():
    halves = [
        transitions(steps=2, observations=transitions().observations[:3]),
        transitions(
            sequence=1, first_step=2, steps=3, observations=transitions().observations[2:],
            phase_end=True, scores_due=1,
        ),
    ]  # fmt: skip
    scored = score(first_step=0, length=5)
    memories = []
    for arrival in ([*halves, scored], [scored, *halves[::-1]], [*halves[::-1], scored]):
        it = Intake(run(tiny(**STEPS, delay=5)), tiny(**STEPS, delay=5), scores=True)
        m = Trajectories(OBSERVATION, ACTION, 5, 1000, 1000)
        for record in (*arrival, committed(*halves, scored), task_spec()):
            it.receive(record)
        assert it.take(0, m)
        memories.append(m.segments.batch(m.segments.ids()))
    for other in memories[1:]:
        np.testing.assert_array_equal(other.observations, memories[0].observations)


def test_a_commit_whose_steps_have_not_all_arrived_is_missing_until_they_have():
    it, m = known(), memory()
    it.receive(committed(chunk()))
    assert not it.take(0, m) and it.missing == 0 and m.steps == 0
    assert it.waiting_for() == 'the rest of phase 0'
    it.receive(chunk())
    assert it.take(0, m) and it.missing is None and m.steps == 5


def test_what_arrives_twice_is_counted_and_taken_once():
    it, m = known(), memory()
    it.receive(chunk())
    it.receive(chunk())
    it.receive(committed(chunk()))
    assert it.take(0, m) and m.steps == 5
    it.receive(chunk())
    it.receive(committed(chunk()))
    assert it.duplicated == {'transitions': 2, 'commits': 1}


def test_a_score_for_no_segment_is_left_out_counted_and_said(caplog):
    it, m = known(), memory()
    steps, wrong = chunk(scores_due=1), score(first_step=7)
    for record in (steps, wrong, committed(steps, wrong)):
        it.receive(record)
    assert it.take(0, m)
    assert it.refused == {'composite_rewards': 1} and len(m.segments.ids()) == 0
    assert 'there is no such segment' in caplog.text


def test_records_of_several_sources_enter_in_the_order_of_their_names():
    settings = tiny(simulators=2, steps=30, phase_steps=10, warmup_steps=10)
    it = Intake(run(settings), settings, scores=False)
    both = [chunk(source='b'), chunk(source='a')]
    for record in both:
        it.receive(task_spec(source=record.source))
        it.receive(record)
    m = memory()
    it.receive(committed(*both))
    assert it.take(0, m) and list(m.labelled.columns()['labels']) == ['a', 'b']
