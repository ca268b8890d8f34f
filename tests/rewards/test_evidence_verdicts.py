"""Method `evidence` on an ordinal scale: what verdicts state of levels, and what comes of it."""

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose
from scipy.integrate import quad
from scipy.stats import norm

from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F64
from codetr_ros.rewards import registry
from codetr_ros.rewards.base import RewardModelError, segment_steps
from codetr_ros.rewards.evidence import links, saving
from codetr_ros.rewards.evidence.method import Evidence
from codetr_ros.rewards.evidence.model import Model, Targets
from codetr_ros.rewards.evidence.sample import Sample
from codetr_ros.rewards.evidence.verdicts import LAPSES, Verdicts
from codetr_ros.simulation.composite import composite
from helpers import builders, planted
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O
from helpers.tensors import same

SCALE = Verdicts(np.array([1.0, 2.0, 3.0, 5.0]), np.array([-1.0, 0.2, 1.5]), 0.4, 1.0)


def moments(verdict: int, mean: float, variance: float) -> tuple[float, float, float]:
    """Mass, mean and variance of a level given its verdict, by numerical integration."""
    edges = np.concatenate([[-np.inf], SCALE.thresholds, [np.inf]])

    def density(level: float) -> float:
        below, above = norm.cdf((edges[verdict : verdict + 2] - level) / SCALE.tau)
        likely = (1 - LAPSES) * (above - below) + LAPSES / 4
        return float(norm.pdf(level, mean, variance**0.5) * likely)

    far = 9 * variance**0.5
    mass, first, second = (
        quad(lambda x, p=power: x**p * density(x), mean - far, mean + far, limit=400)[0]
        for power in range(3)
    )
    return mass, first / mass, second / mass - (first / mass) ** 2


@pytest.mark.parametrize('verdict', range(4))
@pytest.mark.parametrize(('mean', 'variance'), [(0.0, 1.0), (1.4, 0.05), (-2.0, 2.0)])
def test_what_a_verdict_states_of_a_level_is_what_integration_finds(verdict, mean, variance):
    mass, expected, left = moments(verdict, mean, variance)
    scores = SCALE.values[[verdict]]
    at, over = np.array([mean]), np.array([variance])
    found = SCALE.expected(scores, at, over)
    assert_allclose([found[0][0], found[1][0]], [expected, left], rtol=1e-5)
    assert SCALE.log_likelihood(scores, at, over) == pytest.approx(np.log(mass), rel=1e-6)


def test_a_verdict_that_is_surely_a_lapse_states_nothing_of_a_level():
    scores, far, sure = SCALE.values[[0]], np.array([9.0]), np.array([0.1])
    assert_allclose(SCALE.expected(scores, far, sure), [far, sure], rtol=1e-9)
    assert SCALE.sites(scores, far, sure)[1] > 1e5 * sure


def test_a_site_times_what_was_expected_before_is_what_is_expected_after():
    scores, rng = SCALE.values[[0, 1, 2, 3]], np.random.default_rng(0)
    mean, variance = rng.normal(size=4), rng.uniform(0.2, 2, 4)
    level, noise = SCALE.sites(scores, mean, variance)
    left = 1 / (1 / variance + 1 / noise)
    after = SCALE.expected(scores, mean, variance)
    assert_allclose(left * (mean / variance + level / noise), after[0], rtol=1e-9)
    assert_allclose(left, after[1], rtol=1e-9)


def test_verdicts_far_from_what_was_expected_stay_finite():
    scores = SCALE.values[[0, 3]]
    for expected in SCALE.sites(scores, np.array([40.0, -40.0]), np.array([0.01, 0.01])):
        assert np.isfinite(expected).all()


@pytest.mark.parametrize(('mean', 'variance'), [(0.0, 1.0), (1.4, 0.05), (-6.0, 0.5)])
def test_what_verdicts_are_expected_to_reveal_is_what_integration_finds(mean, variance):
    found = [moments(verdict, mean, variance) for verdict in range(4)]
    left = sum(mass * after for mass, _, after in found)
    share = SCALE.revealed(np.array([mean]), np.array([variance]))
    assert share[0] == pytest.approx(1 - left / variance, abs=1e-5)


def test_a_verdict_that_can_be_foreseen_reveals_nothing():
    open_, foreseen = SCALE.revealed(np.array([0.2, -9.0]), np.array([1.0, 1.0]))
    assert open_ > 0.4 and foreseen < 0.01


