"""Reward models from preferences, against step rewards that are known."""

import numpy as np
import pytest

from codetr_ros.config.cuts import Cuts
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import CompositeReward, Preference
from codetr_ros.rewards import registry
from codetr_ros.runs.reports import PREFERENCES_UNUSED
from helpers import builders
from helpers.builders import ACTION, OBSERVATION, tiny

DELAY, SEGMENTS = 10, 160
LEARNED = ['codetr', 'rbt', 'rrd', 'diaster', 'lrr', 'mil_lstm', 'mlp', 'aggregate']


def planted(pairs, scores=0, noise=0.0, seed=0):
    """A memory of segments of a linear reward, some of them compared; and the true rewards."""
    rng = np.random.default_rng(seed)
    steps = DELAY * SEGMENTS
    s = rng.normal(size=(steps + 1, OBSERVATION)).astype(np.float32)
    a = rng.uniform(-1, 1, (steps, ACTION)).astype(np.float32)
    rewards = s[1:, 0] - 0.5 * s[1:, 1] + 0.3 * a[:, 0]
    memory = Trajectories(OBSERVATION, ACTION, DELAY, steps + 1, 1000, cuts=Cuts(DELAY, 0))
    memory.append(builders.transitions(steps=steps, observations=s, actions=a, truncated=True))
    worth = rewards.reshape(SEGMENTS, DELAY).sum(1)
    for n in range(scores):
        memory.judge(
            builders.score(scorer='me', first_step=DELAY * n, length=DELAY, value=float(worth[n]))
        )
    for _ in range(pairs):
        first, second = rng.choice(SEGMENTS, 2, replace=False).tolist()
        gap = worth[first] - worth[second] + noise * rng.normal()
        memory.judge(compared(first, second, float(gap > 0)))
    memory.settle()
    return memory, rewards, worth


def compared(first, second, outcome, scorer='me'):
    return Preference(
        run_id='run',
        scorer=scorer,
        sequence=0,
        source='sim',
        episode=0,
        first_step=DELAY * first,
        length=DELAY,
        other_source='sim',
        other_episode=0,
        other_first_step=DELAY * second,
        other_length=DELAY,
        outcome=outcome,
    )


def trained(memory, gradient_steps=0, **changes):
    settings = tiny(scorer='topic', delay=DELAY, **changes)
    method = registry.make(settings, OBSERVATION, ACTION)
    method.prepare(memory)
    for step in range(gradient_steps):
        method.gradient_step(memory, np.random.default_rng(step))
    return method


def correlations(method, memory, rewards, worth):
    """Of step rewards, and of predicted scores, with the true ones."""
    batch = memory.segments.batch(memory.segments.all_ids())
    labels = method.label(batch).astype(np.float64).reshape(-1)
    return np.corrcoef(labels, rewards)[0, 1], np.corrcoef(method.predict(batch), worth)[0, 1]


@pytest.mark.parametrize(('pairs', 'noise', 'least'), [(100, 0.0, 0.9), (300, 2.0, 0.85)])
def test_evidence_recovers_a_linear_reward_from_preferences_alone(pairs, noise, least):
    memory, rewards, worth = planted(pairs, noise=noise)
    method = trained(memory, method='evidence', composite='sum', evidence__link='known')
    steps, segments = correlations(method, memory, rewards, worth)
    assert steps > least
    assert segments > least


def test_preferences_add_to_what_few_scores_teach_and_keep_their_unit():
    few = trained(planted(0, scores=4)[0], method='evidence', evidence__link='known')
    memory, rewards, worth = planted(150, scores=4)
    both = trained(memory, method='evidence', evidence__link='known')
    less, _ = correlations(few, memory, rewards, worth)
    more, _ = correlations(both, memory, rewards, worth)
    assert more > 0.97 > less
    batch = memory.segments.batch(memory.segments.all_ids())
    slope = np.polyfit(worth, both.predict(batch), 1)[0]
    assert 0.5 < slope < 1.5  # in the unit of the scores, not in one of their own


