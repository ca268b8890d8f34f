"""Composite rewards against values worked out by hand, and the properties that define them."""

import math
from typing import get_args

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from codetr_ros import config
from codetr_ros.simulation.composite import COMPOSITES, CompositeError, composite, perfect_score

segments = st.lists(st.floats(-50, 50), min_size=1, max_size=12).map(np.array)
signed = pytest.mark.parametrize('name', ['sum', 'sum_square', 'square_sum'])
maxima = pytest.mark.parametrize('name', ['max', 'max_hard', 'max_log_sum_exp', 'max_times_n'])


def of(name, *rewards, beta=3.0, delay=4):
    return composite(name, np.array(rewards, np.float64), beta, delay)


def test_every_type_of_the_configuration_has_its_formula():
    assert set(COMPOSITES) == set(get_args(config.Composite))


@pytest.mark.parametrize(
    ('name', 'value'),
    [
        ('sum', 1.0 - 2.0 + 3.0),
        ('sum_square', 1.0 - 4.0 + 9.0),
        ('square_sum', 4.0),
        ('max_hard', 3.0),
        # softmax(3, -6, 9) of 1, -2, 3
        (
            'max',
            (math.exp(3) - 2 * math.exp(-6) + 3 * math.exp(9))
            / (math.exp(3) + math.exp(-6) + math.exp(9)),
        ),
        ('max_log_sum_exp', math.log(math.exp(3) + math.exp(-6) + math.exp(9)) / 3),
        (
            'max_times_n',
            4
            * (math.exp(3) - 2 * math.exp(-6) + 3 * math.exp(9))
            / (math.exp(3) + math.exp(-6) + math.exp(9)),
        ),
        # softmax(-3, 6, -9) of 1, -2, 3
        (
            'minimum',
            (math.exp(-3) - 2 * math.exp(6) + 3 * math.exp(-9))
            / (math.exp(-3) + math.exp(6) + math.exp(-9)),
        ),
        ('peak_end', 3.0),
    ],
)
def test_three_rewards_make_the_value_worked_out_by_hand(name, value):
    assert of(name, 1, -2, 3) == pytest.approx(value, rel=1e-12)


def test_squares_keep_their_sign():
    assert of('sum_square', -1, -2) == -5
    assert of('square_sum', -1, -2) == -9


@signed
@given(rewards=segments)
def test_opposite_rewards_make_the_opposite_composite(name, rewards):
    assert composite(name, -rewards, 3.0, 12) == -composite(name, rewards, 3.0, 12)


@given(rewards=segments, beta=st.floats(0.01, 100))
def test_the_soft_maximum_lies_between_mean_and_maximum(rewards, beta):
    value = composite('max', rewards, beta, 12)
    assert rewards.mean() - 1e-9 <= value <= rewards.max() + 1e-9


@given(rewards=segments, beta=st.floats(0.01, 100))
def test_the_soft_minimum_lies_between_minimum_and_mean(rewards, beta):
    value = composite('minimum', rewards, beta, 12)
    assert rewards.min() - 1e-9 <= value <= rewards.mean() + 1e-9


@given(rewards=segments)
def test_peak_and_end_are_the_best_step_and_the_last_one_in_equal_parts(rewards):
    best, last = -math.inf, math.nan
    for last in rewards.tolist():
        best = last if last > best else best
    assert composite('peak_end', rewards, 3.0, 12) == (best + last) / 2


@pytest.mark.parametrize(('rewards', 'value'), [((5, 1), 3), ((-9, -1), -1), ((2, -9, 0), 1)])
def test_a_bad_step_is_no_peak_however_bad(rewards, value):
    assert of('peak_end', *rewards) == value


@given(rewards=segments, beta=st.floats(0.01, 100))
def test_log_sum_exp_exceeds_the_maximum_by_at_most_the_logarithm_of_the_length(rewards, beta):
    excess = composite('max_log_sum_exp', rewards, beta, 12) - rewards.max()
    assert -1e-9 <= excess <= math.log(len(rewards)) / beta + 1e-9