def test_thresholds_and_noise_are_found_again_among_lapses():
    rng = np.random.default_rng(1)
    levels = rng.normal(size=6000)
    noisy = levels + 0.4 * rng.normal(size=6000)
    scores = SCALE.values[np.searchsorted(SCALE.thresholds, noisy)]
    lapsed = rng.random(6000) < LAPSES
    scores[lapsed] = SCALE.values[rng.integers(0, 4, lapsed.sum())]
    found = Verdicts.first(scores, levels).learnt(scores, levels, np.full(6000, 1e-6))
    assert_allclose(found.thresholds, SCALE.thresholds, atol=0.05)
    assert found.tau == pytest.approx(SCALE.tau, rel=0.1)


def test_mean_verdicts_are_those_of_the_probabilities():
    level = np.array([-0.7, 0.4, 2.0])
    edges = np.concatenate([[-np.inf], SCALE.thresholds, [np.inf]])
    total = (SCALE.spread + SCALE.tau**2) ** 0.5
    shares = np.diff(norm.cdf((edges - level[:, None]) / total), axis=1)
    shares = (1 - LAPSES) * shares + LAPSES / 4
    assert_allclose(SCALE.mean_value(level), shares @ SCALE.values, rtol=1e-12)


def test_levels_left_out_are_what_a_fit_without_them_predicts():
    rng = np.random.default_rng(2)
    blocks = [slice(i, i + 1) for i in range(5)]
    m = np.full(12, 4)
    rows = torch.tensor(rng.normal(size=(12, 5)))
    targets = Targets(rng.normal(size=12), torch.tensor(rng.uniform(0.1, 0.5, 12)))
    model = Model(links.make('sum', 1.0, 4), blocks)
    none = np.arange(12)
    model._fit(Sample(targets.levels, m, rows), targets, none)
    mean, variance = model._left_out(Sample(targets.levels, m, rows), targets)
    scales = np.exp(model.theta)
    for out in range(12):
        kept = np.delete(np.arange(12), out)
        phi = rows.numpy()
        own = scales[-2] / 4 + scales[-1] + 1e-8
        prior = (phi * scales[:-2]) @ phi.T + own * np.eye(12)
        inner = prior[np.ix_(kept, kept)] + np.diag(targets.noise.numpy()[kept])
        gain = np.linalg.solve(inner, prior[kept, out])
        assert mean[out] == pytest.approx(gain @ targets.levels[kept], rel=1e-6)
        assert variance[out] == pytest.approx(prior[out, out] - gain @ prior[kept, out], rel=1e-6)


# ------------------------------------------------------------------------------------------------
# the method


def stars(kind: str, edges: F64, **how: object) -> Trajectories:
    """Segments of which one of a few verdicts is told."""

    def verdict(rewards: F64) -> float:
        longest = max(10, len(rewards))
        return 1.0 + float(np.searchsorted(edges, composite(kind, rewards, 3.0, longest)))

    return planted.memory(planted.progress, verdict, **how)


SETTINGS: dict[str, object] = {
    'method': 'evidence',
    'evidence.score_scale': 'ordinal',
    'delay': 10,
    'beta': 3.0,
    'memory_steps': 10_000,
}


def fitted(memory: Trajectories, **changes: object) -> Evidence:
    made = registry.make(builders.tiny(**SETTINGS | changes), O, A)
    assert isinstance(made, Evidence)
    made.prepare(memory)
    return made


LOPSIDED = np.array([-6.0, -5.0, -4.0, 3.0])
"""Four fifths of all segments are worth four stars: in numbers, stars are far from levels."""


@pytest.mark.parametrize('kind', ['sum', 'max'])
def test_credit_is_right_where_scores_are_one_to_five_stars(kind):
    edges = LOPSIDED if kind == 'sum' else np.array([-0.5, 0.0, 0.5, 2.0])
    data = stars(kind, edges, segments=200, noise=0.1)
    made = fitted(data, composite=kind)
    assert planted.within(made, data) > 0.9
    facts = made.report()
    assert len(facts['thresholds']) == 4
    assert facts['verdict_noise_sd'] > 0


@pytest.mark.parametrize('seed', range(4))
def test_fits_of_maxima_to_verdicts_do_not_diverge(seed):
    data = planted.memory(
        lambda s, a, after: after[:, 8] - 0.1 * (a * a).sum(1),
        lambda r: float(np.searchsorted([0.9, 1.2, 1.6, 2.0], composite('max', r, 3.0, 25))),
        delay=25,
        segments=120,
        seed=seed,
        components=20,
    )
    made = registry.make(
        builders.tiny(**SETTINGS | {'composite': 'max', 'delay': 25, 'seed': seed}), 20, A
    )
    assert isinstance(made, Evidence)
    made.prepare(data)
    assert planted.within(made, data) > 0.6
    assert str(made.report()['depends_on']).startswith("s'[8] +")


