"""A source from which nothing comes is left out of a phase, by everybody, and joins again."""

import numpy as np

from codetr_ros.cores.intake import Intake
from codetr_ros.cores.learner import Learner
from codetr_ros.cores.left_out import is_left_out, voided
from codetr_ros.cores.recorder import Recorder
from codetr_ros.cores.simulator import Simulator
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import Commit, Policy, TaskSpec, Transitions
from codetr_ros.records.dropped import undropped
from helpers.builders import commit, policy, run, score, task_spec, tiny, transitions
from helpers.cores import slices

BOTH = ('sim', 'sim_2')
SETTINGS = tiny(simulators=2, steps=40, phase_steps=10, warmup_steps=40)
VOIDED = SETTINGS.lag * 10  # no more records than that are under way


def permission(phase=0, steps=(5, 5)):
    return policy(phase=phase, sources=BOTH, steps=np.array(steps, np.uint32))


def recorder(settings=SETTINGS):
    made = Recorder(run(settings), settings, 'record')
    for name in BOTH:
        made.receive(task_spec(source=name))
    return made, made.work()


def commits(work):
    return [record for record in slices(work) if isinstance(record, Commit)]


def whole(source='sim', sequence=0, phase=0, **changes):
    return transitions(source=source, sequence=sequence, phase=phase, phase_end=True, **changes)


def test_a_phase_is_committed_without_a_silent_source_whose_numbers_are_voided():
    made, work = recorder()
    made.receive(permission())
    made.receive(whole())
    made.receive(transitions(source='sim_2', steps=3))
    made.receive(score(source='sim_2', scorer='sim_2', length=3))
    assert commits(work) == []
    assert made.leave_out(['sim_2']) == ['sim_2']
    (first,) = commits(work)
    assert first.dropped == ('sim_2',)
    assert (first.sources, first.transitions.tolist()) == (BOTH, [0, 1 + VOIDED])
    assert (first.scorers, first.scores.tolist()) == (('sim_2',), [1 + VOIDED])
    made.receive(whole('sim_2', 1, first_step=3, steps=2))  # late
    assert made.duplicated == {'transitions': 1}
    counters = made.report().counters
    assert counters['steps dropped'] == 3
    assert counters['phases of a source dropped'] == 1


def test_a_source_joins_again_behind_the_voided_numbers():
    made, work = recorder()
    made.receive(permission())
    made.receive(whole())
    made.leave_out(['sim_2'])
    (first,) = commits(work)
    made.receive(permission(1, (5, 0)))  # the learner permits it nothing
    made.receive(whole(sequence=1, phase=1, first_step=5))
    (second,) = commits(work)
    assert (second.sources, second.dropped) == (('sim',), ('sim_2',))  # it is not there again
    made.receive(task_spec(source='sim_2'))
    made.receive(permission(2, (5, 0)))
    made.receive(whole(sequence=2, phase=2, first_step=10))
    (third,) = commits(work)
    assert (third.sources, third.dropped) == (('sim',), ())  # it is, and is permitted the next
    made.receive(permission(3))
    made.receive(whole(sequence=3, phase=3, first_step=15))
    number = int(first.transitions[1]) + 1
    made.receive(whole('sim_2', number, 3))
    (fourth,) = commits(work)
    assert (fourth.sources, fourth.dropped) == (BOTH, ())
    assert fourth.transitions.tolist() == [3, number]


def test_with_overlap_the_phase_that_was_permitted_meanwhile_waits_for_nobody_either():
    made, work = recorder(SETTINGS.changed({'overlap': True}))
    made.receive(permission())
    made.receive(permission(1))
    made.receive(whole())
    made.receive(whole(sequence=1, phase=1, first_step=5))
    made.leave_out(['sim_2'])
    assert [one.dropped for one in commits(work)] == [('sim_2',), ('sim_2',)]


def test_nobody_is_left_out_of_a_phase_that_nobody_has_rolled_out():
    made, work = recorder()
    made.receive(permission())
    assert made.leave_out(BOTH) == []
    made.receive(whole())
    assert made.leave_out(['sim']) == []  # it is there
    assert commits(work) == []


def test_a_recorder_that_goes_on_with_its_bag_drops_what_was_dropped():
    made, work = recorder()
    there = [permission(), whole(), transitions(source='sim_2', steps=3)]
    for record in there:
        made.receive(record)
    made.leave_out(['sim_2'])
    there += commits(work)
    again, work = recorder()
    for record in there:
        again.restore(record)
    again.receive(permission(1, (5, 0)))
    again.receive(whole(sequence=1, phase=1, first_step=5))
    (second,) = commits(work)
    assert (second.phase, second.transitions.tolist()) == (1, [1])


