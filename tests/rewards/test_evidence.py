"""The regression of method `evidence`, beside oracles that know nothing of how it is computed."""

import numpy as np
import pytest
import torch
from scipy.stats import multivariate_normal

from codetr_ros.rewards.evidence import links, scales
from codetr_ros.rewards.evidence.features import DRIFT, Features, Moments, moments, sums
from codetr_ros.rewards.evidence.maxima import Minimum, PeakEnd, SoftMax
from codetr_ros.rewards.evidence.regression import noise, posterior
from codetr_ros.rewards.evidence.sample import chosen
from codetr_ros.rewards.evidence.scales import JITTER, Evidence, Linear

BLOCKS = [slice(0, 1), slice(1, 4), slice(4, 9)]
THETA = np.log([0.7, 2.0, 0.1, 0.3, 0.02])
M = np.array([4, 1, 7, 3])
STARTS = np.cumsum(M) - M
BETA = 1.7


def problem(scores: int, known: bool = False) -> Linear:
    rng = np.random.default_rng(scores)
    return Linear(
        torch.tensor(rng.normal(size=(scores, 9))),
        torch.tensor(rng.uniform(0.1, 1.0, scores)),
        torch.tensor(rng.normal(size=scores)),
        torch.tensor(rng.normal(size=scores)) if known else None,
    )


def covariance(data: Linear, theta: np.ndarray) -> np.ndarray:
    """Of the targets, written out score by score."""
    rows = data.rows.numpy()
    made = np.zeros((len(rows), len(rows)))
    for i, one in enumerate(rows):
        for j, other in enumerate(rows):
            for block, scale in zip(BLOCKS, np.exp(theta), strict=False):
                made[i, j] += scale * sum(one[block] * other[block])
            if data.known is not None:
                made[i, j] += float(data.known[i] * data.known[j])
    step, score = np.exp(theta[-2:])
    return made + np.diag(step * data.spread.numpy() + score + JITTER)


@pytest.mark.parametrize('known', [False, True])
def test_the_evidence_is_the_density_of_the_scores_and_of_the_scales_prior(known):
    data = problem(6, known)
    density = multivariate_normal(np.zeros(6), covariance(data, THETA)).logpdf(data.targets)
    off = THETA - scales.centre(3)
    expected = -(density + 3 * np.log(2 * np.pi)) + (off**2).sum() / 18
    assert Evidence(data, BLOCKS)(THETA)[0] == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize('known', [False, True])
def test_the_gradient_of_the_evidence_is_that_of_finite_differences(known):
    evidence = Evidence(problem(12, known), BLOCKS)
    gradient = evidence(THETA)[1]
    for i in range(len(THETA)):
        step = np.zeros(len(THETA))
        step[i] = 1e-5
        slope = (evidence(THETA + step)[0] - evidence(THETA - step)[0]) / 2e-5
        assert gradient[i] == pytest.approx(slope, rel=1e-6, abs=1e-7)


def test_scores_left_out_are_predicted_as_if_they_had_never_been_there():
    data = problem(7)
    residuals = Evidence(data, BLOCKS).left_out(THETA).numpy()
    for i in range(7):
        others = [j for j in range(7) if j != i]
        full = covariance(data, THETA)
        predicted = full[i, others] @ np.linalg.solve(
            full[np.ix_(others, others)], data.targets.numpy()[others]
        )
        assert residuals[i] == pytest.approx(float(data.targets[i]) - predicted, rel=1e-9)


@pytest.mark.parametrize('scores', [1, 5, 9, 10, 40])
@pytest.mark.parametrize('known', [False, True])
def test_the_posterior_is_that_of_brute_force_whichever_space_is_smaller(scores, known):
    data = problem(scores, known)
    found = posterior(data, THETA, BLOCKS)
    prior = np.concatenate(
        [np.full(b.stop - b.start, v) for b, v in zip(BLOCKS, np.exp(THETA), strict=False)]
    )
    rows = data.rows.numpy()
    if data.known is not None:
        rows, prior = np.c_[rows, data.known.numpy()], np.append(prior, 1.0)
    step, score = np.exp(THETA[-2:])
    weights = 1 / (step * data.spread.numpy() + score + JITTER)
    precision = np.diag(1 / prior) + rows.T @ np.diag(weights) @ rows
    expected = np.linalg.inv(precision)
    mean = expected @ rows.T @ (weights * data.targets.numpy())
    np.testing.assert_allclose(found.covariance, expected, rtol=1e-7, atol=1e-10)
    np.testing.assert_allclose(found.mean, mean, rtol=1e-7, atol=1e-10)
    bare = posterior(data, THETA, BLOCKS, spread=False)
    np.testing.assert_array_equal(bare.mean, found.mean)


