"""What method `evidence` makes of step rewards that were planted: found again, and how surely."""

import numpy as np
import pytest
import torch

from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.rewards import registry
from codetr_ros.rewards.base import RewardMethod, RewardModelError, segment_steps
from codetr_ros.rewards.evidence.maxima import SoftMax
from codetr_ros.rewards.evidence.method import Evidence
from codetr_ros.rewards.evidence.regression import Posterior
from codetr_ros.simulation.composite import COMPOSITES, composite
from helpers import builders, linear_rewards, planted
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O
from helpers.tensors import same

pytestmark = pytest.mark.usefixtures('one_thread')

DELAY, BETA = 10, 1.5


def fitted(memory: Trajectories, **changes: object) -> Evidence:
    settings = {'method': 'evidence', 'delay': DELAY, 'beta': BETA, 'memory_steps': 10_000}
    made = registry.make(builders.tiny(**settings | changes), O, A)
    assert isinstance(made, Evidence)
    made.prepare(memory)
    return made


def told(kind: str, **how: object) -> Trajectories:
    """A running task of which composite rewards of a kind are told."""
    return planted.memory(planted.progress, lambda r: composite(kind, r, BETA, DELAY), **how)


def everything(made: RewardMethod, memory: Trajectories):
    return memory.segments.batch(memory.segments.ids(), made.context)


# ------------------------------------------------------------------------------------------------
# a kind of score that is known


def test_linear_rewards_are_found_again_from_their_sums_to_three_digits():
    data = linear_rewards.memory()
    made = fitted(data, delay=linear_rewards.DELAY, reward_unit='raw')
    batch = everything(made, data)
    true = linear_rewards.linear(
        batch.observations[:, :-1].astype(np.float64), batch.actions.astype(np.float64)
    )
    inside = segment_steps(batch)
    off = made.label(batch)[inside] - true[inside]
    assert np.sqrt(np.mean(off**2)) < 2e-2 * true[inside].std()


@pytest.mark.parametrize('kind', COMPOSITES)
def test_credit_within_segments_is_right_for_each_composite_reward(kind):
    data = told(kind, noise=0.1)
    assert planted.within(fitted(data, composite=kind), data) > 0.98


@pytest.mark.parametrize('kind', ['sum', 'sum_square', 'max'])
def test_credit_is_right_where_segments_are_of_any_length(kind):
    data = told(kind, noise=0.1, irregular=True)
    assert planted.within(fitted(data, composite=kind), data) > 0.98


@pytest.mark.parametrize('kind', COMPOSITES)
def test_the_labels_of_a_segment_have_its_very_score(kind):
    data = told(kind, segments=60, irregular=True)
    made = fitted(data, composite=kind, reward_unit='raw')
    if kind == 'max':
        assert isinstance(made.link, SoftMax)
        assert made.link.beta / made.target_scale == pytest.approx(BETA)
    batch = everything(made, data)
    for labels, length, value in zip(made.label(batch), batch.lengths, batch.values, strict=True):
        again = composite(kind, labels[:length].astype(np.float64), BETA, DELAY)
        assert again == pytest.approx(value, rel=1e-4, abs=1e-4)


def test_where_scores_have_nothing_to_do_with_steps_labels_are_the_even_spread():
    data = linear_rewards.noise()
    made = fitted(data, delay=linear_rewards.DELAY, reward_unit='raw')
    batch = everything(made, data)
    even = (batch.values / batch.lengths)[:, None]
    off = (made.label(batch) - even)[segment_steps(batch)]
    assert np.sqrt(np.mean(off**2)) < 0.25 * np.sqrt(np.mean(even**2))


def test_within_long_segments_credit_goes_by_where_a_step_leads():
    # sums over them hardly depend on whether s or s' is looked at: the changes cancel
    data = planted.memory(
        lambda s, a, after: 2 * after[:, 0] + after[:, 1] - 0.3 * (a * a).sum(1),
        lambda r: float(r.sum()),
        delay=250,
        segments=40,
        noise=0.3,
    )
    assert planted.within(fitted(data, delay=250), data) > 0.97


