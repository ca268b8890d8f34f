"""Segments of irregular lengths and of whole episodes, against the task's own rewards."""

import numpy as np
import pytest

from codetr_ros.config import SettingsError
from codetr_ros.cores.evaluator import Evaluator
from codetr_ros.cores.simulator import Simulator
from codetr_ros.policy.acting import ActingPolicy
from codetr_ros.policy.actor import Actor, weights_bytes
from codetr_ros.policy.network import describe_network
from codetr_ros.records import CompositeReward, EpisodeResult, Transitions
from codetr_ros.seeding import generator, seed_torch
from codetr_ros.simulation.composite import composite, perfect_score
from helpers.builders import run as run_spec
from helpers.builders import same, tiny
from helpers.simulating import (
    FALLS,
    NEVER_ENDS,
    deterministic,
    kind,
    permit,
    simulate,
    true_rewards,
)


def rolled_out(task, **changes):
    settings = tiny(task=task, **changes)
    return settings, simulate(settings, [permit(k, steps=130) for k in range(4)])


def ended(said):
    return {c.episode for c in kind(Transitions, said) if c.terminated or c.truncated}


def cuts(seed, source, episode, steps, least, most):
    """First step and drawn length of each segment that begins in an episode's steps so far."""
    rng = generator(seed, 'delay', source, episode)
    drawn = rng.integers(least, most + 1, steps + 1).tolist()
    firsts = np.cumsum([0, *drawn]).tolist()
    return [(first, n) for first, n in zip(firsts, drawn, strict=False) if first < steps]


@pytest.mark.parametrize('task', [FALLS, NEVER_ENDS])
@pytest.mark.parametrize('name', ['sum', 'square_sum', 'max', 'peak_end', 'max_times_n'])
def test_irregular_segments_cover_episodes_and_are_scored_by_their_own_steps(task, name):
    settings, said = rolled_out(task, delay='3:11', composite=name)
    expected = []
    for episode, rewards in true_rewards(said).items():
        for first, length in cuts(settings.seed, 'sim', episode, len(rewards), 3, 11):
            part = rewards[first : first + length]
            if len(part) == length or episode in ended(said):
                value = composite(name, part, settings.beta, 11)
                expected.append((episode, first, len(part), value))
    scores = kind(CompositeReward, said)
    assert [(s.episode, s.first_step, s.length) for s in scores] == [e[:3] for e in expected]
    np.testing.assert_allclose([s.value for s in scores], [e[3] for e in expected], rtol=1e-5)
    assert len({s.length for s in scores}) > 5


@pytest.mark.parametrize('task', [FALLS, NEVER_ENDS])
def test_an_episode_that_ends_early_or_by_its_time_limit_has_one_score(task):
    _, said = rolled_out(task, delay='episode')
    rewards = true_rewards(said)
    chunks = kind(Transitions, said)
    assert any(c.terminated for c in chunks) == (task == FALLS)
    assert any(c.truncated for c in chunks) == (task == NEVER_ENDS)
    scores = kind(CompositeReward, said)
    assert {s.episode for s in scores} == ended(said)
    for score in scores:
        due = rewards[score.episode]
        assert (score.first_step, score.length) == (0, len(due))
        assert score.value == pytest.approx(due.sum(), rel=1e-5)


def test_an_episode_is_scored_as_with_a_delay_of_its_horizon():
    for task, horizon in ((FALLS, 1000), (NEVER_ENDS, 200)):
        _, whole = rolled_out(task, delay='episode', composite='max')
        _, steps = rolled_out(task, delay=horizon, composite='max')
        for a, b in zip(deterministic(whole), deterministic(steps), strict=True):
            assert same(a, b)


def test_where_segments_are_cut_depends_on_no_phase():
    settings = tiny(task=NEVER_ENDS, delay='3:11')
    many = simulate(settings, [permit(k, steps=50) for k in range(6)])
    few = simulate(settings, [permit(k, steps=150) for k in range(2)])
    for said in (many, few):
        assert sum(c.steps for c in kind(Transitions, said)) == 300
    spans = [[(s.episode, s.first_step, s.length) for s in kind(CompositeReward, said)]
             for said in (many, few)]  # fmt: skip
    assert spans[0] == spans[1]


