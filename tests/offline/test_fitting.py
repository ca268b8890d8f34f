"""Fitting on whole bags: what is held out, how much is held in memory, which weights are kept."""

import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import torch

from codetr_ros.bags.reader import Bag
from codetr_ros.offline import fitting
from codetr_ros.offline.cutting import stretches
from codetr_ros.offline.episodes import Index
from codetr_ros.offline.errors import FitError
from codetr_ros.offline.judging import judge
from codetr_ros.offline.loading import load, newest
from codetr_ros.offline.settings import FitSettings
from codetr_ros.records import CompositeReward, TrueRewards
from codetr_ros.runs import checkpoints
from helpers.builders import score, tiny, transitions
from helpers.foreign_bags import write

SIZES = 3, 2
DELAY = 7
EPISODE = 28


def records(count, seed=0, size=3):
    """Episodes of random steps; a step's reward is its first observation."""
    rng = np.random.default_rng(seed)
    n = 0
    for episode in range(count):
        observations = rng.normal(size=(EPISODE + 1, size)).astype(np.float32)
        yield transitions(
            sequence=episode,
            episode=episode,
            steps=EPISODE,
            observations=observations,
            actions=rng.uniform(-1, 1, (EPISODE, 2)).astype(np.float32),
            truncated=True,
        )
        true = observations[:-1, 0]
        yield TrueRewards(
            run_id='run',
            source='sim',
            sequence=episode,
            phase=0,
            episode=episode,
            first_step=0,
            rewards=true,
        )
        for first in range(0, EPISODE, DELAY):
            value = float(true[first : first + DELAY].sum())
            yield score(sequence=n, episode=episode, first_step=first, value=value)
            n += 1


def prepared(tmp_path, count=20, size=3):
    bag = Bag(write(tmp_path / 'bag', records(count, size=size)))
    found = stretches(Index([bag]).read(), DELAY, 10_000).usable
    return [bag], found


def how(**changes):
    return FitSettings(gradient_steps=40, check_every=10, patience=100).model_copy(update=changes)


def test_a_memory_holds_the_very_steps_scores_and_true_rewards_of_the_bag(tmp_path):
    bags, found = prepared(tmp_path, 3)
    expected = [r for r in records(3) if not isinstance(r, TrueRewards)]
    chunks = [r for r in expected if hasattr(r, 'observations')]

    loaded = load(bags, found, SIZES, DELAY, true_rewards=True)

    ids = loaded.memory.segments.ids()
    batch = loaded.memory.segments.batch(ids)
    _, episodes, firsts, _ = loaded.memory.segments.spans(ids)[0]
    assert len(ids) == 12
    for i, (episode, first) in enumerate(zip(episodes, firsts, strict=True)):
        chunk = chunks[episode]
        span = slice(first, first + DELAY)
        assert np.array_equal(batch.observations[i], chunk.observations[first : first + DELAY + 1])
        assert np.array_equal(batch.actions[i], chunk.actions[span])
        assert np.array_equal(batch.true_rewards[i], chunk.observations[span, 0])
        assert batch.values[i] == pytest.approx(chunk.observations[span, 0].sum(), rel=1e-6)


def test_true_rewards_that_a_bag_has_not_are_nan_not_numbers(tmp_path):
    bag = Bag(write(tmp_path / 'bag', (r for r in records(2) if not isinstance(r, TrueRewards))))
    found = stretches(Index([bag]).read(), DELAY, 100).usable

    batch = (loaded := load([bag], found, SIZES, DELAY, true_rewards=True)).memory.segments.batch(
        loaded.memory.segments.ids()
    )

    assert np.isnan(batch.true_rewards).all()