@pytest.mark.parametrize('seed', range(3))
def test_few_scores_show_on_which_of_many_components_the_reward_depends(seed):
    data = planted.memory(
        lambda s, a, after: after[:, 8] - 0.1 * (a * a).sum(1),
        lambda r: composite('max', r, 3.0, 100),
        delay=100,
        segments=40,
        seed=seed,
        components=20,
    )
    settings = builders.tiny(method='evidence', composite='max', beta=3.0, delay=100, seed=seed)
    made = registry.make(settings, 20, A)
    assert isinstance(made, Evidence)
    made.prepare(data)
    assert planted.within(made, data) > 0.9
    assert str(made.report()['depends_on']).startswith("s'[8] +")


def test_a_constant_score_is_spread_evenly():
    data = planted.memory(planted.progress, lambda r: 30.0, segments=40)
    labels = fitted(data, reward_unit='raw').label(everything(fitted(data), data))
    np.testing.assert_allclose(labels, 3.0, rtol=0.05)


def test_scores_of_zero_give_labels_of_zero():
    data = planted.memory(planted.progress, lambda r: 0.0, segments=5)
    made = fitted(data)
    assert np.abs(made.label(everything(made, data))).max() < 1e-6


@pytest.mark.parametrize('kind', ['sum', 'sum_square', 'max'])
@pytest.mark.parametrize('link', ['known', 'choose'])
def test_a_single_score_is_enough_to_begin_with(kind, link):
    data = told(kind, segments=1)
    made = fitted(data, composite=kind, evidence__link=link)
    assert np.isfinite(made.label(everything(made, data))).all()


@pytest.mark.parametrize('huge', [1e-12, 1e12])
def test_the_unit_of_scores_does_not_matter(huge):
    plain, scaled = (
        planted.memory(planted.progress, lambda r, f=f: f * float(r.sum()), segments=40)
        for f in (1.0, huge)
    )
    one, other = (fitted(d).label(everything(fitted(d), d)) for d in (plain, scaled))
    np.testing.assert_allclose(one, other, rtol=1e-3, atol=1e-3)


# ------------------------------------------------------------------------------------------------
# how surely


@pytest.mark.parametrize('kind', ['sum', 'max'])
def test_intervals_cover_the_step_rewards_and_held_out_scores_as_often_as_they_state(kind):
    # F is taken as linear over the noise of steps: with much of it a maximum lies above
    noise = 0.3 if kind == 'sum' else 0.1
    data, others = told(kind, noise=noise), told(kind, noise=noise, seed=1)
    made = fitted(data, composite=kind, reward_unit='raw')
    batch = everything(made, others)
    known = made.uncertainty(batch)
    inside = segment_steps(batch)
    assert (known.steps[inside] > 0).all() and not known.steps[~inside].any()
    f = predicted(made, batch)
    off = (batch.true_rewards - f)[inside] / known.steps[inside]
    assert 0.85 < np.mean(np.abs(off) < 1.645) < 0.95
    level = f.mean(1) if kind == 'sum' else [composite('max', r, BETA, DELAY) for r in f]
    due = batch.values / DELAY if kind == 'sum' else batch.values
    covered = np.abs(due - np.array(level)) < 1.645 * known.segments
    assert 0.82 < covered.mean() < 0.97


def predicted(made: Evidence, batch) -> np.ndarray:
    """Step rewards (B, L) as predicted without the segments' own scores, in the task's unit."""
    from codetr_ros.rewards.evidence.features import step_inputs

    rows = [
        made._features(step_inputs(s[:-1], a, s[1:])).double() @ made._model.posterior.mean
        for s, a in zip(batch.observations, batch.actions, strict=True)
    ]
    return np.stack(rows) * made._model.scale


def test_fewer_scores_leave_it_less_sure():
    few, many = (told('sum', segments=n, noise=0.1) for n in (15, 200))
    others = told('sum', segments=20, seed=2)
    made = [fitted(d, reward_unit='raw') for d in (few, many)]
    steps = [m.uncertainty(everything(m, others)).steps.mean() for m in made]
    assert steps[1] < 0.7 * steps[0]


