import numpy as np
import pytest

from codetr_ros.runs.recovery_metrics import r_squared, step_recovery

ALL = np.ones((2, 3), bool)


@pytest.mark.parametrize('size', [1e150, 1e-150, 1e-200, 1e-300, -1e-200])
def test_r_squared_does_not_depend_on_the_size_of_scores(size):
    true, predicted = np.array([1.0, 2.0, 6.0]), np.array([1.5, 2.0, 3.0])
    assert r_squared(predicted * size, true * size) == pytest.approx(r_squared(predicted, true))


@pytest.mark.parametrize('value', [0.1, 1 / 3, 1e-9, 1e9 + 0.1])
def test_equal_scores_have_no_variance_although_their_mean_is_rounded(value):
    assert np.isnan(r_squared(np.arange(24.0), np.full(24, value)))


def test_r_squared_is_1_for_the_truth_0_for_its_mean_and_nan_where_nothing_varies():
    true = np.array([1.0, 2.0, 6.0])
    assert r_squared(true, true) == 1
    assert r_squared(np.full(3, 3.0), true) == 0
    assert r_squared([1.0, 2.0, 3.0], true) == pytest.approx(1 - 9 / 14)
    assert np.isnan(r_squared([1.0, 2.0], [5.0, 5.0]))
    assert np.isnan(r_squared([], []))


def test_credit_to_the_wrong_step_shows_within_segments_only():
    """Each segment's sum is right, each step's share is turned around."""
    true = np.array([[1.0, 2.0, 3.0], [101.0, 102.0, 103.0]])
    found = step_recovery(true[:, ::-1], true, ALL)
    assert found['pearson'] > 0.99
    assert found['within_pearson'] == pytest.approx(-1)
    assert found['within_spearman'] == pytest.approx(-1)


def test_ranks_do_not_care_how_large_a_reward_is():
    true = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    found = step_recovery(np.exp(true), true, ALL)
    assert found['spearman'] == pytest.approx(1)
    assert found['pearson'] < 0.95


def test_context_and_padding_are_of_no_account():
    true = np.array([[9.0, 1.0, 2.0], [3.0, 5.0, -9.0]])
    inside = np.array([[False, True, True], [True, True, False]])
    found = step_recovery(np.where(inside, true, 1e6), np.where(inside, true, np.nan), inside)
    assert found == pytest.approx(
        {'pearson': 1, 'spearman': 1, 'within_pearson': 1, 'within_spearman': 1}
    )


def test_even_credit_says_nothing_within_segments():
    true = np.array([[1.0, 2.0, 3.0], [4.0, 5.0, 6.0]])
    even = np.repeat([[0.1], [0.7]], 3, 1)
    assert np.isnan(step_recovery(even, true, ALL)['within_pearson'])
    assert step_recovery(even, true, ALL)['pearson'] > 0.8