@pytest.mark.parametrize('power', [300, 100, -450, -600])
def test_scores_of_any_size_teach_the_same(tmp_path, power):
    """The size is a power of two, so that no bit but those of the exponent differs."""
    states = []
    for factor in (1.0, 2.0**power):
        scored = [
            replace(r, value=r.value * factor) if isinstance(r, CompositeReward) else r
            for r in records(12)
        ]
        bag = Bag(write(tmp_path / f'bag {factor}', scored))
        plan = fitting.plan(stretches(Index([bag]).read(), DELAY, 10_000).usable, tiny(), how())
        fitted = fitting.fit([bag], plan, SIZES, tiny(method='mlp'), how(), lambda check: None)
        judged = judge(fitted.method, fitted.held_out)
        states.append((fitted.method.state(), judged.metrics['composite_r2']))
    (plain, r2), (scaled, scaled_r2) = states
    scale = float(plain['target_scale'])
    assert float(scaled['target_scale']) == pytest.approx(scale * factor, rel=1e-12)
    for name in plain.keys() - {'target_scale'}:
        # the squares of the smallest underflow: their scale is found in another way
        assert torch.allclose(plain[name], scaled[name], rtol=1e-3, atol=1e-5), name
        assert power == -600 or torch.equal(plain[name], scaled[name]), name
    assert scaled_r2 == pytest.approx(r2, rel=1e-4)


def test_a_score_beyond_all_measure_is_left_out_and_counted(tmp_path):
    plain = [r for r in records(3) if not isinstance(r, TrueRewards)]
    first = next(i for i, r in enumerate(plain) if isinstance(r, CompositeReward))
    plain[first] = replace(plain[first], value=-1e300)
    index = Index([Bag(write(tmp_path / 'bag', plain))]).read()
    assert index.scores == 11
    assert index.skipped == {'scores beyond 1e+100': 1}


def test_a_bag_that_has_changed_since_it_was_indexed_is_refused(tmp_path):
    bags, found = prepared(tmp_path, 3)
    gone = [replace(found[0], episode=99), *found[1:]]

    with pytest.raises(FitError, match='has changed since it was indexed: steps of 1 episodes'):
        load(bags, gone, SIZES, DELAY)


def test_what_is_held_out_is_a_share_of_the_steps_chosen_by_seed_and_never_learnt_from(tmp_path):
    _, found = prepared(tmp_path)
    made = [fitting.plan(found, tiny(seed=seed), how(validation=0.25)) for seed in (0, 0, 1)]

    for plan in made:
        assert len(plan.held_out) == 5
        assert {*plan.held_out} | {*plan.learnt} == {*found}
        assert not {*plan.held_out} & {*plan.learnt}
    assert made[0].held_out == made[1].held_out != made[2].held_out


def test_one_episode_alone_cannot_be_judged(tmp_path):
    _, found = prepared(tmp_path, 1)
    with pytest.raises(FitError, match='there is 1 episode with scores: one to learn from and'):
        fitting.plan(found, tiny(), how())


def test_an_episode_that_does_not_fit_into_the_memory_is_refused(tmp_path):
    _, found = prepared(tmp_path)
    with pytest.raises(
        FitError, match='28 steps does not fit into memory_steps = 50, of which 28'
    ):
        fitting.plan(found, tiny(memory_steps=50), how())


def test_the_parts_of_each_turn_hold_everything_once_and_fit_into_the_memory(tmp_path):
    _, found = prepared(tmp_path)
    plan = fitting.plan(found, tiny(memory_steps=200), how())
    assert plan.passes == 4

    dealt = fitting.parts(plan, 0)
    turns = {0: [], 1: []}
    for turn, part in dealt:
        if turn == 2:
            break
        assert sum(s.steps for s in part) <= plan.capacity == 200 - 28
        turns[turn].append(part)
    for parts in turns.values():
        assert sorted(id(s) for part in parts for s in part) == sorted(map(id, plan.learnt))
    assert turns[0] != turns[1]


def test_more_steps_than_the_memory_holds_are_never_in_memory(tmp_path):
    bags, found = prepared(tmp_path, 100)
    settings = tiny(memory_steps=600)
    plan = fitting.plan(found, settings, how())
    assert plan.passes == 6

    fitted = fitting.fit(bags, plan, SIZES, settings, how(part_steps=5))

    assert 500 < fitted.most_steps <= 600
    assert fitted.reads == 1 + 8  # what is held out, and a part for every 5 of 40 gradient steps


