"""Well-formed lies about commits, records and labels change nothing, and are refused with the
reason.
"""

from dataclasses import replace

import numpy as np
import pytest

from codetr_ros.cores import in_process
from codetr_ros.cores.commits import MOST_HELD
from codetr_ros.cores.intake import Intake
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import Commit, RecordError, StepRewards, Transitions
from codetr_ros.records.chain import Chain
from codetr_ros.records.digests import digest
from helpers.builders import (
    ACTION,
    OBSERVATION,
    commit,
    run,
    score,
    step_rewards,
    task_spec,
    tiny,
    transitions,
)
from helpers.commits import STEPS, chunk, committed

NOTHING = {
    'sources': (), 'transitions': np.empty(0, np.int64),
    'scorers': (), 'scores': np.empty(0, np.int64),
}  # fmt: skip
MADE_UP = 'ab' * 32


def intake(permitted=2) -> tuple[Intake, Trajectories]:
    settings = tiny(**STEPS)
    made = Intake(run(settings), settings, scores=True, permitted=lambda: permitted)
    made.receive(task_spec())
    return made, Trajectories(OBSERVATION, ACTION, 7, 1000, 1000)


def part_of_a_phase() -> list[Transitions]:
    """Two steps of the five of phase 0."""
    return [transitions(steps=2, observations=transitions().observations[:3])]


LIES = {
    'an empty one': (commit(**NOTHING), 'names no sources, and every phase has steps'),
    'one of a phase beyond what is permitted': (
        committed(chunk(1), phase=1), 'phase 0 is the newest that can have been permitted',
    ),
    'one of sources that were not permitted': (
        committed(chunk(source='stranger')), r"names sources=\['stranger'\].* permitted were",
    ),
    'one that drops everybody': (
        replace(committed(chunk()), dropped=('sim',)), r"dropped=\['sim'\], permitted were",
    ),
    'one that follows on another': (
        committed(chunk(), previous=MADE_UP), 'follows on the commit .abab.*second recorder',
    ),
    'one without digests': (commit(), 'states no digests: install the same version'),
}  # fmt: skip


@pytest.mark.parametrize('lie', LIES)
def test_a_commit_that_cannot_be_is_refused_at_the_door_and_changes_nothing(lie):
    (it, memory), (record, said) = intake(permitted=0), LIES[lie]
    with pytest.raises(RecordError, match=said):
        it.receive(record)
    assert not it.take(0, memory) and it.missing is None
    for each in (chunk(), committed(chunk())):
        it.receive(each)
    assert it.take(0, memory) and memory.steps == 5


def test_a_commit_of_less_than_was_permitted_is_refused_even_with_the_right_digests(caplog):
    it, memory = intake()
    steps = part_of_a_phase()
    for each in (*steps, committed(*steps)):
        it.receive(each)
    assert not it.take(0, memory) and it.refused == {'commits': 1} and it.missing is None
    assert "names 2 steps of 'sim', of 5 that were permitted" in caplog.text
    rest = transitions(
        sequence=1, first_step=2, steps=3, observations=transitions().observations[2:],
        phase_end=True,
    )  # fmt: skip
    for each in (rest, committed(*steps, rest)):
        it.receive(each)
    assert it.take(0, memory) and memory.steps == 5


def test_a_commit_of_a_phase_whose_end_nobody_has_marked_is_refused_by_that_reason(caplog):
    it, memory = intake()
    steps = chunk(phase_end=False)
    for each in (steps, committed(steps)):
        it.receive(each)
    assert not it.take(0, memory) and it.refused == {'commits': 1}
    assert "names all 5 steps of 'sim', of which the last must have phase_end" in caplog.text
    assert 'these chunks have it: none' in caplog.text


def test_a_commit_that_leaves_out_scores_that_are_due_is_refused(caplog):
    it, memory = intake()
    steps, due = chunk(scores_due=1), score(length=5)
    for each in (steps, due, committed(steps), committed(steps, due)):
        it.receive(each)
    assert it.take(0, memory) and it.refused == {'commits': 1, 'composite_rewards': 1}
    assert "names 0 new scores of 'sim', of 1 that are due" in caplog.text


