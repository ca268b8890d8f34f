"""Several scorers at desks of their own: who gets one, what it is asked and what is refused."""

import math

import numpy as np
import pytest

from codetr_ros.cores.desks import ASKS_WITHIN, MOST_SCORERS, MOST_STEPS, Desks
from codetr_ros.cores.scoring import ScoringError
from helpers.builders import commit, run, score_request, tiny, transitions

SETTINGS = tiny(scorer='topic')  # segments of 7 steps
ANY = (0.0, 0.0)


def some_desks(settings=SETTINGS, steps=70, **chunk):
    desks = Desks(run(settings), settings)
    desks.receive(transitions(steps=steps, **chunk))
    return desks


def published(desks):
    return [
        (r.scorer, r.sequence, r.first_step, r.length, r.value) for r in next(desks.work()) or ()
    ]


def test_each_scorer_is_numbered_by_itself_and_the_length_of_a_segment_is_looked_up():
    desks = some_desks()
    for scorer, first in (('vision', 0), ('ben', 7), ('vision', 14)):
        desks.score(desks.desk(scorer, ''), ('sim', 0, first, 0), first / 10, ANY)
    stated = sorted(published(desks))
    assert stated == [('ben', 0, 7, 7, 0.7), ('vision', 0, 0, 7, 0.0), ('vision', 1, 14, 7, 1.4)]


def test_a_segment_is_wanted_until_its_scorer_has_judged_it_and_what_was_taken_is_known():
    desks = some_desks()
    desks.receive(score_request(firsts=[35, 14], length=7))
    vision, ben = desks.desk('vision', ''), desks.desk('ben', '')
    assert desks.wanted(vision, 0, False).segments == [('sim', 0, 35, 7), ('sim', 0, 14, 7)]
    desks.score(vision, ('sim', 0, 35, 7), math.nan, ANY)
    assert desks.wanted(vision, 0, False).segments == [('sim', 0, 14, 7)]
    assert desks.wanted(ben, 1, False).segments == [('sim', 0, 35, 7)]
    assert (vision.count, vision.taken) == (1, -1)
    desks.receive(commit(scorers=('vision',), scores=np.array([0], np.int64)))
    assert (vision.count, vision.taken, ben.taken) == (1, 0, -1)


def test_whoever_asked_lately_is_to_receive_that_the_run_has_ended():
    desks = some_desks()
    vision, ben = desks.desk('vision', ''), desks.desk('ben', '')
    assert not desks.awaits(0.0)  # nobody has asked
    assert not desks.inform(ben, 0.0)
    assert not desks.inform(vision, 5.0)
    desks.receive(commit(phase=SETTINGS.phases - 1))
    assert desks.awaits(6.0)
    assert desks.inform(vision, 6.0)
    assert desks.awaits(7.0)  # the other one has not
    assert not desks.awaits(ASKS_WITHIN + 1)  # nor does it ask any more


def test_the_steps_of_wanted_segments_are_those_that_came():
    came = transitions(steps=70)
    desks = Desks(run(SETTINGS), SETTINGS)
    desks.receive(came)
    desks.receive(score_request(firsts=[35, 14], length=7))
    wanted = desks.wanted(desks.desk('vision', ''), 0, True)
    rows = np.r_[35:42, 14:21]
    assert np.array_equal(wanted.observations, came.observations[rows])
    assert np.array_equal(wanted.actions, came.actions[rows])