def test_the_noise_is_that_of_its_formula():
    spread = torch.tensor([0.5, 2.0], dtype=torch.float64)
    data = Linear(torch.zeros(2, 1), spread, spread, noise=torch.tensor([0.0, 0.7]))
    expected = 0.3 * spread.numpy() + 0.02 + JITTER + np.array([0.0, 0.7])
    np.testing.assert_allclose(noise(THETA, data), expected, rtol=1e-7)


def test_learning_makes_the_evidence_larger_and_stays_within_bounds():
    evidence = Evidence(problem(30), BLOCKS)
    begun = scales.first(3)
    theta, value = scales.learn(evidence, begun, 40)
    assert value == pytest.approx(-evidence(theta)[0]) and value > -evidence(begun)[0]
    assert (theta >= -16).all() and (theta <= 12).all()


def test_a_matrix_that_rounding_has_made_indefinite_still_has_a_factor():
    row = torch.arange(1.0, 9.0, dtype=torch.float64)[:, None] * 1e3
    matrix = row @ row.T
    factor = scales.cholesky(matrix)
    np.testing.assert_allclose(factor @ factor.T, matrix, rtol=1e-5)
    with pytest.raises(FloatingPointError, match='8 rows.*has no Cholesky factor'):
        scales.cholesky(matrix - torch.eye(8, dtype=torch.float64) * 1e9)
    with pytest.raises(FloatingPointError, match='has no Cholesky factor'):
        scales.cholesky(torch.full((2, 2), float('nan'), dtype=torch.float64))


# ------------------------------------------------------------------------------------------------
# links


def link(name: str, ordinal: bool = False) -> links.Link:
    made = links.make(name, BETA, 7)
    made.ordinal = ordinal
    return made


def score(name: str, rewards: np.ndarray) -> float:
    """A score of one segment, from the definition of its kind; n = 7."""
    soft = np.exp(BETA * rewards) / np.exp(BETA * rewards).sum()
    up = np.exp(-BETA * rewards) / np.exp(-BETA * rewards).sum()
    return {
        'sum': rewards.sum(),
        'mean': rewards.mean(),
        'square_sum': rewards.sum() * abs(rewards.sum()),
        'sum_square': (rewards * abs(rewards)).sum(),
        'max': soft @ rewards,
        'minimum': up @ rewards,
        'max_times_n': 7 * (soft @ rewards),
        'max_hard': rewards.max(),
        'peak_end': (rewards.max() + rewards[-1]) / 2,
        'max_log_sum_exp': np.log(np.exp(BETA * rewards).sum()) / BETA,
    }[name]


@pytest.mark.parametrize('name', links.NAMES)
def test_the_level_is_the_constant_reward_that_explains_a_score(name):
    constants = np.array([0.8, -1.3, 2.0, 0.4])
    scores = np.array([score(name, np.full(m, c)) for m, c in zip(M, constants, strict=True)])
    made = link(name)
    np.testing.assert_allclose(made.level(scores, M), constants, rtol=1e-12)
    np.testing.assert_allclose(made.score(constants, M), scores, rtol=1e-12)
    level, slopes = made.forward(np.repeat(constants, M), STARTS, M)
    np.testing.assert_allclose(level, constants, rtol=1e-12)
    np.testing.assert_allclose(np.add.reduceat(slopes, STARTS), 1, rtol=1e-12)


@pytest.mark.parametrize('ordinal', [False, True], ids=['numbers', 'verdicts'])
@pytest.mark.parametrize('name', links.NAMES)
def test_labels_explain_a_score_exactly_whatever_they_were_before(name, ordinal):
    rng = np.random.default_rng(3)
    f, true = rng.normal(size=15), rng.normal(size=15)
    scores = np.array([score(name, part) for part in np.split(true, STARTS[1:])])
    made = link(name, ordinal)
    labels = f + np.repeat(made.shift(f, made.level(scores, M), STARTS, M), M)
    again = [score(name, part) for part in np.split(labels, STARTS[1:])]
    np.testing.assert_allclose(again, scores, rtol=1e-9, atol=1e-12)
    inside = [np.ptp(labels[a:b] - f[a:b]) for a, b in zip(STARTS, STARTS + M, strict=True)]
    np.testing.assert_allclose(inside, 0, atol=1e-12)