def test_metrics_state_how_sure_the_newest_steps_and_segments_are():
    data = told('sum', segments=40)
    made = fitted(data)
    batch = everything(made, data)
    found, metrics = made.uncertainty(batch), made.metrics()
    assert metrics['step_sd'] == pytest.approx(found.steps[segment_steps(batch)].mean(), rel=1e-5)
    assert metrics['segment_sd'] == pytest.approx(found.segments.mean(), rel=1e-5)
    np.testing.assert_array_equal(made.step_deviations(batch), found.steps)


# ------------------------------------------------------------------------------------------------
# a kind of score that is not known


@pytest.mark.parametrize('kind', ['sum', 'square_sum', 'sum_square', 'max', 'minimum'])
def test_the_kind_of_score_is_named_from_the_scores_alone(kind):
    hidden = 'sum' if kind != 'sum' else 'max'  # what the settings state must not matter
    data = told(kind, noise=0.1, segments=120)
    made = fitted(data, composite=hidden, evidence__link='choose')
    report = made.report()
    assert report['link'] == kind and report['link_is'] == 'chosen'
    assert report['link_probability'] > 0.9 and report['link_margin'] > 2
    assert planted.within(made, data) > 0.97
    if kind in ('max', 'minimum'):
        assert report['beta'] == pytest.approx(BETA, rel=0.1)


@pytest.fixture(scope='module')
def undecided() -> tuple[Evidence, Trajectories]:
    """Two links that are about as likely: scores of two steps, which hardly differ from means."""
    for seed in range(20):
        data = planted.memory(
            planted.progress, lambda r: composite('max', r, 0.3, 2), 2, segments=14, seed=seed
        )
        made = fitted(data, delay=2, evidence__link='choose')
        if 'mixed_with' in made.report():
            return made, data
    raise AssertionError('no seed was undecided')


def test_where_two_links_are_close_labels_are_their_mean_by_probability(undecided):
    made, data = undecided
    (share, best), (other, second) = made._mixture
    assert share + other == pytest.approx(1) and 0.04 < other <= 0.5
    assert other / share == pytest.approx(np.exp(second.evidence - best.evidence))
    batch = everything(made, data)
    m = batch.lengths - batch.context
    parts = [
        part * model.scale * model.labels(made._f(batch, model), batch.values, m)
        for part, model in ((share, best), (other, second))
    ]
    np.testing.assert_allclose(
        made.label(batch)[segment_steps(batch)], sum(parts) / made.unit, rtol=1e-5
    )
    assert made.report()['mixed_with'] == second.link.name


def test_a_mixture_is_saved_and_goes_on_to_the_bit(undecided):
    made, data = undecided
    again = registry.make(made._settings, O, A)
    again.load_state(made.state())
    assert same(again.state(), made.state())
    assert again.label(everything(made, data)).tobytes() == (
        made.label(everything(made, data)).tobytes()
    )


# ------------------------------------------------------------------------------------------------
# phase by phase


def grown(phases: int) -> Trajectories:
    """A memory after so many phases of two episodes."""
    memory = linear_rewards.memory((40, 43))
    for phase in range(1, phases):
        linear_rewards.memory((64, 21), seed=phase, into=memory)
    return memory


@pytest.mark.parametrize('composite', ['sum', 'sum_square', 'max'])
def test_a_run_that_is_taken_up_again_goes_on_to_the_bit(composite):
    how = {'delay': linear_rewards.DELAY, 'composite': composite}
    through = fitted(grown(1), **how)
    memory = grown(1)
    through.prepare(memory)
    for phase in (1, 2):
        linear_rewards.memory((64, 21), seed=phase, into=memory)
        through.prepare(memory)
        if phase == 1:
            state = {name: tensor.clone() for name, tensor in through.state().items()}
    later = registry.make(through._settings, O, A)
    later.load_state(state)
    later.prepare(grown(3))
    assert through.version == later.version == 3
    assert same(later.state(), through.state())
    one, other = (m.label(everything(m, memory)) for m in (through, later))
    assert one.tobytes() == other.tobytes()


