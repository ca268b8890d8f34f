"""Scales of several scorers, against simulated ones whose offsets and slopes are known."""

import numpy as np
import pytest

from codetr_ros.memory.calibration import calibrate

OFFSETS = np.array([0.0, 50.0, -3.0])
SLOPES = np.array([1.0, 10.0, 0.5])


def simulated(shared, rng, noise=0.2, segments=120, drift=0.0):
    """Scores of segments by three: each segment by one of them, a share of them by all."""
    worth = 3 + rng.normal(size=segments)
    who = rng.integers(0, 3, segments)
    worth = worth + drift * who  # what the later ones see is better
    all_of_them = rng.random(segments) < shared
    rows = [(k, s) for s in range(segments) for k in (range(3) if all_of_them[s] else [who[s]])]
    k, s = np.array(rows).T
    scores = OFFSETS[k] + SLOPES[k] * (worth[s] + noise * rng.normal(size=len(k)))
    return worth, k, s, scores


def test_offsets_and_slopes_of_scorers_who_share_some_segments_are_recovered():
    worth, who, segments, scores = simulated(0.3, np.random.default_rng(0))
    found = calibrate(who, segments, scores, reference=0)
    np.testing.assert_allclose(found.slopes, SLOPES, rtol=0.12)
    # at the mean worth of 3, where they are known best
    np.testing.assert_allclose(
        found.offsets + 3 * found.slopes, OFFSETS + 3 * SLOPES, atol=0.3 * 10 * 0.5
    )
    assert np.corrcoef(found.worths, worth)[0, 1] > 0.97
    assert np.sqrt(np.mean((found.worths - worth) ** 2)) < 0.25
    assert (found.agreement > 0.9).all()


def test_scorers_who_share_nothing_are_brought_together_by_the_spread_of_what_they_gave():
    worth, who, segments, scores = simulated(0.0, np.random.default_rng(1))
    found = calibrate(who, segments, scores, reference=0)
    raw = np.corrcoef(scores, worth[segments])[0, 1]
    assert raw < 0.3  # what would be learnt from if scales were ignored
    assert np.corrcoef(found.worths, worth)[0, 1] > 0.9
    assert np.isnan(found.agreement).all()


def test_what_the_reward_model_expects_tells_a_lenient_scorer_from_better_segments():
    worth, who, segments, scores = simulated(0.0, np.random.default_rng(2), drift=1.0)
    blind = calibrate(who, segments, scores, reference=0)
    seeing = calibrate(who, segments, scores, reference=0, expected=0.3 * worth - 7)

    def off(found):
        return float(np.sqrt(np.mean((found.worths - worth) ** 2)))

    assert off(blind) > 0.8  # takes the better segments of the later ones for a higher scale
    assert off(seeing) < 0.5 * off(blind)


def test_the_noisiest_of_three_counts_for_less():
    rng = np.random.default_rng(3)
    worth = rng.normal(size=80)
    who, segments = np.repeat([0, 1, 2], 80), np.tile(np.arange(80), 3)
    scores = worth[segments] + np.where(who == 1, 1.5, 0.1) * rng.normal(size=240)
    found = calibrate(who, segments, scores, reference=0)
    assert found.noises[1] > 3 * max(found.noises[0], found.noises[2])
    plain = scores.reshape(3, 80).mean(0)
    assert np.mean((found.worths - worth) ** 2) < 0.25 * np.mean((plain - worth) ** 2)
    assert found.agreement.argmin() == 1


def test_few_scores_of_a_second_scorer_do_little_harm_and_no_number_is_infinite():
    who, segments = np.array([0, 0, 0, 0, 1]), np.arange(5)
    found = calibrate(who, segments, np.array([1.0, 2.0, 3.0, 4.0, 90.0]), reference=0)
    assert np.isfinite([*found.worths, *found.offsets, *found.slopes, *found.noises]).all()
    np.testing.assert_allclose(found.worths[:4], [1, 2, 3, 4])
    assert -1 < found.worths[4] < 6


@pytest.mark.parametrize('scores', [[2.0, 2.0, 2.0, 2.0], [0.0, 0.0, 5.0, 5.0]])
def test_scorers_who_always_give_the_same_are_no_error(scores):
    found = calibrate(np.array([0, 0, 1, 1]), np.array([0, 1, 0, 1]), np.array(scores), 0)
    assert np.isfinite([*found.worths, *found.offsets, *found.slopes, *found.noises]).all()