def test_consumers_take_in_nothing_of_a_source_that_was_left_out_however_late_it_comes():
    made, work = recorder()
    intake = Intake(run(SETTINGS), SETTINGS, scores=True)
    for name in BOTH:
        intake.receive(task_spec(source=name))
    memory = Trajectories(3, 2, SETTINGS.delay, 100, 100)
    made.receive(permission())
    for record in (whole(), transitions(source='sim_2', steps=3)):
        made.receive(record)
        intake.receive(record)
    made.leave_out(['sim_2'])
    (first,) = commits(work)
    intake.receive(first)
    assert intake.take(0, memory)
    assert memory.steps == 5
    assert intake.dropped == {'steps dropped': 3}
    intake.receive(transitions(source='sim_2', sequence=1, first_step=3, steps=2))
    assert intake.duplicated == {'transitions': 1}
    made.receive(task_spec(source='sim_2'))
    last = voided(SETTINGS, 1)
    for phase, steps, more in ((1, (5, 0), []), (2, (5, 5), [whole('sim_2', last + 1, 2)])):
        made.receive(permission(phase, steps))
        for record in (whole(sequence=phase, phase=phase, episode=phase), *more):
            made.receive(record)
            intake.receive(record)
        (one,) = commits(work)
        intake.receive(one)
        assert intake.take(phase, memory)
    assert memory.steps == 20


def permitted(core, work):
    return [r for r in slices(work) if isinstance(r, Policy)]


def test_the_learner_permits_a_source_nothing_until_it_has_announced_itself_again():
    made, commits_of = recorder()
    core = Learner(run(SETTINGS), SETTINGS, 'learner', None)
    for name in BOTH:
        core.receive(task_spec(source=name))
    work = core.work()

    def roll_out(*chunks):
        for chunk in chunks:
            made.receive(chunk)
            core.receive(chunk)
        made.leave_out(['sim_2'])
        for each in commits(commits_of):
            core.receive(each)
        (permit,) = permitted(core, work)
        made.receive(permit)
        return permit.steps.tolist()

    (first,) = permitted(core, work)
    made.receive(first)
    assert first.steps.tolist() == [5, 5]
    assert roll_out(whole()) == [5, 0]
    core.receive(task_spec(source='sim_2'))  # the commit decides, not who is heard when
    assert roll_out(whole(sequence=1, phase=1, episode=1)) == [5, 0]
    made.receive(task_spec(source='sim_2'))
    assert roll_out(whole(sequence=2, phase=2, episode=2)) == [5, 5]


def simulator(name='sim_2'):
    settings = SETTINGS.changed({'warmup_steps': 40, 'delay': 5})
    made = Simulator(run(settings), settings, name)
    return made, made.work()


def test_a_simulator_that_was_left_out_announces_itself_and_goes_on_behind_what_was_voided():
    before, work = simulator()
    before.receive(permission(steps=(3, 3)))
    records = slices(work)
    numbers = np.array([0, 0], np.int64)
    kept = commit(sources=BOTH, transitions=numbers, scorers=BOTH, scores=np.array([0, 0]))
    out = commit(
        phase=1,
        sources=BOTH,
        transitions=np.array([1, 40], np.int64),
        scorers=BOTH,
        scores=np.array([1, 50]),
        dropped=('sim_2',),
    )
    dropped = transitions(source='sim_2', sequence=4, phase=1, first_step=5)
    before.receive(permission(1))
    slices(work)  # it goes on, but nothing of that arrives in time
    before.receive(permission(2, (5, 0)))
    assert [type(record) for record in slices(work)] == [TaskSpec]
    assert not before.displaced
    before.receive(permission(3))
    assert before.displaced
    assert slices(work) == []
    before.begin_anew()
    for record in undropped([*records, kept, dropped, out]):
        before.restore(record)
    before.resume(3)
    chunk, *_ = [record for record in slices(work) if isinstance(record, Transitions)]
    assert (chunk.sequence, chunk.phase, chunk.episode, chunk.first_step) == (41, 3, 0, 3)
    np.testing.assert_array_equal(chunk.observations[0], records[1].observations[-1])
    assert before.report().counters['phases left out'] == 1


def test_a_simulator_that_begins_late_passes_over_what_is_committed():
    made, work = simulator()
    made.resume(0)
    made.receive(permission(2))
    slices(work)
    assert made.displaced  # what was recorded may have been voided meanwhile
    made.begin_anew()
    made.resume(2)
    found = [record for record in slices(work) if isinstance(record, Transitions)]
    assert [chunk.phase for chunk in found] == [2]


def test_a_share_of_nothing_is_not_being_left_out():
    small = SETTINGS.changed({'steps': 1, 'phase_steps': 1})
    assert not is_left_out(small, permission(0, (1, 0)), ['sim_2'])
    assert is_left_out(SETTINGS, permission(0, (10, 0)), ['sim_2'])
