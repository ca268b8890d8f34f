"""Scores that are missing, noisy or verdicts, against the true ones of the same episodes."""

import numpy as np
import pytest

from codetr_ros.config import SettingsError
from codetr_ros.cores.simulator import Simulator
from codetr_ros.records import CompositeReward, EpisodeResult, Metrics, Transitions, TrueRewards
from codetr_ros.seeding import generator
from codetr_ros.simulation import tasks
from codetr_ros.simulation.scorer import Scorer, ScoreScale, random_scores
from helpers.builders import run as run_spec
from helpers.builders import same, tiny
from helpers.simulating import FALLS, NEVER_ENDS, kind, permit, simulate


def scores(**changes):
    """What a simulator gives, beside the true scores of the same segments."""
    settings = tiny(**{'task': NEVER_ENDS, 'delay': 10} | changes)
    exact = {'score_missing': 0.0, 'score_noise': 0.0, 'score_levels': 0}
    policies = [permit(k, steps=200) for k in range(6)]
    said, true = simulate(settings, policies), simulate(settings.changed(exact), policies)
    given, known = (kind(CompositeReward, each) for each in (said, true))
    assert [(s.sequence, s.episode, s.first_step, s.length) for s in given] == [
        (s.sequence, s.episode, s.first_step, s.length) for s in known
    ]
    return np.array([s.value for s in given]), np.array([s.value for s in known]), said, true


def test_what_is_inexact_changes_nothing_but_the_values_of_scores():
    *_, said, true = scores(score_missing=0.3, score_noise=1.0, score_levels=5)
    for a, b in zip(said, true, strict=True):
        if isinstance(a, (Transitions, TrueRewards, EpisodeResult)):
            assert same(a, b)


def test_the_share_that_is_missing_is_about_as_stated_and_the_rest_is_exact():
    given, known, _, _ = scores(score_missing=0.3, delay='2:5')
    missing = np.isnan(given)
    assert len(given) > 300 and 0.25 < missing.mean() < 0.35
    np.testing.assert_array_equal(given[~missing], known[~missing])


def test_noise_has_the_stated_deviations_of_the_random_policys_scores():
    given, known, _, _ = scores(score_noise=0.5, delay='2:5')
    unit = ScoreScale.of(tiny(task=NEVER_ENDS, delay='2:5', score_noise=0.5)).deviation
    off = (given - known) / unit
    assert off.mean() == pytest.approx(0, abs=0.08) and off.std() == pytest.approx(0.5, rel=0.1)
    assert known.std() == pytest.approx(unit, rel=0.4)  # of the random policy too


def test_verdicts_are_levels_of_the_true_scores_in_their_order():
    given, known, said, _ = scores(score_levels=5)
    assert set(given.tolist()) == {1.0, 2.0, 3.0, 4.0, 5.0}
    assert (np.diff(given[np.argsort(known, kind='stable')]) >= 0).all()
    values = kind(Metrics, said)[0]
    numbers = dict(zip(values.names, values.values.tolist(), strict=True))
    thresholds = [numbers[f'score_threshold_{k}'] for k in range(1, 5)]
    np.testing.assert_array_equal(given, 1 + (known[:, None] > thresholds).sum(1))


def test_thresholds_leave_equally_many_scores_of_the_random_policy_on_each_level():
    settings = tiny(task=NEVER_ENDS, delay=10, score_levels=4)
    known = random_scores(settings)
    assert len(known) == 100
    scale = ScoreScale.of(settings)
    scorer = Scorer(settings, scale, 'sim')
    scorer.begin(0)
    counts = np.bincount([int(scorer.given(score)) for score in known.tolist()])
    assert counts.tolist() == [0, 25, 25, 25, 25]


def test_the_settings_do_not_change_each_others_draws():
    noisy, _, _, _ = scores(score_noise=0.5)
    both, _, _, _ = scores(score_noise=0.5, score_missing=0.4)
    there = ~np.isnan(both)
    np.testing.assert_array_equal(both[there], noisy[there])
    gone = np.isnan(scores(score_missing=0.4)[0])
    np.testing.assert_array_equal(gone, ~there)
    verdicts = scores(score_missing=0.4, score_levels=3)[0]
    np.testing.assert_array_equal(np.isnan(verdicts), gone)


def test_draws_depend_on_no_phase_and_differ_from_source_to_source():
    settings = tiny(task=NEVER_ENDS, delay=10, score_missing=0.4)
    of_b = [permit(k, steps=200, sources=('sim', 'b')) for k in range(3)]
    ways = (
        simulate(settings, [permit(k, steps=150) for k in range(4)]),
        simulate(settings, [permit(k, steps=200) for k in range(3)]),
        simulate(settings, of_b, source='b'),
    )
    gone = [[np.isnan(s.value) for s in kind(CompositeReward, said)] for said in ways]
    assert gone[0] == gone[1] != gone[2]


def test_the_scale_is_the_same_for_every_simulator_of_a_run_and_repeatable():
    settings = tiny(task=FALLS, delay='3:11', score_noise=1.0, score_levels=3)
    one, other = ScoreScale.of(settings), ScoreScale.of(settings)
    assert one.metrics() == other.metrics()
    again = ScoreScale.of(settings.changed({'seed': 1}))
    assert again.metrics() != one.metrics()


def test_the_scale_is_that_of_scores_worked_out_by_hand():
    settings = tiny(task=NEVER_ENDS, delay=50, score_noise=1.0)
    environment = tasks.make(NEVER_ENDS)
    totals = []
    for number in range(25):
        environment.reset(int(generator(0, 'scale', number).integers(2**31)))
        actions = generator(0, 'scale', 'random', number).random((200, 1), np.float32) * 2 - 1
        rewards = np.array([environment.step(action)[1] for action in actions])
        totals += rewards.reshape(4, 50).sum(1).tolist()
    assert ScoreScale.of(settings).deviation == pytest.approx(np.std(totals), rel=1e-6)


def test_long_segments_are_measured_within_a_bounded_number_of_steps(monkeypatch):
    from codetr_ros.simulation import scorer

    monkeypatch.setattr(scorer, 'MEASURED_STEPS', 500)
    assert len(random_scores(tiny(task=NEVER_ENDS, delay='episode', score_noise=1.0))) == 3
    monkeypatch.setattr(scorer, 'MEASURED_STEPS', 10)
    assert len(random_scores(tiny(task=NEVER_ENDS, delay='episode', score_noise=1.0))) == 2


def test_exact_scores_measure_nothing():
    assert ScoreScale.of(tiny(task='no such task')).metrics() == {}


def test_noise_where_all_scores_are_the_same_is_refused_with_the_remedy():
    settings = tiny(task=FALLS, delay='episode', score_noise=1.0, composite='max_hard')
    with pytest.raises(SettingsError, match=r'score_noise = 1: \d+ scores .* all 1, .*noise=0'):
        Simulator(run_spec(settings), settings, 'sim')


def test_levels_of_which_some_are_never_given_are_named(caplog):
    settings = tiny(task=FALLS, delay=1, score_levels=3, composite='max')
    assert ScoreScale.of(settings).thresholds.tolist() == [1.0, 1.0]
    assert 'score_levels = 3: the thresholds 1, 1 are not all different' in caplog.text


def test_a_scale_of_one_level_is_refused():
    with pytest.raises(SettingsError, match='score_levels=1: a scale of one level'):
        tiny(score_levels=1)