@pytest.mark.parametrize('first', ['the lie', 'the truth'])
def test_of_two_commits_the_one_whose_digests_the_records_have_is_taken(first, caplog):
    it, memory = intake()
    truth = committed(chunk())
    lie = replace(truth, transition_digests=(MADE_UP,))
    for each in (lie, truth) if first == 'the lie' else (truth, lie):
        it.receive(each)
    it.receive(chunk())
    assert it.take(0, memory) and memory.steps == 5
    assert it.refused == {'commits': 1} and it.commits.digest(0) == digest(truth)
    assert 'is not the one whose digests the records have' in caplog.text
    with pytest.raises(RecordError, match='another commit of phase 0 than the one that was'):
        it.receive(lie)
    following = committed(chunk(1), before=[truth])
    for each in (chunk(1), following):
        it.receive(each)
    assert it.take(1, memory), 'and the next one follows on the true one'


def test_of_a_flood_of_commits_few_are_held_and_the_true_one_is_asked_for():
    it, memory = intake()
    it.receive(chunk())
    it.receive(committed(chunk()))
    for n in range(1000):
        it.receive(replace(committed(chunk()), score_digests=(), transition_digests=(str(n),)))
    assert len(it.commits.of(0)) == MOST_HELD and it.refused == {'commits': 1001 - MOST_HELD}
    assert not it.take(0, memory) and it.missing == 0
    it.receive(committed(chunk()))  # as fetched from the recorder
    assert it.take(0, memory)


def test_a_commit_before_its_turn_is_refused_and_the_one_before_it_asked_for():
    it, memory = intake()
    first = committed(chunk())
    second = committed(chunk(1), before=[first])
    for each in (chunk(), chunk(1)):
        it.receive(each)
    with pytest.raises(RecordError, match='comes before that of phase 0, which is asked for'):
        it.receive(second)
    assert not it.take(0, memory) and it.missing == 0
    it.receive(first)  # as fetched from the recorder
    assert it.missing is None and it.take(0, memory)
    assert not it.take(1, memory) and it.missing == 1, 'and then the one that was refused'
    it.receive(second)
    assert it.take(1, memory) and it.missing is None


def lying(**changes) -> Transitions:
    """Steps that are as good as the true ones, and not the same."""
    return chunk(observations=transitions().observations + np.float32(1), **changes)


def test_steps_that_differ_from_their_commit_are_fetched_and_replaced(caplog):
    it, memory = intake()
    it.receive(lying())
    it.receive(committed(chunk()))
    assert not it.take(0, memory) and it.missing == 0 and memory.steps == 0
    assert "transitions 0 to 0 of 'sim' have the digest" in it.doubt
    it.receive(chunk())  # as the recorder sends them again
    it.fetched(0)
    assert it.take(0, memory) and it.missing is None and it.doubt == ''
    got = memory.store.by_name()[0].windows(np.array([0]), np.array([5]), 5)[0]
    np.testing.assert_array_equal(got[0], chunk().observations)
    assert "1 records of 'sim' were not those that the recorder has" in caplog.text


def test_scores_that_differ_from_their_commit_are_fetched_and_replaced():
    it, memory = intake()
    steps, true = chunk(scores_due=1), score(length=5)
    it.receive(steps)
    it.receive(replace(true, value=9.0))
    it.receive(committed(steps, true))
    assert not it.take(0, memory)
    assert it.doubt.startswith("composite_rewards 0 to 0 of 'sim' have the digest")
    it.receive(true)
    assert it.take(0, memory)


def test_the_run_stops_if_what_is_fetched_differs_too_and_names_the_source():
    it, memory = intake()
    it.receive(chunk())
    it.receive(committed(lying()))
    assert not it.take(0, memory)
    it.receive(chunk())  # the recorder's own: the same as here
    it.fetched(0)
    said = (
        r'phase 0 was sent again by the recorder, and its commit cannot be right: transitions 0 '
        r"to 0 of 'sim' have the digest \w{12} here; the commit states \w{12}. Nothing was learnt"
    )
    with pytest.raises(RecordError, match=said):
        it.take(0, memory)
    assert memory.steps == 0


def test_a_policy_that_was_not_permitted_stops_the_run_once_it_is_certain():
    it, memory = intake()
    it.policies[0] = 'cd' * 32
    it.receive(chunk())
    it.receive(committed(chunk(), policy_digest=MADE_UP))
    assert not it.take(0, memory) and it.missing == 0
    it.fetched(0)
    with pytest.raises(RecordError, match='the policy that permitted phase 0 has the digest cdcd'):
        it.take(0, memory)