@given(rewards=segments)
def test_a_small_beta_makes_the_soft_maximum_the_mean(rewards):
    assert composite('max', rewards, 1e-9, 12) == pytest.approx(rewards.mean(), abs=1e-5)


@pytest.mark.parametrize('name', ['max', 'max_log_sum_exp'])
def test_a_large_beta_makes_the_soft_maximum_the_maximum(name):
    assert of(name, 1, -2, 1.1, beta=1000) == pytest.approx(1.1, abs=1e-9)


@given(reward=st.floats(-1000, 1000))
def test_a_segment_of_one_step_gives_its_reward_or_signed_square(reward):
    for name in ('sum', 'max', 'max_hard', 'max_log_sum_exp', 'minimum', 'peak_end'):
        assert of(name, reward) == pytest.approx(reward)
    for name in ('sum_square', 'square_sum'):
        assert of(name, reward) == pytest.approx(abs(reward) * reward)


@maxima
def test_maxima_of_rewards_whose_exponential_overflows_are_exact(name):
    factor = 2 if name == 'max_times_n' else 1
    assert of(name, 1e6, -1e6, delay=2) == factor * 1e6
    assert of(name, -1e300, -2e300, beta=1000, delay=2) == factor * -1e300


def test_a_minimum_of_rewards_whose_exponential_overflows_is_exact():
    assert of('minimum', 1e6, -1e6, delay=2) == -1e6
    assert of('minimum', 1e300, 2e300, beta=1000, delay=2) == 1e300


def test_max_times_n_has_the_delay_as_factor_in_a_shorter_segment_too():
    assert of('max_times_n', 2.0, delay=25) == 50


def test_rewards_of_lower_precision_are_summed_in_float64():
    rewards = np.array([1e8, 1, -1e8], np.float32)
    assert composite('sum', rewards, 3.0, 3) == 1


@pytest.mark.parametrize(
    ('name', 'score'),
    [
        # supplement A.3 for Ant with r_max = 6 and 1000 steps, delay 25
        ('sum', 6000),
        ('sum_square', 36_000),
        ('square_sum', 900_000),
        ('max', 240),
        ('max_hard', 240),
        ('max_times_n', 6000),
        ('max_log_sum_exp', 40 * (6 + math.log(25) / 3)),
        ('minimum', 240),
        ('peak_end', 240),
    ],
)
def test_the_perfect_score_is_that_of_the_papers_normalisation(name, score):
    assert perfect_score(name, 3.0, 25, 1000, 6.0) == pytest.approx(score, rel=1e-12)


@pytest.mark.parametrize(('delay', 'score'), [(50, 1.8e6), (100, 3.6e6), (200, 7.2e6)])
def test_the_perfect_square_sum_grows_with_the_delay(delay, score):
    assert perfect_score('square_sum', 3.0, delay, 1000, 6.0) == pytest.approx(score)


def test_the_number_of_segments_is_not_rounded_where_the_delay_does_not_divide_the_horizon():
    assert perfect_score('max', 3.0, 300, 1000, 2.0) == pytest.approx(1000 / 300 * 2)


def test_an_unknown_type_is_refused_with_those_that_exist():
    with pytest.raises(CompositeError, match="'median'.* sum, sum_square, square_sum, max, "):
        of('median', 1)


@pytest.mark.parametrize('rewards', [(), (1, 2, 3, 4, 5)])
def test_a_segment_without_steps_or_longer_than_the_delay_is_refused(rewards):
    with pytest.raises(CompositeError, match=rf'\({len(rewards)},\), a segment has 1 to delay=4'):
        of('sum', *rewards)


def test_a_composite_that_float64_cannot_hold_is_refused():
    with pytest.raises(CompositeError, match='square_sum of rewards between 1e.200 and 1e.200'):
        of('square_sum', 1e200)
