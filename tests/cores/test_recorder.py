"""A phase is committed when it is whole, not before, and names exactly what belongs to it."""

import numpy as np
import pytest

from codetr_ros.cores.recorder import Recorder
from codetr_ros.records import Commit, RecordError
from codetr_ros.records.digests import digest
from helpers.builders import policy, run, score, step_rewards, task_spec, tiny, transitions


def recorder(**changes) -> Recorder:
    settings = tiny(**changes)
    made = Recorder(run(settings), settings, 'record')
    made.receive(task_spec())
    return made


def commits(made: Recorder, work) -> list[Commit]:
    found = []
    while (out := next(work)) is not None:
        found += [r for r in out if isinstance(r, Commit)]
    return found


def test_a_phase_is_committed_only_with_all_its_steps_and_all_due_scores():
    r = recorder()
    work = r.work()
    r.receive(transitions(steps=199))  # even what outruns the permission
    r.receive(policy())
    assert commits(r, work) == []
    r.receive(transitions(sequence=1, first_step=199, steps=1, phase_end=True, scores_due=2))
    assert commits(r, work) == []
    assert r.waiting_for() == "the rest of phase 0: 2 composite rewards of 'sim'"
    r.receive(score())
    assert commits(r, work) == []
    r.receive(score(sequence=1, first_step=7))
    (made,) = commits(r, work)
    assert (made.phase, made.sources, made.transitions.tolist()) == (0, ('sim',), [1])
    assert (made.scorers, made.scores.tolist()) == (('sim',), [1])


def test_scores_of_the_next_phase_that_came_early_are_left_to_it():
    r = recorder()
    work = r.work()
    r.receive(policy())
    r.receive(policy(phase=1))
    r.receive(transitions(steps=200, phase_end=True, scores_due=1))
    r.receive(score())
    r.receive(score(sequence=1, first_step=7))
    (made,) = commits(r, work)
    assert made.scores.tolist() == [0]
    r.receive(
        transitions(sequence=1, phase=1, first_step=200, steps=200, phase_end=True, scores_due=1)
    )
    (made,) = commits(r, work)
    assert (made.phase, made.scores.tolist()) == (1, [1])


def test_what_is_out_of_sequence_is_refused_naming_what_is_due():
    r = recorder()
    r.receive(transitions())
    with pytest.raises(
        RecordError, match=r"sequence=2.* is out of sequence: 1 is the next of 'sim'"
    ):
        r.receive(transitions(sequence=2, first_step=5))
    with pytest.raises(RecordError, match='out of sequence: 0 is the next'):
        r.receive(score(sequence=3))


def test_what_arrives_twice_is_counted_once():
    r = recorder()
    r.receive(transitions())
    r.receive(transitions())
    assert r.report().duplicated == {'transitions': 1}


def test_every_simulator_must_have_ended_its_share():
    r = recorder(simulators=2, phase_steps=10)
    r.receive(task_spec(source='two'))
    work = r.work()
    r.receive(policy(sources=('sim', 'two'), steps=np.array([5, 5], np.uint32)))
    r.receive(transitions(phase_end=True))
    assert commits(r, work) == []
    assert r.waiting_for() == "the rest of phase 0: 5 of 5 steps of 'two'"
    r.receive(transitions(source='two', phase_end=True))
    (made,) = commits(r, work)
    assert made.sources == ('sim', 'two') and made.scorers == ()


def test_steps_of_another_run_or_source_or_with_nan_are_refused():
    r = recorder()
    for wrong, said in (
        (policy(steps=np.array([7], np.uint32)), 'permits 7 steps; .* phase 0 has 200'),
        (transitions(run_id='other'), "of run 'other'"),
        (transitions(source='stranger'), 'no simulator of this run'),
        (
            transitions(observations=np.full((6, 3), np.nan, np.float32)),
            r'observations\[0, 0\] is nan',
        ),
    ):
        with pytest.raises(RecordError, match=said):
            r.receive(wrong)
    r.receive(transitions())  # still the first