@pytest.mark.parametrize('ordinal', [False, True], ids=['numbers', 'verdicts'])
@pytest.mark.parametrize('name', links.NAMES)
def test_slopes_are_those_of_finite_differences(name, ordinal):
    made = link(name, ordinal)
    f = np.random.default_rng(4).normal(2.0, 0.5, 15)  # far from the root's corner at 0
    slopes = made.forward(f, STARTS, M)[1]
    segment = np.repeat(np.arange(4), M)
    for t in range(len(f)):
        step = np.zeros(len(f))
        step[t] = 1e-6
        up, down = (made.forward(f + s, STARTS, M)[0] for s in (step, -step))
        assert slopes[t] == pytest.approx(((up - down) / 2e-6)[segment[t]], rel=1e-5, abs=1e-8)


@pytest.mark.parametrize('ordinal', [False, True], ids=['numbers', 'verdicts'])
@pytest.mark.parametrize('name', links.NAMES)
def test_the_slope_of_the_level_by_the_score_is_that_of_finite_differences(name, ordinal):
    made, scores = link(name, ordinal), np.array([3.0, -2.0, 5.0, 1.5])
    slope = (made.level(scores + 1e-6, M) - made.level(scores - 1e-6, M)) / 2e-6
    np.testing.assert_allclose(np.exp(made.log_slope(scores, M)), slope, rtol=1e-6)