@pytest.mark.parametrize('delay', ['3:11', 'episode'])
def test_an_evaluation_has_the_score_of_its_own_cuts(delay):
    settings = tiny(task=NEVER_ENDS, delay=delay, composite='square_sum', evaluate_episodes=3)
    evaluator = Evaluator(run_spec(settings), settings, 'any')
    evaluator.receive(permit(0))
    results = []
    for records in evaluator.work():
        if records is None:
            break
        results += records
    evaluator.close()
    assert len(results) == 3
    least, most = (3, 11) if delay == '3:11' else (200, 200)
    whole = [composite('square_sum', np.ones(m), 3.0, most) for m in range(least, most + 1)]
    perfect = 200 / np.mean(range(least, most + 1)) * np.mean(whole)
    for number, result in enumerate(results):
        assert isinstance(result, EpisodeResult)
        rewards = repeated(settings, number)
        spans = cuts(0, 'evaluate', number, 200, least, most)
        total = sum(abs(rewards[a : a + n].sum()) * rewards[a : a + n].sum() for a, n in spans)
        assert result.composite_return == pytest.approx(total, rel=1e-5)
        assert result.score == pytest.approx(total / perfect, rel=1e-5)


def repeated(settings, number):
    """The rewards of an evaluation of the random policy, taken once more."""
    from codetr_ros.simulation import tasks

    environment = tasks.make(settings.task)
    environment.reset(int(generator(0, 'evaluate', number).integers(2**31)))
    actions = generator(0, 'evaluate', 'random', number).random((200, 1), np.float32) * 2 - 1
    return np.array([environment.step(action)[1] for action in actions])


@pytest.mark.parametrize('name', ['sum', 'square_sum', 'max'])
def test_the_perfect_score_of_drawn_lengths_is_what_many_perfect_episodes_collect(name):
    rng, r_max, horizon = np.random.default_rng(0), 2.0, 100_000
    lengths = rng.integers(3, 12, horizon // 3)
    lengths = lengths[np.cumsum(lengths) <= horizon]
    collected = sum(composite(name, np.full(m, r_max), 3.0, 11) for m in lengths.tolist())
    found = perfect_score(name, 3.0, 11, horizon, r_max, 3)
    assert found == pytest.approx(collected, rel=0.01)


def test_drawn_lengths_beyond_the_horizon_are_refused():
    settings = tiny(task=NEVER_ENDS, delay='10:201')
    with pytest.raises(SettingsError, match=r"delay = 10:201: task 'Pendulum-v1' has a horizon"):
        Simulator(run_spec(settings), settings, 'sim')


def test_a_policy_sees_how_far_the_drawn_segment_is():
    settings = tiny(task=NEVER_ENDS, delay='3:11', method='hc')
    seed_torch(0)
    network = describe_network(3, 1, (16, 16), segment_steps=11)
    fields = {'random': False, 'network': network, 'weights': weights_bytes(Actor(4, 1, (16, 16)))}
    given = permit(2, steps=90, **fields)
    said = simulate(settings, [permit(0, steps=10), permit(1, steps=10), given])
    chunks = [c for c in kind(Transitions, said) if c.phase == 2]
    acting = ActingPolicy.from_record(given, 3, 1, 11)
    noise = generator(settings.seed, 'noise', 'sim', 2).standard_normal((90, 1), dtype=np.float32)
    begun = [first for first, _ in cuts(settings.seed, 'sim', 0, 200, 3, 11)]
    for i, (observation, action) in enumerate(
        zip(chunks[0].observations, chunks[0].actions, strict=False)
    ):
        t = chunks[0].first_step + i
        place = t - max(first for first in begun if first <= t)
        assert (acting.act(observation, noise[i], place) == action).all()