def test_labels_that_were_not_published_stop_the_run_once_it_is_certain():
    it, memory = intake()
    first = committed(chunk())
    for each in (chunk(), first):
        it.receive(each)
    assert it.take(0, memory)
    it.labels[0] = 'cd' * 32
    it.receive(chunk(1))
    it.receive(committed(chunk(1), before=[first], labels_digest=MADE_UP))
    assert not it.take(1, memory) and 'the labels of phase 0 has the digest cdcd' in it.doubt
    it.fetched(1)
    with pytest.raises(RecordError, match='its commit cannot be right: the labels of phase 0'):
        it.take(1, memory)


def test_another_record_of_a_number_that_is_held_is_refused():
    it, _ = intake()
    it.receive(chunk())
    with pytest.raises(RecordError, match="has the number of another record.*of 'sim', restart"):
        it.receive(lying())
    assert it.duplicated == {}


# ------------------------------------------------------------------------------------------------
# whole runs


def lies_of(real, chain, phase, run_id):
    """What somebody can send who reads every topic: early, empty and partial commits, commits that
    state digests of what has come so far, and labels of this phase and the next.
    """
    sources = [real.source]
    partial = commit(
        run_id=run_id,
        phase=phase,
        sources=tuple(sources),
        transitions=np.array([real.sequence], np.int64),
        scorers=(),
        scores=np.empty(0, np.int64),
    )
    empty = [commit(run_id=run_id, phase=n, **NOTHING) for n in (phase, phase + 1)]
    made_up = [replace(chain.completed(partial), previous=p) for p in ('', MADE_UP, chain.last)]
    labels = [
        step_rewards(run_id=run_id, phase=n, commit=made_of)
        for n in (phase, phase + 1, phase + 9)
        for made_of in ('', MADE_UP, chain.last)
    ]
    return [*empty, partial, *made_up, *labels]


@pytest.mark.parametrize('changes', [{}, {'overlap': True}, {'method': 'hc'}])
def test_whoever_lies_about_commits_and_labels_changes_no_weight(changes):
    quick = {'evaluate_every': 0, 'sac__updates_per_step': 0.1, 'hc__width': 6, 'hc__segments': 4}
    settings = tiny(steps=800, method='ircr', **quick).changed(changes)
    refused = []

    def intrude(cores):
        """Tell every core lies before each record that it gets."""
        for _, core in cores.values():
            chain, receive = Chain(settings.lag), core.receive

            def taking(record, core=core, chain=chain, receive=receive):
                chain.note(record)
                for lie in (
                    lies_of(record, chain, record.phase, 'run')
                    if isinstance(record, Transitions)
                    else ()
                ):
                    if type(lie) in core.subscribes:
                        try:
                            receive(lie)
                        except RecordError as error:
                            refused.append(str(error))
                if isinstance(record, Commit):
                    chain.follow(record)
                receive(record)

            core.receive = taking

    expected = in_process.run(settings, 'run')
    reports = in_process.run(settings, 'run', attend=intrude)
    assert reports['learner'].policy_sha256 == expected['learner'].policy_sha256
    if 'reward' in expected:
        ours, theirs = (r['reward'].reward_model_sha256 for r in (reports, expected))
        assert ours == theirs
    assert any('names no sources' in text for text in refused)
    late = sum(reports['learner'].refused.values())
    assert late, 'what could not be refused at once was refused later'
    if settings.labels_steps:
        assert any('is the next to be committed' in text for text in refused)


def test_labels_that_are_made_of_another_commit_are_refused_and_the_true_ones_taken():
    """The attack: labels of a coming phase, complete, before the reward node has made its own."""
    settings = tiny(method='ircr', steps=600)
    reports = in_process.run(settings, 'run')

    def intrude(cores):
        _, learner = cores['learner']
        receive = learner.receive

        def taking(record):
            receive(record)
            if isinstance(record, Transitions) and record.phase == 2:
                with pytest.raises(RecordError, match='is the newest that is permitted'):
                    receive(step_rewards(phase=9, commit=MADE_UP))
                learner._labels.forget(2)  # each time anew, as if it were the first
                receive(step_rewards(phase=2, commit=MADE_UP))
            if isinstance(record, StepRewards) and record.phase == 1:
                with pytest.raises(RecordError, match='was made of the commit .abab'):
                    receive(step_rewards(phase=1, commit=MADE_UP))

        learner.receive = taking

    again = in_process.run(settings, 'run', attend=intrude)
    assert again['learner'].policy_sha256 == reports['learner'].policy_sha256
    assert again['learner'].refused == {'step_rewards': 1}
