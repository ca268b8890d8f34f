"""The evaluator: which versions it evaluates, how it acts, and what it says of them."""

import numpy as np
import pytest

from codetr_ros.config import SettingsError
from codetr_ros.cores.evaluator import Evaluator
from codetr_ros.policy.acting import ActingPolicy
from codetr_ros.policy.actor import Actor, weights_bytes
from codetr_ros.policy.network import describe_network
from codetr_ros.records import EpisodeResult, RecordError
from codetr_ros.seeding import generator, seed_torch
from codetr_ros.simulation import tasks
from helpers.builders import policy, same, tiny
from helpers.builders import run as run_spec

TASK = 'Pendulum-v1'  # 200 steps, never terminates
SIZES = (3, 1, (16, 16))


def fresh_actor(seed=0):
    seed_torch(seed)
    return Actor(*SIZES)


def permit(phase, lag=1, seed=0, **changes):
    """The policy of a phase of a run with two warm-up phases."""
    said = {'phase': phase, 'version': max(-1, phase - lag), 'random': phase < 2}
    if phase >= 2:
        said['network'] = describe_network(*SIZES)
        said['weights'] = weights_bytes(fresh_actor(seed))
    return policy(**said | changes)


def evaluate(settings, policies):
    evaluator = Evaluator(run_spec(settings), settings, 'evaluate')
    results = []
    work = evaluator.work()
    for each in policies:
        evaluator.receive(each)
        while (said := next(work)) is not None:
            results.extend(said)
    evaluator.close()
    evaluator.close()
    return evaluator, results


@pytest.fixture(scope='module')
def whole():
    """All evaluations of a run of six phases, every 400 steps."""
    settings = tiny(task=TASK)
    return settings, *evaluate(settings, [permit(k) for k in range(7)])


def test_the_random_policy_and_every_version_due_are_evaluated_once(whole):
    _, _, results = whole
    evaluations = [(r.purpose, r.step, r.version, r.episode) for r in results]
    assert evaluations == [
        *(('random', 0, -1, 0), ('random', 0, -1, 1)),
        *(('evaluation', 400, 1, 0), ('evaluation', 400, 1, 1)),
        *(('evaluation', 800, 3, 0), ('evaluation', 800, 3, 1)),
        *(('evaluation', 1200, 5, 0), ('evaluation', 1200, 5, 1)),
    ]
    assert {(r.run_id, r.source, r.length, r.terminated) for r in results} == {
        ('run', 'evaluate', 200, False)
    }


def test_it_has_finished_only_when_the_last_version_is_evaluated(whole):
    settings, finished, _ = whole
    assert finished.finished
    assert finished.report().counters == {'episodes': 8, 'evaluations': 4, 'steps': 1600}
    evaluator, _ = evaluate(settings, [permit(k) for k in range(6)])
    assert not evaluator.finished
    evaluator = Evaluator(run_spec(settings), settings, 'evaluate')
    evaluator.receive(permit(6))
    work = evaluator.work()
    next(work)
    assert not evaluator.finished
    next(work)
    assert evaluator.finished
    assert next(work) is None


def test_episodes_are_those_of_the_deterministic_policy_and_scored_as_in_training(whole):
    settings, _, results = whole
    acting = ActingPolicy(fresh_actor())
    environment = tasks.make(TASK)
    for number in range(2):
        seeds = generator(settings.seed, 'evaluate', number)
        observation = environment.reset(int(seeds.integers(2**31)))
        rewards = []
        for _ in range(200):
            observation, reward, _ = environment.step(acting.act(observation))
            rewards.append(reward)
        (result,) = [r for r in results if r.version == 3 and r.episode == number]
        assert result.true_return == pytest.approx(sum(rewards), rel=1e-12)
        assert result.composite_return == pytest.approx(sum(rewards), rel=1e-12)
        assert result.score == pytest.approx(sum(rewards) / 200)


