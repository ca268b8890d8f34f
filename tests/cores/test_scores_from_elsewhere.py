"""Runs whose scores come from another than the simulator: late, several for a segment, or none."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from codetr_ros.bags.errors import BagError
from codetr_ros.cores import in_process, taking_up
from codetr_ros.cores.labeller import Labeller
from codetr_ros.cores.people import SimulatedPeople
from codetr_ros.cores.recorder import Recorder
from codetr_ros.records import (
    Commit,
    CompositeReward,
    Metrics,
    Preference,
    RecordError,
    ScoreRequest,
    StepRewards,
    Transitions,
)
from codetr_ros.records.chain import Chain
from helpers.builders import commit, policy, run, score, task_spec, tiny, transitions
from helpers.cores import slices

PEOPLE = {
    'scorer': 'simulated',
    'task': 'InvertedPendulum-v5',
    'delay': 10,
    'people__late': 20,
}
METHODS = ['codetr', 'none', 'rbt', 'rrd', 'ircr', 'diaster', 'lrr', 'mil_lstm', 'mlp']
METHODS += ['aggregate', 'evidence', 'uniform', 'random', 'hc']


def records_of(settings):
    """All records of a run in process, and the reports of its parts."""
    records = []
    return records, in_process.run(settings, 'run', None, records.append)


def of(kind, records):
    return [record for record in records if isinstance(record, kind)]


@pytest.mark.parametrize('method', METHODS)
def test_every_method_learns_from_the_scores_that_come_and_minds_none_that_does_not(method):
    records, reports = records_of(tiny(method=method, steps=800, **PEOPLE))
    committed = of(Commit, records)[-1]
    named = dict(zip(committed.scorers, committed.scores.tolist(), strict=True))
    if method == 'hc':  # no reward node asks for scores: nobody gives any
        assert named == {}
        return
    assert 0 < named['person'] < len(of(CompositeReward, records))
    labelled = of(StepRewards, records)
    scored = len({(s.source, s.episode, s.first_step) for s in of(CompositeReward, records)})
    assert sum(len(part.lengths) for part in labelled[-1:]) > scored  # those without a score too
    assert all(np.isfinite(part.labels).all() for part in labelled)
    assert reports['reward'].refused == {}


def test_a_simulator_gives_no_score_where_another_scores_and_owes_none():
    records, reports = records_of(tiny(**PEOPLE | {'scorer': 'topic'}, steps=600))
    assert of(CompositeReward, records) == []
    assert {chunk.scores_due for chunk in of(Transitions, records)} == {0}
    assert reports['sim'].counters['scores'] == 0
    skipped = [name for name in reports['learner'].counters if name.startswith('updates skipped')]
    assert skipped  # counted, and no error: nothing is learnt without a score


def test_the_run_waits_for_nobody_and_takes_a_late_score_into_a_later_commit():
    records, _ = records_of(tiny(**PEOPLE | {'people__late': 150, 'people__skipped': 0.0}))
    asked = {
        (s, e, f): request.phase
        for request in of(ScoreRequest, records)
        for s, e, f in zip(
            request.sources,
            request.episodes.tolist(),
            request.first_steps.tolist(),
            strict=True,
        )
    }
    taken, last = {}, -1
    given = of(CompositeReward, records)
    for each in of(Commit, records):
        named = dict(zip(each.scorers, each.scores.tolist(), strict=True)).get('person', -1)
        taken |= dict.fromkeys(range(last + 1, named + 1), each.phase)
        last = named
    late = [
        taken[each.sequence] - asked[each.source, each.episode, each.first_step]
        for each in given
        if each.sequence in taken
    ]
    assert len(late) > 20
    assert set(late) == {1}  # 150 of 200 steps of the phase after the one that asked
    assert [c.phase for c in of(Commit, records)] == list(range(6))


def test_the_same_seed_makes_the_same_run_with_people_too():
    (first, _), (second, _) = records_of(tiny(**PEOPLE)), records_of(tiny(**PEOPLE))
    labels = [
        [part.labels.tobytes() for part in of(StepRewards, each)] for each in (first, second)
    ]
    assert labels[0] == labels[1] and any(labels[0])


def test_what_is_asked_for_is_worth_most_first_and_was_not_judged_before():
    records, _ = records_of(tiny(method='evidence', **PEOPLE))
    given, committed, known = set(), set(), 0
    for record in records:
        if isinstance(record, CompositeReward):
            given.add((record.source, record.episode, record.first_step))
        elif isinstance(record, Commit):
            committed = set(given)
        elif isinstance(record, ScoreRequest):
            firsts = zip(record.episodes.tolist(), record.first_steps.tolist(), strict=True)
            assert not committed & {('sim', *first) for first in firsts}
            if not np.isnan(record.worths).any():
                known += 1
                assert all(a >= b - 1e-6 for a, b in pairwise(record.worths.tolist()))
    assert known >= 3


# ----------------------------------------------------------------------------------------------
# the recorder


def recorder(**changes):
    settings = tiny(scorer='topic', **changes)
    core = Recorder(run(settings), settings, 'record')
    work = core.work()
    core.receive(task_spec())
    core.receive(policy())
    return core, work


def judged(n, scorer='me', **changes):
    return score(scorer=scorer, sequence=n, **changes)


def end_phase(core, phase=0):
    core.receive(transitions(sequence=phase, phase=phase, steps=200, phase_end=True))


def preference(**changes):
    first = {'source': 'sim', 'episode': 0, 'first_step': 0, 'length': 7}
    second = {f'other_{name}': value for name, value in first.items()} | {'other_first_step': 7}
    made = Preference(run_id='run', scorer='me', sequence=0, outcome=1.0, **first, **second)
    return replace(made, **changes)


def test_a_commit_names_scores_and_preferences_of_a_scorer_by_one_sequence_of_numbers():
    core, work = recorder()
    core.receive(judged(0))
    core.receive(preference(sequence=1))
    core.receive(judged(2, first_step=7))
    end_phase(core)
    made = of(Commit, slices(work))[0]
    assert (made.scorers, made.scores.tolist()) == (('me',), [2])


def test_what_overtakes_an_earlier_judgement_on_the_other_topic_waits_for_it(caplog):
    core, work = recorder()
    core.receive(preference(sequence=1))
    assert 'waits for number 0' in caplog.text
    end_phase(core)
    assert of(Commit, slices(work))[0].scorers == ()
    assert core.report().counters['judgements after a gap'] == 1
    core.receive(judged(0))
    assert core.report().counters['judgements after the last commit'] == 2


def test_who_gives_more_judgements_than_queues_hold_is_refused_by_name():
    core, _ = recorder()
    with pytest.raises(RecordError, match="'me', and a scorer may give 400 judgements"):
        core.receive(judged(400))


def test_a_preference_is_refused_where_the_simulator_scores():
    settings = tiny()
    core = Recorder(run(settings), settings, 'record')
    with pytest.raises(RecordError, match='the simulator scores in this run.*scorer=topic'):
        core.receive(preference())


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'outcome': 0.7}, 'outcome is 0.7: must be 1'),
        ({'other_length': 8}, 'other_length is 8: a segment has 1 to 7 steps'),
        ({'other_first_step': 0}, 'compares a segment with itself'),
    ],
)
def test_an_impossible_preference_is_refused(changes, reason):
    core, _ = recorder()
    with pytest.raises(RecordError, match=reason):
        core.receive(preference(**changes))


# ----------------------------------------------------------------------------------------------
# the reward side


class Reward:
    """The reward side of a run that others score, driven by hand."""

    def __init__(self, **changes):
        self.settings = tiny(scorer='topic', method='uniform', warmup_steps=200, **changes)
        self.core = Labeller(run(self.settings), self.settings, 'reward', None)
        self.work = self.core.work()
        self.core.receive(task_spec(horizon=1000))
        self.given = {}
        self.chain = Chain(self.settings.lag)
        self.last = None

    def judge(self, *judgements):
        for each in judgements:
            self.given[each.scorer] = each.sequence
            self.chain.note(each)
            self.core.receive(each)

    def phase(self, phase):
        """Ends a phase, whose commit names all that was given before."""
        chunk = transitions(
            sequence=phase, phase=phase, first_step=200 * phase, steps=200, phase_end=True
        )
        if self.last is not None:
            chunk.observations[0] = self.last.observations[-1]
        self.last = chunk
        self.core.receive(chunk)
        names = tuple(sorted(self.given))
        last = np.array([self.given[name] for name in names], np.int64)
        number = np.array([phase], np.int64)
        self.chain.note(chunk)
        made = commit(phase=phase, transitions=number, scorers=names, scores=last)
        before = self.core._settings.labels_named(phase)
        labels = self.core._intake.labels.get(before, '')
        made = replace(self.chain.completed(made), labels_digest=labels)
        self.chain.follow(made)
        self.core.receive(made)
        return slices(self.work)

    @property
    def memory(self):
        return self.core._memory


def values(reward):
    segments = reward.memory.segments
    return {
        int(first): value
        for (_, _, firsts, _) in segments.spans(segments.ids())
        for first, value in zip(firsts, segments.scores(segments.ids()).tolist(), strict=True)
    }


def test_a_later_score_of_the_same_scorer_replaces_the_former_and_nan_withdraws_it():
    reward = Reward()
    reward.judge(*(judged(n, first_step=7 * n, value=float(n)) for n in range(5)))
    reward.phase(0)
    assert values(reward) == {0: 0.0, 7: 1.0, 14: 2.0, 21: 3.0, 28: 4.0}
    reward.judge(judged(5, first_step=7, value=9.0), judged(6, first_step=14, value=np.nan))
    reward.phase(1)
    assert values(reward) == {0: 0.0, 7: 9.0, 21: 3.0, 28: 4.0}
    assert dict(reward.memory.judgements.counts) == {'corrections': 2, 'cannot tell': 1}


def test_a_segment_is_labelled_again_when_its_score_has_come():
    reward = Reward()
    reward.judge(*(judged(n, first_step=7 * n, value=7.0) for n in range(4)))
    labels = of(StepRewards, reward.phase(0))[0]
    assert len(labels.lengths) == 28  # of 200 steps: all whole segments, scored or not
    np.testing.assert_allclose(labels.labels, 1.0)  # in units of c: 1 per step
    reward.judge(judged(4, first_step=70, value=21.0))
    again = of(StepRewards, reward.phase(1))[0]
    at = [int(first) for first in again.first_steps].index(70)
    np.testing.assert_allclose(again.labels[7 * at : 7 * at + 7], 3.0)


def test_a_score_of_steps_that_are_not_committed_yet_waits_for_them():
    reward = Reward()
    reward.judge(*(judged(n, first_step=7 * n) for n in range(4)))
    reward.judge(judged(4, first_step=203, value=5.0))  # steps of the next phase
    reward.phase(0)
    assert 203 not in values(reward)
    reward.phase(1)
    assert values(reward)[203] == 5.0
    assert not reward.core.refused


def test_a_score_of_no_segment_is_refused_and_counted_and_the_rest_goes_on(caplog):
    reward = Reward()
    reward.judge(judged(0, first_step=3), judged(1, source='nobody'))
    reward.judge(*(judged(2 + n, first_step=7 * n) for n in range(4)))
    for phase in range(4):
        reward.phase(phase)
    assert reward.core.refused == {'composite_rewards': 2}
    assert 'steps 3 to 9: there is no such segment' in caplog.text
    assert "judges 'nobody', episode 0" in caplog.text
    assert len(values(reward)) == 4


def test_nothing_is_learnt_from_the_first_three_scores_since_their_scale_would_be_frozen():
    reward = Reward()
    reward.judge(*(judged(n, first_step=7 * n) for n in range(3)))
    assert of(StepRewards, reward.phase(0))[0].labels.size == 0
    reward.judge(judged(3, first_step=21))
    assert of(StepRewards, reward.phase(1))[0].labels.size > 0


def test_preferences_that_a_method_cannot_use_are_counted(caplog):
    reward = Reward()
    reward.judge(*(judged(n, first_step=7 * n) for n in range(4)))
    reward.judge(preference(sequence=4))
    reward.phase(0)
    assert reward.core.report().counters['preferences not used, method cannot'] == 1
    assert 'preferences not used, method cannot (1 so far)' in caplog.text


def test_who_scored_and_on_what_scale_is_published_after_each_phase():
    reward = Reward()
    for name, offset, slope in (('ann', 0.0, 1.0), ('ben', 50.0, 10.0)):
        reward.judge(
            *(judged(n, name, first_step=7 * n, value=offset + slope * (n % 5)) for n in range(20))
        )
    metrics = of(Metrics, reward.phase(0))[0]
    known = dict(zip(metrics.names, metrics.values.tolist(), strict=True))
    assert known['scorer_ann_scores'] == known['scorer_ben_scores'] == 20
    assert known['segments_scored'] == 20
    assert known['scorer_ann_slope'] == 1
    assert known['scorer_ben_slope'] == pytest.approx(10, rel=0.05)
    assert known['scorer_ben_offset'] == pytest.approx(50, rel=0.05)
    assert known['scorer_ben_agreement'] == pytest.approx(1)


# ----------------------------------------------------------------------------------------------
# simulated people


def test_simulated_people_leave_out_err_and_are_late_as_often_as_the_settings_state():
    settings = tiny(
        **PEOPLE | {'people__late': 50, 'people__skipped': 0.2, 'people__wrong': 0.1},
        steps=3000,
        requests=15,
        memory_steps=3000,
    )
    records, reports = records_of(settings)
    counts = reports['score'].counters
    asked = sum(len(r.sources) for r in of(ScoreRequest, records)[:-1])
    scores = counts['scores']
    assert counts['segments left out'] / asked == pytest.approx(0.2, abs=0.07)
    assert counts['wrong judgements'] / scores == pytest.approx(0.1, abs=0.07)
    assert {r.value for r in of(CompositeReward, records)} <= {1.0, 2.0, 3.0, 4.0, 5.0}


def test_simulated_people_stop_after_the_judgements_that_they_have():
    records, reports = records_of(tiny(**PEOPLE, people__judgements=12))
    assert len(of(CompositeReward, records)) == 12
    assert reports['score'].counters['segments not judged, no judgement was left'] > 0


def test_several_simulated_people_have_names_and_scales_of_their_own():
    records, _ = records_of(tiny(**PEOPLE, people__count=3, people__points=3))
    by_name = {}
    for each in of(CompositeReward, records):
        by_name.setdefault(each.scorer, set()).add(each.value)
    assert set(by_name) == {'person_a', 'person_b', 'person_c'}
    assert by_name['person_a'] <= {1.0, 2.0, 3.0}
    assert by_name['person_c'] <= {-1.0, 0.0, 1.0, 2.0, 3.0}


def test_simulated_people_compare_if_asked_to():
    settings = tiny(**PEOPLE | {'people__preferences': 0.5, 'people__wrong': 0.0})
    records, _ = records_of(settings)
    preferences = of(Preference, records)
    assert len(preferences) > 5 and len(of(CompositeReward, records)) > 5
    numbers = sorted(r.sequence for r in records if isinstance(r, (Preference, CompositeReward)))
    assert numbers == list(range(len(numbers)))
    assert {p.outcome for p in preferences} <= {0.0, 0.5, 1.0}


def test_people_of_another_run_are_not_listened_to():
    settings = tiny(**PEOPLE)
    people = SimulatedPeople(run(settings), settings)
    with pytest.raises(RecordError, match="is of run 'other'"):
        people.receive(transitions(run_id='other'))


def test_a_run_of_simulated_people_is_not_gone_on_with_in_process(tmp_path):
    with pytest.raises(BagError, match='simulated people do not remember'):
        taking_up.prepare(tiny(**PEOPLE), 'run', tmp_path)
