"""What every reward method makes of segments of any length."""

from typing import Any

import numpy as np
import pytest
import torch

from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.rewards import registry
from codetr_ros.rewards.base import RewardMethod, RewardModelError, segment_steps
from codetr_ros.rewards.rbt import Layout
from codetr_ros.seeding import generator, seed_torch
from helpers import builders, planted
from helpers.builders import ACTION as A
from helpers.builders import OBSERVATION as O

pytestmark = pytest.mark.usefixtures('one_thread')

DELAY = 9
every_method = pytest.mark.parametrize('method', [*registry.METHODS, 'codetr on evidence'])


def irregular(segments: int = 30) -> Trajectories:
    return planted.memory(
        planted.progress, lambda r: float(r.sum()), DELAY, segments, irregular=True
    )


def trained(method: str, memory: Trajectories, steps: int = 3, **changes: Any) -> RewardMethod:
    if method == 'codetr on evidence':
        method, changes = 'codetr', changes | {'codetr__base': 'evidence'}
    made = registry.make(builders.tiny(method=method, delay=f'4:{DELAY}', **changes), O, A)
    made.prepare(memory)
    for step in range(steps):
        seed_torch(0, step)
        made.gradient_step(memory, generator(0, step))
    return made


@every_method
def test_each_step_of_irregular_segments_gets_a_finite_label_and_nothing_else_does(method):
    memory = irregular()
    made = trained(method, memory)
    batch = memory.segments.batch(memory.segments.ids(), made.context)
    assert len(set(batch.lengths.tolist())) > 3
    labels, inside = made.label(batch), segment_steps(batch)
    assert np.isfinite(labels).all() and not labels[~inside].any()
    passes = np.concatenate(list(made.label_passes(memory, memory.segments.ids())))
    np.testing.assert_allclose(passes, labels[inside], rtol=1e-5, atol=1e-6)
    assert len(passes) == memory.steps


@pytest.mark.parametrize('scope', ['window', 'segment'])
def test_a_window_of_rbt_has_the_segments_right_before_whatever_their_lengths(scope):
    memory = irregular()
    changes = {'codetr__window': 30, 'rbt__attention_scope': scope}
    one, other = (trained('rbt', memory, 4, **changes) for _ in range(2))
    assert np.isfinite(one.label(memory.segments.batch(memory.segments.ids(), one.context))).all()
    assert all(torch.equal(one.state()[name], t) for name, t in other.state().items())


def test_segments_of_a_window_lie_side_by_side_without_a_gap():
    lengths = np.array([3, 1, 4, 2, 4])
    layout = Layout([3, 2], lengths)
    each = torch.zeros(5, 4)
    for i, m in enumerate(lengths.tolist()):
        each[i, :m] = torch.arange(m) + 10 * (i + 1)
    laid = layout.side_by_side(each)
    assert laid.tolist() == [
        [10, 11, 12, 20, 30, 31, 32, 33, 0, 0, 0, 0],
        [40, 41, 50, 51, 52, 53, 0, 0, 0, 0, 0, 0],
    ]
    inside = torch.arange(4) < torch.from_numpy(lengths)[:, None]
    assert torch.equal(layout.taken_apart(laid)[inside], each[inside])


# ------------------------------------------------------------------------------------------------
# segments without a score


def half_scored(segments: int = 30) -> tuple[Trajectories, np.ndarray]:
    """A memory that lacks the score of every third segment, and which ones these are."""
    known = irregular(segments)
    ids = known.segments.ids()
    missing = np.arange(len(ids)) % 3 == 1
    known.store.sources[0].scored.values[: len(ids)][missing] = np.nan
    known.segments.forget()
    return known, missing


@every_method
def test_segments_without_a_score_are_not_learnt_from_and_labelled_all_the_same(method):
    memory, missing = half_scored()
    every = memory.segments.all_ids()
    assert memory.segments.ids().tolist() == every[~missing].tolist()
    made = trained(method, memory)
    passes = list(made.label_passes(memory, every))
    labels = np.concatenate(passes)
    assert len(labels) == memory.steps and np.isfinite(labels).all()
    only = np.concatenate(list(made.label_passes(memory, every[missing])))
    inside = np.repeat(missing, memory.segments.lengths(every))
    np.testing.assert_allclose(labels[inside], only, rtol=1e-4, atol=1e-5)