@pytest.mark.parametrize('method', LEARNED)
def test_networks_learn_from_preferences_alone(method):
    memory, rewards, worth = planted(300)
    changes = {f'{method}__learning_rate': 3e-3} if method not in ('rbt', 'codetr') else {}
    changes |= {'codetr__learning_rate': 1e-3, 'codetr__dropout': 0.0}
    steps = 40 if method in ('rbt', 'codetr') else 120
    made = trained(memory, steps, method=method, **changes)
    _, segments = correlations(made, memory, rewards, worth)
    assert segments > 0.5


def test_what_is_preferred_gets_the_better_score_whichever_way_round_it_was_stated():
    memory, rewards, worth = planted(0)
    order = np.argsort(worth)
    for low, high in zip(order[:40].tolist(), order[-40:].tolist(), strict=True):
        memory.judge(compared(high, low, 1.0) if low < high else compared(low, high, 0.0))
    memory.settle()
    method = trained(memory, method='evidence', evidence__link='known')
    assert correlations(method, memory, rewards, worth)[1] > 0.7


def test_of_two_segments_that_differ_in_length_alone_the_preferred_one_gets_the_better_score():
    rng, lengths = np.random.default_rng(0), np.tile([3, 6, 8, 10], 10)
    memory = Trajectories(OBSERVATION, ACTION, DELAY, 1000, 1000, cuts=Cuts(DELAY, 0))
    for episode, steps in enumerate(lengths.tolist()):
        memory.append(
            builders.transitions(
                sequence=episode, episode=episode, steps=steps, terminated=True,
                observations=rng.normal(size=(steps + 1, OBSERVATION)).astype(np.float32),
                actions=rng.uniform(-1, 1, (steps, ACTION)).astype(np.float32),
            )
        )  # fmt: skip
    for _ in range(60):
        first, second = rng.choice(len(lengths), 2, replace=False).tolist()
        m, n = int(lengths[first]), int(lengths[second])
        memory.judge(
            Preference(
                run_id='run', scorer='me', sequence=0,
                source='sim', episode=first, first_step=0, length=m,
                other_source='sim', other_episode=second, other_first_step=0, other_length=n,
                outcome=0.5 + 0.5 * float(np.sign(m - n)),
            )
        )  # fmt: skip
    memory.settle()
    made = trained(memory, method='evidence', composite='sum', evidence__link='known')
    batch = memory.segments.batch(memory.segments.all_ids())
    assert np.corrcoef(made.predict(batch), batch.lengths)[0, 1] > 0.9
    assert made.label(batch)[batch.lengths == DELAY].mean() > 0


def test_a_later_preference_for_the_same_two_segments_replaces_the_former():
    memory = planted(0)[0]
    memory.judge(compared(3, 5, 1.0))
    memory.judge(compared(5, 3, 1.0))  # the other way round: 5 is better
    memory.judge(compared(7, 8, 1.0))
    memory.judge(compared(7, 8, float('nan')))  # cannot decide after all
    memory.judge(compared(3, 5, 0.5, scorer='you'))
    pairs = memory.judgements.pairs()
    assert sorted(pairs.outcomes.tolist()) == [0.0, 0.5]
    assert memory.judgements.counts == {'corrections': 2, 'cannot tell': 1}


def test_a_model_is_the_same_bits_where_nobody_compares():
    memory = planted(0, scores=30)[0]
    assert len(memory.judgements.pairs()) == 0
    first, second = (trained(memory, 5, method='mlp').state() for _ in range(2))
    assert all((first[name] == second[name]).all() for name in first)