@pytest.mark.slow
@pytest.mark.parametrize('seed', range(3))
def test_fits_to_verdicts_about_maxima_that_are_mostly_alike_keep_the_likeliest_turn(seed):
    """Their turns go back and forth, and do not settle."""
    edges = np.array([-0.5, 0.0, 0.5, 2.0])
    made = registry.make(builders.tiny(**SETTINGS | {'composite': 'max', 'delay': 25}), O, A)
    assert isinstance(made, Evidence)
    for segments in (60, 100, 140):
        data = stars('max', edges, delay=25, segments=segments, noise=0.1, seed=seed)
        scores = data.segments.scores(data.segments.ids())
        assert (scores == 4).mean() > 0.7
        made.prepare(data)
        assert planted.within(made, data) > 0.9


def test_on_a_lopsided_scale_credit_is_better_than_with_stars_taken_for_numbers():
    within = {'ordinal': [], 'numbers': []}
    for seed in range(4):
        data = stars('sum', LOPSIDED, segments=60, noise=0.1, seed=seed)
        for scale, values in within.items():
            values.append(planted.within(fitted(data, **{'evidence.score_scale': scale}), data))
    assert np.mean(within['ordinal']) > np.mean(within['numbers']) + 0.02


@pytest.mark.parametrize('kind', ['sum', 'square_sum', 'sum_square'])
def test_a_robot_that_falls_soon_gets_no_better_steps_than_one_that_stands(kind):
    edges = [composite(kind, np.ones(m), 3.0, 10) for m in (5, 7, 9)]
    data = planted.memory(
        lambda s, a, after: np.ones(len(a)),  # it stands: all steps are worth as much
        lambda r: 1.0 + float(np.searchsorted(edges, composite(kind, r, 3.0, 10))),
        irregular=True,
        segments=120,
        terminated=True,  # it falls
    )
    made = fitted(data, composite=kind)
    ids = data.segments.all_ids()
    lengths = data.segments.lengths(ids)
    labels = np.concatenate(list(made.label_passes(data, ids)))
    means = np.add.reduceat(labels, np.cumsum(lengths) - lengths) / lengths
    short, long = (means[lengths == m].mean() for m in (5, 10))
    assert short < 1.01 * long
    assert np.corrcoef(made.predict(data.segments.batch(ids)), lengths)[0, 1] > 0.9


def test_where_the_run_has_levels_scores_are_verdicts_unless_settings_state_otherwise():
    data = stars('sum', LOPSIDED, segments=40)
    auto = fitted(data, score_levels=5, **{'evidence.score_scale': 'auto'})
    assert 'thresholds' in auto.report()
    for changes in ({'score_levels': 0}, {'score_levels': 5, 'evidence.score_scale': 'numbers'}):
        made = fitted(data, **{'evidence.score_scale': 'auto', **changes})
        assert 'thresholds' not in made.report()


def test_predicted_verdicts_agree_with_those_given():
    data = stars('sum', np.array([-2.0, 0.0, 2.0]), segments=200)
    made = fitted(data)
    batch = data.segments.batch(data.segments.ids(), made.context)
    predicted = made.predict(batch)
    assert predicted.min() >= 1 and predicted.max() <= 4
    assert np.corrcoef(predicted, batch.values)[0, 1] > 0.8


def labels_of(made: Evidence, data: Trajectories) -> F64:
    batch = data.segments.batch(data.segments.ids(), made.context)
    return made.label(batch)[segment_steps(batch)].astype(np.float64)


@pytest.mark.parametrize('kind', ['sum', 'max'])
def test_stars_are_no_rewards_by_themselves_unless_episodes_end_in_terminal_states(kind):
    """Where all steps have something positive in common, SAC learns that first."""
    edges = LOPSIDED if kind == 'sum' else np.array([-0.5, 0.0, 0.5, 2.0])
    time, terminal = (stars(kind, edges, segments=80, terminated=t) for t in (False, True))
    around, positive = (fitted(data, composite=kind) for data in (time, terminal))
    labels, as_numbers = labels_of(around, time), labels_of(positive, terminal)
    assert abs(labels.mean()) < 0.1 * labels.std()
    assert as_numbers.mean() > 0.5 * as_numbers.std()
    assert_allclose(labels - labels.mean(), as_numbers - as_numbers.mean(), atol=1e-5)
    batch = time.segments.batch(time.segments.ids(), around.context)
    assert_allclose(around.predict(batch), positive.predict(batch), rtol=1e-6)