def test_a_fit_that_few_scores_led_astray_is_mended_once_there_are_twice_as_many():
    few, many = told('max', segments=100), told('max', segments=200)
    made = fitted(few, composite='max')
    model = made._model
    astray = torch.randn(len(model.posterior.mean), dtype=torch.float64) * 3
    model.posterior = Posterior(astray, model.posterior.covariance)
    model.theta[:] = 12.0  # all of it is noise, and anything goes
    again = registry.make(made._settings, O, A)
    again.load_state(made.state())
    assert planted.within(again, many) < 0.5
    again.prepare(many)
    assert planted.within(again, many) > 0.98


def test_moments_are_renewed_once_the_steps_have_moved_on_and_not_before():
    memory = linear_rewards.memory((64, 64))
    made = fitted(memory, delay=linear_rewards.DELAY)
    first = made.state()['input_mean']
    linear_rewards.memory((8,), seed=1, into=memory)
    made.prepare(memory)
    assert made.version == 2 and torch.equal(made.state()['input_mean'], first)
    far = linear_rewards.memory((64,) * 8, seed=2)
    made.prepare(far)
    observations = np.concatenate(
        [far.segments.batch(far.segments.ids()[i : i + 1]).observations[0, 1:] for i in range(64)]
    )
    expected = observations.astype(np.float64).mean(0)
    assert np.abs(first[:O].numpy() - expected).max() > 0.3
    np.testing.assert_allclose(made.state()['input_mean'][:O], expected, rtol=1e-9)


def test_what_is_known_of_a_segment_has_the_same_bits_whatever_else_is_looked_at():
    data = told('sum', segments=30, irregular=True)
    made = fitted(data)
    ids = data.segments.ids()
    for steps in (False, True):
        whole = made._sampler.sample(data, ids, steps).rows
        made._sampler.forget()
        alone = [made._sampler.sample(data, ids[i : i + 1], steps).rows for i in range(30)]
        assert torch.equal(torch.cat(alone), whole)


def test_a_failure_names_the_scores_and_the_remedy():
    data = planted.memory(planted.progress, lambda r: 1e200 * float(r.sum()), segments=20)
    with pytest.raises(RewardModelError, match='scores between .* Look for scores that are far'):
        fitted(data)


@pytest.mark.slow
def test_none_of_two_hundred_random_fits_fails():
    for seed in range(200):
        rng = np.random.default_rng(seed)
        kind = str(rng.choice(list(COMPOSITES)))
        delay, unit = int(rng.integers(1, 40)), 10 ** rng.uniform(-6, 6)
        steps = rng.normal(size=4) * rng.integers(0, 2, 4)  # some make no difference at all

        def reward(s, a, after, w=steps):
            return w[0] * s[:, 0] + w[1] * after[:, 1] ** 2 + w[2] * a[:, 0] + w[3]

        def score(r, unit=unit, kind=kind, delay=delay, rng=rng):
            return composite(kind, unit * r, BETA / unit, delay) * rng.normal(1.0, 0.3)

        data = planted.memory(
            reward,
            score,
            delay=delay,
            segments=int(rng.integers(1, 60)),
            seed=seed,
            noise=float(rng.choice([0.0, 0.5])),
            irregular=bool(rng.integers(2)),
        )
        made = fitted(data, composite=kind, delay=delay, beta=BETA, seed=seed)
        batch = everything(made, data)
        known = made.uncertainty(batch)
        where = f'seed {seed}, {kind} of {delay} steps in units of {unit:g}'
        assert np.isfinite(made.label(batch)).all(), where
        assert np.isfinite(known.steps).all() and np.isfinite(known.segments).all(), where
        made.prepare(linear_rewards.memory((delay * 3,), delay, seed=seed))
        assert np.isfinite(made.label(batch)).all(), where