@pytest.mark.parametrize('name', links.NAMES)
def test_where_scores_are_verdicts_levels_are_ordered_as_scores_however_long_segments_are(name):
    made, rng = link(name, ordinal=True), np.random.default_rng(6)
    true = rng.normal(size=15)
    scores = np.array([score(name, part) for part in np.split(true, STARTS[1:])])
    levels = made.level(scores, M)
    assert np.argsort(levels).tolist() == np.argsort(scores).tolist()
    np.testing.assert_allclose(made.score(levels, M), scores, rtol=1e-12)
    if name != 'max_hard' and not name.startswith('peak'):  # those begin from another beta
        np.testing.assert_allclose(made.forward(true, STARTS, M)[0], levels, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize('name', links.NAMES)
def test_of_whole_segments_levels_of_verdicts_are_those_of_numbers_to_the_bit(name):
    f, m = np.random.default_rng(7).normal(size=21), np.full(3, 7)
    scores, starts = np.array([3.0, -2.0, 5.0]), np.array([0, 7, 14])
    found = []
    for ordinal in (False, True):
        made = link(name, ordinal)
        level = made.level(scores, m)
        found.append([level, *made.forward(f, starts, m), made.shift(f, level, starts, m)])
    for one, other in zip(*found, strict=True):
        assert one.tobytes() == other.tobytes()


@pytest.mark.parametrize('kind', [SoftMax, Minimum, PeakEnd])
def test_the_slope_by_the_temperature_is_that_of_finite_differences(kind):
    f = np.random.default_rng(5).normal(size=15)
    made = kind(BETA, learnt=True)
    slope = made.beta_slope(f, STARTS, M)
    made.move(1e-6)
    up = made.forward(f, STARTS, M)[0]
    made.move(-1e-6)
    down = made.forward(f, STARTS, M)[0]
    np.testing.assert_allclose(slope, (up - down) / 2e-6, rtol=1e-5, atol=1e-9)


def test_a_temperature_that_is_known_follows_the_unit_and_one_that_is_learnt_does_not():
    known, learnt = SoftMax(2.0), SoftMax(2.0, learnt=True)
    known.measure(10.0)
    learnt.measure(10.0)
    assert (known.beta, learnt.beta) == (20.0, 2.0)


# ------------------------------------------------------------------------------------------------
# features and sample


def test_moments_are_those_of_all_steps_together_and_have_floors():
    rng = np.random.default_rng(0)
    parts = [rng.normal(5, 2, (n, 5)).astype(np.float32) for n in (3, 8, 1)]
    for part in parts:
        part[:, 1] = 4.0  # a component that stands still
    total = np.sum([sums(part) for part in parts], 0)
    found, steps = moments(total, 2, 1), np.concatenate(parts).astype(np.float64)
    np.testing.assert_allclose(found.mean, steps.mean(0), rtol=1e-12)
    np.testing.assert_allclose(found.std, np.maximum(steps.std(0), 1e-2), rtol=1e-9)


def test_moments_count_as_moved_from_the_stated_drift_on():
    held = Moments(np.zeros(2), np.array([2.0, 1.0]))
    near = Moments(np.array([0.19, 0.0]), np.array([2.0, 1.09]))
    assert not held.moved(near)
    assert held.moved(Moments(np.array([2.1 * DRIFT, 0.0]), held.std))
    assert held.moved(Moments(held.mean, np.array([2.0, 1 + 1.1 * DRIFT])))
    assert held.moved(Moments(held.mean, np.array([2.0, 1 / (1 + 1.1 * DRIFT)])))


def test_each_kind_of_feature_has_about_unit_norm_and_each_component_is_a_block_of_its_own():
    features = Features(17, 6, seed=0)
    inputs = np.random.default_rng(1).normal(size=(4000, 40)).astype(np.float32)
    squares = (features(inputs) ** 2).mean(0).numpy()
    ends = np.cumsum([1, 17, 6, 17, 17, 6, 200, 200, 128, 128])[:-1]
    np.testing.assert_allclose([x.sum() for x in np.split(squares, ends)], 1, rtol=0.05)
    assert [b.stop - b.start for b in features.blocks] == [1] * 64 + [200, 200, 128, 128]


def test_effects_are_changes_of_f_by_one_deviation_of_a_component():
    features, rng = Features(3, 2, seed=0), np.random.default_rng(3)
    weights = torch.tensor(rng.normal(size=features.size))
    weights[features.blocks[-4].start :] = 0
    weights[1 + 3 + 2 + 3 :] = 0  # no squares: f is linear
    effects = features.effects(weights)
    assert len(effects) == features.blocks[-4].start - 1
    for column, name in enumerate(["s'[0]", "s'[1]", "s'[2]", 'a[0]', 'a[1]', "(s'-s)[0]"]):
        inputs = np.zeros((2, 8), np.float32)
        inputs[1, column] = 1
        f = features(inputs).double() @ weights
        assert effects[name] == pytest.approx(float(f[1] - f[0]), rel=1e-6)


@pytest.mark.parametrize('block', range(4))
def test_products_of_fourier_features_are_the_gaussian_kernel_that_they_stand_for(block):
    made = [Features(3, 2, seed) for seed in range(60)]
    inputs = np.random.default_rng(2).normal(size=(2, 8)).astype(np.float32) * 0.3
    sizes, lengths = (3, 3, 5, 8), (0.3, 0.7, 1.0, 1.0)
    products = []
    for features in made:
        one, other = features(inputs)[:, features.blocks[block - 4]]
        products.append(float(one @ other))
    n = sizes[block]
    apart = ((inputs[0, :n] - inputs[1, :n]) ** 2).sum()
    expected = np.exp(-apart / (2 * lengths[block] ** 2 * n))
    assert np.mean(products) == pytest.approx(expected, abs=4 * np.std(products) / 60**0.5)


def test_all_segments_are_learnt_from_while_they_are_few_and_then_the_newest_half_is():
    ids = np.concatenate([np.arange(100), np.arange(50) + (1 << 40)])
    np.testing.assert_array_equal(chosen(ids, 150, 0), ids)
    some = chosen(ids, 40, 0)
    assert len(some) == len(set(some.tolist())) == 40 and (np.diff(some) > 0).all()
    assert set(range(90, 100)) <= set(some.tolist())
    assert {(1 << 40) + i for i in range(40, 50)} <= set(some.tolist())


def test_an_old_segment_that_is_learnt_from_leaves_for_others_of_smaller_numbers_only():
    before = set(chosen(np.arange(1000), 100, 0).tolist())
    after = set(chosen(np.arange(1010), 100, 0).tolist())
    old = {i for i in before if i < 950}
    assert len(old - after) <= 10 and old & after