def test_loading_a_part_of_a_bag_takes_memory_for_the_part_however_long_the_bag(tmp_path):
    peaks = []
    for count in (400, 1200):
        bags, found = prepared(tmp_path / str(count), count, size=100)
        part = found[:: count // 20]  # from all over the bag, which has many chunks of a megabyte
        tracemalloc.start()
        load(bags, part, (100, 2), DELAY)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < 1.1 * peaks[0]


@pytest.mark.slow
def test_the_fit_learns_and_keeps_the_weights_of_the_lowest_held_out_loss(tmp_path):
    bags, found = prepared(tmp_path, 60)
    settings = tiny(memory_steps=10_000, **{'codetr.learning_rate': 0.01})
    plan = fitting.plan(found, settings, how())

    fitted = fitting.fit(bags, plan, SIZES, settings, how(gradient_steps=300))

    losses = [check.held_out_loss for check in fitted.curve]
    assert [check.gradient_steps for check in fitted.curve] == list(range(0, 301, 10))
    assert min(losses) < 0.7 * losses[0]
    assert fitted.best.held_out_loss == min(losses)
    assert fitting.held_out_loss(fitted.method, fitted.held_out) == min(losses)
    assert fitted.method.gradient_steps == fitted.best.gradient_steps
    assert fitted.stopped == 'after 300 gradient steps, as many as allowed'


def test_the_fit_ends_early_when_the_held_out_loss_does_not_fall(tmp_path):
    bags, found = prepared(tmp_path)
    settings = tiny(**{'codetr.learning_rate': 1e-12, 'codetr.dropout': 0.0})
    plan = fitting.plan(found, settings, how())

    fitted = fitting.fit(bags, plan, SIZES, settings, how(gradient_steps=10_000, patience=3))

    last = fitted.curve[-1].gradient_steps
    assert last == fitted.best.gradient_steps + 30
    assert fitted.stopped == 'early: the held-out loss has not fallen for 30 gradient steps'


def test_ctrl_c_keeps_the_best_weights_so_far(tmp_path):
    bags, found = prepared(tmp_path)
    plan = fitting.plan(found, tiny(), how())

    def interrupt(check):
        if check.gradient_steps == 20:
            raise KeyboardInterrupt

    fitted = fitting.fit(bags, plan, SIZES, tiny(), how(), interrupt)

    assert fitted.stopped == 'before its time, by Ctrl-C'
    assert [check.gradient_steps for check in fitted.curve] == [0, 10, 20]
    assert fitting.held_out_loss(fitted.method, fitted.held_out) == fitted.best.held_out_loss


def test_training_that_diverges_keeps_the_best_weights_so_far(tmp_path):
    huge = (
        replace(r, value=r.value * 1e30) if isinstance(r, CompositeReward) else r
        for r in records(20)
    )
    bag = Bag(write(tmp_path / 'bag', huge))
    found = stretches(Index([bag]).read(), DELAY, 100).usable
    settings = tiny(target_scale='none')
    plan = fitting.plan(found, settings, how())

    fitted = fitting.fit([bag], plan, SIZES, settings, how())

    assert 'reward_loss is inf at gradient step 0: training has diverged' in fitted.stopped
    assert fitted.best.gradient_steps == fitted.method.gradient_steps == 0


def test_the_same_seed_gives_the_same_weights_and_another_one_others(tmp_path):
    bags, found = prepared(tmp_path)
    digests = []
    for seed in (0, 0, 1):
        settings = tiny(seed=seed)
        plan = fitting.plan(found, settings, how())
        fitted = fitting.fit(bags, plan, SIZES, settings, how())
        digests.append(checkpoints.digest(fitted.method.state()))
    assert digests[0] == digests[1] != digests[2]


def test_the_newest_stretches_fill_a_memory_from_the_end(tmp_path):
    _, found = prepared(tmp_path)
    assert list(newest(found, 3 * EPISODE - 1)) == [found[-1], found[-2]]
    assert list(newest(found, 1)) == [found[-1]]