@every_method
def test_the_other_labels_are_those_that_they_would_have_without_them(method):
    memory, missing = half_scored()
    every = memory.segments.all_ids()
    one, other = (trained(method, memory) for _ in range(2))
    scored = np.concatenate(list(one.label_passes(memory, every[~missing])))
    everything = np.concatenate(list(other.label_passes(memory, every)))
    inside = np.repeat(~missing, memory.segments.lengths(every))
    np.testing.assert_allclose(everything[inside], scored, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize('composite', ['sum', 'square_sum', 'max', 'peak_end'])
def test_the_even_spread_gives_steps_without_a_score_the_mean_of_the_known_levels(composite):
    memory, missing = half_scored()
    made = trained('uniform', memory, composite=composite, reward_unit='raw')
    every = memory.segments.all_ids()
    labels = np.split(
        np.concatenate(list(made.label_passes(memory, every))),
        np.cumsum(memory.segments.lengths(every))[:-1],
    )
    levels = [float(part[0]) for part, gone in zip(labels, missing, strict=True) if not gone]
    for part, gone in zip(labels, missing, strict=True):
        assert np.ptp(part) == 0
        if gone:
            assert part[0] == pytest.approx(np.mean(levels), rel=1e-5)


def test_the_raw_score_that_is_missing_is_that_of_a_segment_of_the_mean_level():
    memory, missing = half_scored()
    made = trained('none', memory, reward_unit='raw')
    ids, gone = memory.segments.ids(), memory.segments.all_ids()[missing]
    mean = (memory.segments.scores(ids) / memory.segments.lengths(ids)).mean()
    labels = np.concatenate(list(made.label_passes(memory, gone)))
    lengths = memory.segments.lengths(gone)
    assert np.add.reduceat(labels, np.cumsum(lengths) - lengths) == pytest.approx(mean * lengths)
    assert np.count_nonzero(labels) == len(gone)


def test_ircr_takes_a_missing_score_for_one_within_the_extremes():
    memory, missing = half_scored()
    made = trained('ircr', memory)
    labels = np.concatenate(list(made.label_passes(memory, memory.segments.all_ids()[missing])))
    assert (labels >= 0).all() and (labels <= 1).all() and labels.std() < 0.5


@pytest.mark.parametrize('composite', ['sum', 'sum_square', 'max'])
@pytest.mark.parametrize('scale', ['numbers', 'ordinal'])
def test_evidence_labels_steps_without_a_score_by_the_regression_alone(composite, scale):
    memory, missing = half_scored(60)
    values = memory.store.sources[0].scored.values[:60]
    if scale == 'ordinal':
        stars = np.digitize(values, np.nanquantile(values, [0.25, 0.5, 0.75])) + 1.0
        values[~missing] = stars[~missing]
    made = trained('evidence', memory, composite=composite, evidence__score_scale=scale)
    assert {type(fact) for fact in made.report().values()} <= {str, float, list}, 'goes into JSON'
    every = memory.segments.all_ids()
    batch = memory.segments.batch(every)
    labels = made.label(batch)
    assert batch.true_rewards is not None
    gone = (np.arange(len(labels)) % 3 == 1)[:, None] & segment_steps(batch)
    found, true = labels[gone], batch.true_rewards[gone]
    assert np.corrcoef(found, true)[0, 1] > (0.9 if composite == 'sum' else 0.6)


def test_evidence_is_the_more_cautious_where_there_is_no_score_the_less_it_knows_of_a_step():
    memory, missing = half_scored(60)
    bold, cautious = (
        trained('evidence', memory, evidence__caution=caution) for caution in (0.0, 2.0)
    )
    batch = memory.segments.batch(memory.segments.all_ids())
    inside = segment_steps(batch)
    unscored = inside & missing[:, None]
    far = np.linalg.norm(batch.observations[:, :-1][unscored], axis=-1)
    less = bold.label(batch) - cautious.label(batch)
    assert not less[inside & ~missing[:, None]].any(), 'a score is explained exactly'
    usual = bold.metrics()['step_sd']
    doubt = bold.uncertainty(batch).steps[unscored]
    np.testing.assert_allclose(less[unscored], 2 * (doubt - usual), atol=1e-6)  # float32
    less, common = less[unscored], np.median(far)
    assert less[far > 1.5 * common].mean() > less[far < common].mean(), 'rare steps are known less'


def test_rules_refuse_a_memory_in_which_nothing_is_scored():
    memory = irregular(6)
    made = trained('uniform', memory)
    memory.store.sources[0].scored.values[:] = np.nan
    memory.segments.forget()
    with pytest.raises(RewardModelError, match='6 segments have no score, and no other one'):
        list(made.label_passes(memory, memory.segments.all_ids()))