def test_composite_and_score_follow_the_settings():
    settings = tiny(task=TASK, composite='square_sum', delay=60, r_max=2.0)
    _, results = evaluate(settings, [permit(0)])
    environment = tasks.make(TASK)
    for number, result in enumerate(results):
        environment.reset(int(generator(settings.seed, 'evaluate', number).integers(2**31)))
        rng = generator(settings.seed, 'evaluate', 'random', number)
        actions = rng.random((200, 1), dtype=np.float32) * 2 - 1
        rewards = [environment.step(action)[1] for action in actions]
        sums = np.array([np.sum(rewards[i : i + 60]) for i in range(0, 200, 60)])  # the last: 20
        value = (np.abs(sums) * sums).sum()
        assert result.composite_return == pytest.approx(value)
        assert result.score == pytest.approx(value / (200 / 60 * (60 * 2.0) ** 2))


def test_every_evaluation_begins_in_the_same_states(whole):
    _, _, results = whole
    by_version = {}
    for result in results:
        by_version.setdefault(result.version, []).append(result.true_return)
    assert by_version[1] == by_version[3] == by_version[5]  # the same weights here
    assert by_version[1][0] != by_version[1][1]


def test_other_weights_give_other_returns(whole):
    settings, _, results = whole
    _, others = evaluate(settings, [permit(2, seed=1)])
    assert others[0].version == 1
    assert others[0].true_return != results[2].true_return


def test_a_terminated_episode_scores_only_what_it_earned():
    settings = tiny(task='InvertedPendulum-v5')
    _, results = evaluate(settings, [permit(0)])
    for result in results:
        assert result.terminated
        assert result.length < 100
        assert result.true_return == result.length - 1  # 1 a step upright
        assert result.score == pytest.approx(result.true_return / 1000)


def test_with_overlap_the_versions_due_are_the_same(whole):
    _, _, results = whole
    settings = tiny(task=TASK, overlap=True)
    _, overlapped = evaluate(settings, [permit(k, lag=2) for k in range(8)])
    assert all(map(same, overlapped, results))
    assert len(overlapped) == len(results)


def test_a_policy_that_arrives_twice_is_evaluated_once(whole):
    settings, _, results = whole
    _, twice = evaluate(settings, [permit(k) for k in range(7) for _ in range(2)])
    assert len(twice) == len(results)


def test_without_evaluations_it_has_finished_when_the_last_version_arrives():
    settings = tiny(task=TASK, evaluate_every=0)
    evaluator, results = evaluate(settings, [permit(k) for k in range(6)])
    assert not evaluator.finished
    evaluator.receive(permit(6))
    assert evaluator.finished
    assert results == []


@pytest.mark.parametrize(
    ('wrong', 'message'),
    [
        (permit(2, run_id='other'), "run 'other', this is run 'run'"),
        (permit(2, network=describe_network(5, 1, (16,))), 'another architecture'),
        (permit(2, weights=b''), 'are not safetensors'),
        (permit(2, version=6), 'version=6.*versions -1 to 5'),
        (
            EpisodeResult(
                run_id='run',
                source='a',
                purpose='random',
                step=0,
                version=-1,
                episode=0,
                length=1,
                true_return=0.0,
                composite_return=0.0,
                score=0.0,
                terminated=True,
            ),
            'policies only',
        ),
    ],
)
def test_a_policy_that_cannot_be_evaluated_is_refused_and_changes_nothing(wrong, message, whole):
    settings, _, results = whole
    evaluator = Evaluator(run_spec(settings), settings, 'evaluate')
    with pytest.raises(RecordError, match=message):
        evaluator.receive(wrong)
    evaluator.receive(permit(2))
    work = evaluator.work()
    assert same(next(work)[0], results[2])


def test_a_delay_beyond_the_horizon_is_refused():
    settings = tiny(task=TASK, delay=201)
    with pytest.raises(
        SettingsError, match=r"delay = 201: task 'Pendulum-v1' has a horizon of 200"
    ):
        Evaluator(run_spec(settings), settings, 'evaluate')