def test_steps_that_come_before_their_announcement_are_checked_when_it_has_come():
    """They travel on different topics: which comes first is not promised."""
    settings = tiny()
    r = Recorder(run(settings), settings, 'record')
    nan = np.full((6, 3), np.nan, np.float32)
    r.receive(transitions(observations=nan))
    r.receive(transitions())
    r.receive(transitions(sequence=1, first_step=5))
    assert r.report().duplicated == {}
    r.receive(task_spec())
    assert r.report().refused == {'transitions': 1}
    assert r.report().duplicated == {}
    with pytest.raises(RecordError, match='2 is the next'):
        r.receive(transitions(sequence=5))


def test_a_phase_of_a_free_robot_is_committed_without_a_permission_once_it_is_whole():
    r = recorder(task='robot/arm', pace='free', evaluate_every=0)
    work = r.work()
    r.receive(transitions(steps=199))
    assert commits(r, work) == []
    assert r.waiting_for() == "the rest of phase 0: 1 of 200 steps of 'sim'"
    r.receive(transitions(sequence=1, first_step=199, steps=1, phase_end=True))
    (made,) = commits(r, work)
    assert (made.phase, made.transitions.tolist(), made.scorers) == (0, [1], ())


def test_scores_that_a_robot_gives_itself_join_the_next_commit_like_those_of_anybody():
    r = recorder(task='robot/arm', pace='free', evaluate_every=0, scorer='topic')
    work = r.work()
    given = [score(sequence=n, scorer='sim', first_step=5 * n) for n in range(2)]
    for phase, late in enumerate(given):
        r.receive(late)
        steps = {'first_step': 200 * phase, 'steps': 200, 'phase_end': True}
        r.receive(transitions(sequence=phase, phase=phase, **steps))
        (made,) = commits(r, work)
        assert (made.scorers, made.scores.tolist()) == (('sim',), [phase])


def test_labels_of_a_free_run_that_overtake_those_of_a_phase_before_come_early():
    """A recorder that was killed gets the newest at once, and has to ask for those before."""
    warmup = {'warmup_steps': 400}  # two phases: nobody labels the first
    r = recorder(task='robot/arm', pace='free', evaluate_every=0, scorer='topic', **warmup)
    work = r.work()
    made = []
    for phase in range(3):
        steps = {'first_step': 200 * phase, 'steps': 200, 'phase_end': True}
        r.receive(transitions(sequence=phase, phase=phase, **steps))
        made += commits(r, work)
    first, second = (step_rewards(phase=n, commit=digest(made[n])) for n in (1, 2))
    assert r.comes_early(second) and not r.comes_early(first)
    r.receive(first)
    assert not r.comes_early(second)


def test_policies_that_overtake_those_of_phases_before_come_early_until_they_have_come():
    r = recorder(overlap=True)
    first, second = policy(phase=0), policy(phase=1)
    assert r.comes_early(second) and not r.comes_early(first)
    r.receive(first)
    assert not r.comes_early(second) and r.still_due(second)
    r.receive(second)
    assert not r.still_due(second)


def test_parts_of_labels_that_overtake_those_before_come_early_until_they_have_come():
    r = recorder(warmup_steps=200)
    work = r.work()
    r.receive(policy())
    r.receive(transitions(steps=200, phase_end=True, scores_due=0))
    (made,) = commits(r, work)
    first, second = (
        step_rewards(phase=0, part=part, parts=2, commit=digest(made)) for part in range(2)
    )
    assert r.comes_early(second) and not r.comes_early(first)
    r.receive(first)
    assert not r.comes_early(second) and r.still_due(second)
    r.receive(second)
    assert not r.still_due(second)


def test_a_free_robot_may_be_phases_ahead_of_the_permission_that_arrives():
    r = recorder(task='robot/arm', pace='free', evaluate_every=0)
    work = r.work()
    r.receive(transitions(steps=200, phase_end=True))
    assert [made.phase for made in commits(r, work)] == [0]
    r.receive(policy(phase=0))  # of a phase that is committed already
    r.receive(transitions(sequence=1, phase=1, first_step=200, steps=200, phase_end=True))
    assert [made.phase for made in commits(r, work)] == [1]