def test_methods_that_cannot_use_preferences_state_so():
    can = {
        name: registry.make(
            tiny(scorer='topic', method=name), OBSERVATION, ACTION
        ).uses_preferences
        for name in (*LEARNED, 'evidence', 'uniform', 'none', 'random', 'ircr')
    }
    assert {name for name, uses in can.items() if uses} == {*LEARNED, 'evidence'}
    chosen = tiny(scorer='topic', method='evidence', evidence__link='choose')
    assert not registry.make(chosen, OBSERVATION, ACTION).uses_preferences
    soft = tiny(scorer='topic', method='evidence', composite='max', evidence__link='known')
    assert not registry.make(soft, OBSERVATION, ACTION).uses_preferences


@pytest.mark.parametrize(
    ('changes', 'scores', 'aside'),
    [
        ({}, 30, {}),
        ({'evidence__link': 'choose'}, 30, {PREFERENCES_UNUSED: 20}),
        ({'composite': 'max'}, 30, {PREFERENCES_UNUSED: 20}),
        ({'composite': 'peak_end'}, 30, {PREFERENCES_UNUSED: 20}),
        ({'evidence__score_scale': 'ordinal'}, 30, {}),
        ({'method': 'uniform'}, 30, {PREFERENCES_UNUSED: 20}),
        ({'method': 'codetr', 'codetr__base': 'evidence', 'composite': 'max'}, 30,
         {PREFERENCES_UNUSED: 20}),
    ],
    ids=range(7),
)  # fmt: skip
def test_judgements_that_are_not_learnt_from_as_they_were_stated_are_counted(
    changes, scores, aside
):
    memory = planted(20, scores=scores)[0]
    method = registry.make(
        tiny(**({'scorer': 'topic', 'delay': DELAY, 'method': 'evidence'} | changes)),
        OBSERVATION,
        ACTION,
    )
    assert len(memory.judgements.pairs()) == 20
    assert method.set_aside(memory) == aside


def test_a_score_is_not_mistaken_for_a_preference():
    memory = planted(0)[0]
    memory.judge(
        CompositeReward(
            run_id='run',
            source='sim',
            scorer='me',
            sequence=0,
            episode=0,
            first_step=0,
            length=DELAY,
            value=3.0,
        )
    )
    memory.settle()
    assert len(memory.judgements.pairs()) == 0
    assert memory.segments.scores(memory.segments.ids()).tolist() == [3.0]


@pytest.mark.parametrize('stars', [True, False], ids=['few different scores', 'numbers'])
def test_scores_of_a_person_are_verdicts_where_few_of_them_differ(stars):
    memory, rewards, worth = planted(0)
    values = np.digitize(worth, np.quantile(worth, [0.5, 0.8, 0.9])) + 1.0 if stars else worth
    for n, value in enumerate(values.tolist()):
        memory.judge(builders.score(scorer='me', first_step=DELAY * n, length=DELAY, value=value))
    memory.settle()
    made = trained(memory, method='evidence', composite='sum')
    assert ('thresholds' in made.report()) == stars
    labels = np.concatenate(list(made.label_passes(memory, memory.segments.all_ids())))
    assert np.corrcoef(labels, rewards)[0, 1] > 0.9


@pytest.mark.parametrize('pairs', [20, 60])
def test_verdicts_beside_preferences_are_taken_for_their_order_alone(pairs):
    memory, rewards, worth = planted(pairs)
    edges = np.quantile(worth, [0.1, 0.3, 0.4, 0.5])
    stars = np.array([1.0, 2.0, 3.0, 4.0, 50.0])[np.digitize(worth, edges)]
    for n, value in enumerate(stars[:40].tolist()):
        memory.judge(builders.score(scorer='me', first_step=DELAY * n, length=DELAY, value=value))
    memory.settle()
    changes = {'method': 'evidence', 'composite': 'sum', 'evidence__link': 'known'}
    made = trained(memory, **changes)
    numbers = trained(memory, **changes, evidence__score_scale='numbers')
    assert len(made.report()['thresholds']) == 4
    order, both = (correlations(each, memory, rewards, worth)[0] for each in (made, numbers))
    assert order > 0.99 > both
    state, again = made.state(), trained(memory, **changes).state()
    assert all((state[name] == again[name]).all() for name in state)