def test_an_answer_holds_no_more_steps_than_fit_into_a_message_but_one_segment_at_least():
    for delay, all_of_them, fit in ((MOST_STEPS // 3, 6, 3), (MOST_STEPS + 1, 2, 1)):
        settings = tiny(scorer='topic', delay=delay, steps=40_000)
        desks = some_desks(settings, steps=all_of_them * delay)
        desk = desks.desk('vision', '')
        assert len(desks.wanted(desk, 0, False).segments) == all_of_them
        wanted = desks.wanted(desk, 0, True)
        assert len(wanted.segments) == fit
        assert len(wanted.actions) == fit * delay


def test_who_joins_late_sees_of_an_episode_the_steps_that_it_sees_and_judges_no_others():
    came = transitions(steps=21, first_step=14)
    desks = Desks(run(SETTINGS), SETTINGS)
    desks.receive(came)
    desk = desks.desk('vision', '')
    assert set(desks.wanted(desk, 0, False).segments) == {('sim', 0, f, 7) for f in (14, 21, 28)}
    observations, _ = desks.seen.curves(('sim', 0, 21, 7))
    assert np.array_equal(observations, came.observations[7:14])
    assert desks.seen.actions_before(('sim', 0, 21, 7)) is None, 'those before are not known'
    with pytest.raises(ScoringError, match='no such segment'):
        desks.score(desk, ('sim', 0, 0, 7), 1, ANY)


def test_a_part_of_a_segment_is_none_while_its_episode_goes_on():
    desks = some_desks(steps=10)
    desk = desks.desk('vision', '')
    with pytest.raises(ScoringError, match='no such segment'):
        desks.score(desk, ('sim', 0, 7, 3), 1, ANY)
    with pytest.raises(ScoringError, match='no such segment'):
        desks.score(desk, ('sim', 0, 0, 3), 1, ANY)
    desks.receive(transitions(steps=2, first_step=10, sequence=1, terminated=True))
    desks.score(desk, ('sim', 0, 7, 5), 1, ANY)
    assert published(desks) == [('vision', 0, 7, 5, 1.0)]


@pytest.mark.parametrize(
    ('changes', 'reason'),
    [
        ({'value': 11.0}, 'value 11 is not on the scale 0 to 10'),
        ({'value': math.inf, 'scale': ANY}, 'inf'),
        ({'scale': (10.0, 0.0)}, 'lowest 10 and highest 0 are no scale'),
        ({'scale': (0.0, math.nan)}, 'are no scale'),
        ({'segment': ('sim', 0, 36, 0)}, 'no segment begins at step 36'),
        ({'segment': ('sim', 9, 35, 0)}, 'no segment begins at step 35'),
        ({'segment': ('sim', 0, 35, 6)}, 'no such segment'),
        ({'segment': ('other', 0, 35, 7)}, 'no such segment'),
    ],
    ids=range(8),
)
def test_what_is_no_score_is_refused_and_nothing_is_published(changes, reason):
    desks = some_desks()
    given = {'segment': ('sim', 0, 35, 7), 'value': 3.0, 'scale': (0.0, 10.0)} | changes
    desk = desks.desk('vision', '')
    with pytest.raises(ScoringError, match=reason):
        desks.score(desk, given['segment'], given['value'], given['scale'])
    assert published(desks) == [] and desk.count == 0


def test_who_is_not_admitted_gets_no_desk():
    named = tiny(scorer='topic', scorers=('ann', 'ben'))
    desks = some_desks(named)
    desks.desk('ann', '')
    with pytest.raises(ScoringError, match=r"'eve' is no scorer .* of ann, ben \(setting sco"):
        desks.desk('eve', '')
    anybody = some_desks()
    for name in ('', 'a b', 'x' * 65, 'new\nline'):
        with pytest.raises(ScoringError, match='a scorer is named by'):
            anybody.desk(name, '')
    with pytest.raises(ScoringError, match="'sim' is a source of this run"):
        anybody.desk('sim', '')
    with pytest.raises(ScoringError, match='come from scorer = .simulator.'):
        some_desks(tiny()).desk('ann', '')


def test_a_wrong_token_opens_no_desk_not_even_one_that_is_open():
    desks = some_desks()
    desks.token = 'abcd'
    desks.desk('vision', 'abcd')
    with pytest.raises(ScoringError, match='token is empty: this run has a key'):
        desks.desk('vision', '')
    with pytest.raises(ScoringError, match="the token 'ab' is wrong"):
        desks.desk('vision', 'ab')


def test_names_that_are_made_up_do_not_take_memory_without_end():
    desks = some_desks()
    for number in range(MOST_SCORERS):
        desks.desk(f'v{number}', '')
    with pytest.raises(ScoringError, match=f'one more than the {MOST_SCORERS}'):
        desks.desk('one_more', '')
    assert desks.desk('v0', '') is desks.desk('v0', '')


def test_more_judgements_than_the_run_takes_between_commits_are_refused_before_they_are_lost():
    settings = tiny(scorer='topic', steps=20, phase_steps=5, warmup_steps=5, evaluate_every=0)
    desks = some_desks(settings)
    desk = desks.desk('vision', '')
    for _ in range(settings.judgements_ahead):
        desks.score(desk, ('sim', 0, 0, 7), 1, ANY)
    with pytest.raises(ScoringError, match=f'{settings.judgements_ahead} judgements of'):
        desks.score(desk, ('sim', 0, 0, 7), 1, ANY)
    desks.receive(commit(scorers=('vision',), scores=np.array([0], np.int64)))
    desks.score(desk, ('sim', 0, 0, 7), 1, ANY)