def test_a_model_that_was_saved_before_labels_had_a_zero_goes_on_as_it_was():
    data = stars('sum', LOPSIDED, segments=60)
    made = fitted(data)
    zero = made.model.zero * made.model.scale / made.unit
    old = {name: tensor for name, tensor in made.state().items() if name != 'zero'}
    again = registry.make(builders.tiny(**SETTINGS), O, A)
    assert isinstance(again, Evidence)
    again.load_state(old)
    assert zero > 0
    assert_allclose(labels_of(again, data), labels_of(made, data) + zero, atol=1e-5)


def test_a_scale_that_is_saved_and_loaded_is_the_same_and_goes_on():
    data = stars('sum', LOPSIDED, segments=80)
    made = fitted(data)
    again = registry.make(builders.tiny(**SETTINGS), O, A)
    again.load_state(made.state())
    assert same(again.state(), made.state())
    batch = data.segments.batch(data.segments.ids(), made.context)
    np.testing.assert_array_equal(again.label(batch), made.label(batch))


def test_a_scale_of_another_size_is_refused_by_name():
    made = fitted(stars('sum', LOPSIDED, segments=40))
    state = {**made.state(), 'verdict_values': torch.tensor(saving.MOST_VALUES + 1)}
    with pytest.raises(RewardModelError, match='verdict_values = 33'):
        made.load_state(state)


def improving(seed: int, weights: F64) -> tuple[torch.Tensor, F64]:
    """Mean features and stars of a policy that soon gets five of them in every segment."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(160, len(weights)))
    rows[:, 0] = 1
    edges = np.quantile(rows[:20] @ weights, [0.2, 0.4, 0.6, 0.8])
    rows[20:, 1] = -2 - 0.5 * np.abs(rows[20:, 1])
    return torch.tensor(rows), 1.0 + np.searchsorted(edges, rows @ weights)


@pytest.mark.parametrize('seed', [0, 3, 5])
def test_while_verdicts_become_all_alike_fits_that_go_on_are_as_likely_as_those_begun_anew(seed):
    """A fit that stops in the midst of its turns can be far off when the next ones come."""
    weights = np.array([0, -1, 0.7, -0.5, 0.3, 0.2, 0, 0])
    rows, scores = improving(seed, weights)
    assert (scores[20:] == 5).mean() > 0.75
    blocks = [slice(i, i + 1) for i in range(8)]
    going_on = Model(links.make('sum', 1.0, 50, True), blocks)
    for n in range(20, 161, 20):
        sample = Sample(scores[:n], np.full(n, 50), rows[:n])
        anew = Model(links.make('sum', 1.0, 50, True), blocks)
        for model in (going_on, anew):
            model.scale = going_on.scale
            model.fit(sample, np.arange(n), True)
        assert going_on.evidence > anew.evidence - 0.4
        assert np.corrcoef(going_on.posterior.mean[1:], weights[1:])[0, 1] > 0.97


def test_scores_of_any_value_are_no_verdicts():
    data = planted.memory(planted.progress, lambda r: float(r.sum()), segments=50)
    with pytest.raises(RewardModelError, match=r'50 different values .* evidence\.score_scale to'):
        fitted(data)


def test_verdicts_that_come_later_go_on_from_the_scale_and_new_values_begin_anew():
    made = fitted(stars('sum', np.array([-2.0, 2.0]), segments=60))
    more = stars('sum', np.array([-2.0, 2.0]), segments=90)
    made.prepare(more)
    assert planted.within(made, more) > 0.9
    other = stars('sum', np.array([-4.0, -2.0, 2.0, 4.0]), segments=120)
    made.prepare(other)
    assert planted.within(made, other) > 0.9
    assert len(made.report()['thresholds']) == 4


def test_other_units_of_levels_change_nothing_but_units():
    moved = SCALE.moved(2.0, 3.0)
    at, over = np.array([0.3]), np.array([0.5])
    scores = SCALE.values[[2]]
    before, after = SCALE.expected(scores, at, over), moved.expected(scores, at * 2 + 3, over * 4)
    assert_allclose(after[0], before[0] * 2 + 3)
    assert_allclose(after[1], before[1] * 4)
    assert (moved.tau, moved.spread) == (0.8, 4.0)
