"""Environments that somebody wrote and registered: what was registered is what is learnt from."""

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.wrappers import FlattenObservation, RescaleAction, TimeLimit
from hypothesis import given
from hypothesis import strategies as st

from codetr_ros.benchmark import anchors
from codetr_ros.cores.evaluator import Evaluator
from codetr_ros.cores.simulator import Simulator
from codetr_ros.records import CompositeReward, EpisodeResult, Transitions, TrueRewards
from codetr_ros.simulation.composite import composite
from codetr_ros.simulation.environments import TaskError
from codetr_ros.simulation.episode import EpisodeRunner
from codetr_ros.simulation.tasks import make
from helpers.builders import policy, same, tiny
from helpers.builders import run as run_spec
from helpers.own_environments import (
    BuiltAtRandom,
    Ends,
    Forgetful,
    OfItsSpace,
    OfNumpy,
    OfOldNumpy,
    OfParts,
    OfPython,
    OfTorch,
    PlusOne,
    Point,
    Skip,
    TimesTen,
    Wide,
    around,
    registered,
)
from helpers.simulating import deterministic, kind, permit, simulate

HERE = 'helpers.own_environments'
WRAPPED = {
    'nothing': (Point, ()),
    'a reward': (lambda: TimesTen(Point()), ()),
    'an observation': (lambda: PlusOne(Point()), ()),
    'frames': (lambda: Skip(Point()), ()),
    'a dictionary': (lambda: FlattenObservation(OfParts()), ()),
    'actions': (lambda: RescaleAction(Wide(), np.float32(-1), np.float32(1)), ()),
    'several': (lambda: TimesTen(Skip(PlusOne(Point()))), ()),
    'a shorter time limit': (lambda: TimeLimit(Point(), 7), ()),
    'a reward in the registration': (Point, (around(f'{HERE}:TimesTen'),)),
    # around the time limit of `gymnasium.make`, which then counts frames
    'frames in the registration': (Point, (around(f'{HERE}:Skip'),)),
    'the time in the registration': (
        Point,
        (around('gymnasium.wrappers:TimeAwareObservation', flatten=True),),
    ),
}


def entire_episode(environment, seed):
    """Observations, rewards and endings of one of Gymnasium's environments."""
    box = environment.action_space
    observation, _ = environment.reset(seed=seed)
    observations, rewards, ended = [observation], [], (False, False)
    while not any(ended):
        action = box.low + (_action(len(rewards)) + 1) / 2 * (box.high - box.low)
        observation, reward, *ended, _ = environment.step(action.astype(box.dtype))
        observations.append(observation)
        rewards.append(reward)
    return np.array(observations), np.array(rewards), ended


def _action(step):
    return np.float32(np.sin(step))


@pytest.mark.parametrize('way', WRAPPED)
@pytest.mark.parametrize('seed', [1, 2])
def test_what_is_wrapped_around_an_environment_is_part_of_it(way, seed):
    entry_point, wrappers = WRAPPED[way]
    with registered(entry_point, wrappers=wrappers) as name:
        theirs = entire_episode(gymnasium.make(name), seed)
        episode = EpisodeRunner(make(name), tiny(task=name), 'sim')
        episode.reset(seed, 0)
        observations, rewards = [episode.observation], []
        while not episode.over:
            reward, _ = episode.step(np.full(1, _action(len(rewards)), np.float32))
            observations.append(episode.observation)
            rewards.append(reward)
    np.testing.assert_allclose(np.array(observations), theirs[0], atol=1e-5)
    np.testing.assert_allclose(rewards, theirs[1], atol=1e-5)
    assert [episode.terminated, episode.truncated] == theirs[2]


def test_the_evaluator_evaluates_in_the_environment_that_the_simulator_simulates():
    with registered(lambda: TimesTen(Point())) as name:
        settings = tiny(task=name)
        evaluator = Evaluator(run_spec(settings), settings, 'evaluate')
        evaluator.receive(policy(phase=0, version=-1, sources=('sim',), steps=permit(0).steps))
        (result,) = next(evaluator.work())
        evaluator.close()
        steps = kind(TrueRewards, simulate(settings, [permit(0, 50)]))[0].rewards
    assert isinstance(result, EpisodeResult)
    # rewards of 80 to 100 a step, where those of the inner environment are never above 0
    assert 80 < result.true_return / result.length <= 100
    assert (steps > 80).all()


@pytest.mark.parametrize(
    ('wrapped', 'period'),
    [
        (lambda env: env, 0.02),
        (TimesTen, 0.02),
        (FlattenObservation, 0.02),
        (lambda env: TimeLimit(env, 9), 0.02),
        (Skip, 0.0),
        (lambda env: TimesTen(Skip(env)), 0.0),
    ],
)
def test_the_period_of_a_step_is_not_known_past_a_wrapper_that_may_take_several(wrapped, period):
    def timed():
        env = Point()
        env.dt = 0.02
        return wrapped(env)

    with registered(timed) as name:
        assert make(name).control_period == period


def test_a_wrapper_that_states_its_period_is_believed():
    def timed():
        env = Skip(Point())
        env.dt = 0.08
        return env

    with registered(timed) as name:
        assert make(name).control_period == 0.08


class Halves(Point):
    """Changes the action that it is given, in place."""

    def step(self, action):
        action *= 0.5
        return super().step(action)


def box(low, high, dtype):
    return type('Halves', (Halves,), {'action_space': spaces.Box(low, high, (1,), dtype)})


@pytest.mark.parametrize(
    'of_type',
    [
        box(-1, 1, np.float32),
        box(-1, 1, np.float64),
        box(-2, 2, np.float32),
        box(0, 3, np.float64),
    ],
    ids=['as it is', 'float64', 'scaled', 'shifted'],
)
def test_an_environment_that_changes_its_action_changes_no_record(of_type):
    with registered(of_type) as name:
        settings = tiny(task=name)
        chunk = kind(Transitions, simulate(settings, [permit(0, 20)]))[0]
        untouched = kind(Transitions, simulate(tiny(task='Pendulum-v1'), [permit(0, 20)]))[0]
        environment = make(name)
        environment.reset(0)
        action = np.full(1, 0.5, np.float32)
        environment.step(action)
    np.testing.assert_array_equal(chunk.actions, untouched.actions)
    assert action == 0.5


@pytest.mark.parametrize('dtype', [np.float16, np.float32, np.float64])
@pytest.mark.parametrize('bound', [1.0, 2.0])
def test_an_environment_gets_actions_of_the_type_of_its_space(dtype, bound):
    of_type = type('Typed', (Point,), {'action_space': spaces.Box(-bound, bound, (1,), dtype)})
    with registered(of_type) as name:
        environment = make(name)
        environment.reset(0)
        environment.step(np.full(1, 0.3, np.float32))
        (seen,) = environment._env.seen
    assert seen.dtype == dtype
    assert seen == pytest.approx(0.3 * bound, rel=1e-3)


bounds = st.floats(-(2.0**100), 2.0**100, width=32, allow_subnormal=False)


@given(bounds, bounds, st.floats(-1, 1, width=32))
def test_no_action_leaves_the_bounds_by_rounding(one, other, action):
    low, high = sorted((np.float32(one), np.float32(other)))
    of_type = type('Bounded', (Point,), {'action_space': spaces.Box(low, high, (1,))})
    with registered(of_type) as name:
        environment = make(name)
        environment.reset(0)
        environment.step(np.full(1, action, np.float32))
        (seen,) = environment._env.seen
        assert environment._env.action_space.contains(seen)


@pytest.mark.parametrize('dtype', [np.float16, np.float32, np.float64])
@pytest.mark.parametrize('side', ['low', 'high'])
def test_bounds_as_wide_as_their_type_are_none(dtype, side):
    widest = float(np.finfo(dtype).max)
    low, high = (-widest, 1.0) if side == 'low' else (-1.0, widest)
    of_type = type('Huge', (Point,), {'action_space': spaces.Box(low, high, (1,), dtype)})
    with (
        registered(of_type) as name,
        pytest.raises(TaskError, match=rf"'{name}': its action space has {side}=.*actuators"),
    ):
        make(name)


def test_bounds_whose_difference_is_beyond_float32_are_scaled_to():
    of_type = type('Wider', (Point,), {'action_space': spaces.Box(-3e38, 3e38, (1,))})
    with registered(of_type) as name:
        environment = make(name)
        environment.reset(0)
        environment.step(np.full(1, 0.5, np.float32))
        assert environment._env.seen[-1] == pytest.approx(1.5e38)


@pytest.mark.parametrize('dtype', [np.uint8, np.int64, np.float64])
def test_observations_of_any_numbers_become_float32(dtype):
    space = {'observation_space': spaces.Box(0, 100, (2,), dtype)}
    of_type = type('Whole', (Point,), {**space, 'drift': lambda self: 3.0 - self.x})
    with registered(of_type) as name:
        environment = make(name)
        environment.reset(0)
        observation, _, _ = environment.step(np.zeros(1, np.float32))
    assert observation.dtype == np.float32
    assert observation.tolist() == [3, 1]


def test_an_observation_beyond_float32_is_refused():
    of_type = type('Far', (Point,), {'observation_space': spaces.Box(-1, 1, (2,), np.float64)})
    of_type.observe = lambda self: np.array([self.x, 1e300])
    with (
        registered(of_type) as name,
        np.errstate(over='ignore'),
        pytest.raises(TaskError, match=r'reset: observation\[1\] is inf.* also as float32'),
    ):
        make(name).reset(0)


def test_an_environment_that_cuts_its_episodes_off_is_followed():
    with registered(Ends) as name:
        settings = tiny(task=name, delay=7, composite='max_hard')
        said = simulate(settings, [permit(0, 400)])
    chunks = kind(Transitions, said)
    lasts = [chunk for chunk in chunks if chunk.terminated or chunk.truncated]
    assert {(chunk.terminated, chunk.truncated) for chunk in lasts} == {
        (True, False),
        (False, True),
    }
    lengths = {chunk.first_step + chunk.steps for chunk in lasts}
    assert len(lengths) > 5
    assert max(lengths) < 50
    # every step of every ended episode has a score, of what it is made of
    true = {(r.episode, r.first_step): r.rewards for r in kind(TrueRewards, said)}
    scores = kind(CompositeReward, said)
    for chunk in lasts:
        own = [score for score in scores if score.episode == chunk.episode]
        assert sum(score.length for score in own) == chunk.first_step + chunk.steps
        assert all(score.length == 7 for score in own[:-1])
    for score in (score for score in scores if (score.episode, 0) in true):
        rewards = true[score.episode, 0][score.first_step : score.first_step + score.length]
        if len(rewards) == score.length:
            expected = composite('max_hard', rewards.astype(np.float64), 3.0, 7)
            assert score.value == pytest.approx(expected, rel=1e-6)


def test_an_episode_that_is_cut_off_in_a_terminal_state_is_terminated_only():
    of_type = type('Both', (Point,), {'ends': lambda self: (self.t == 3, self.t == 3)})
    with registered(of_type) as name:
        episode = EpisodeRunner(make(name), tiny(task=name), 'sim')
        episode.reset(0, 0)
        while not episode.over:
            episode.step(np.zeros(1, np.float32))
    assert (episode.length, episode.terminated, episode.truncated) == (3, True, False)


def test_the_next_episode_after_one_that_was_cut_off_goes_on():
    of_type = type('Early', (Point,), {'ends': lambda self: (False, self.t == 3)})
    with registered(of_type) as name:
        environment = make(name)
        environment.reset(0)
        cut = []
        for _ in range(3):
            environment.step(np.zeros(1, np.float32))
            cut.append(environment.truncated)
        environment.reset(1)
        assert (cut, environment.truncated) == ([False, False, True], False)
        rewards = anchors.simulate(name, 2)
    assert [len(episode) for episode in rewards['random'] + rewards['zero']] == [3] * 4


@pytest.mark.parametrize(
    'drawing', [OfPython, OfNumpy, OfTorch, OfItsSpace, Forgetful, OfOldNumpy, BuiltAtRandom, Ends]
)
def test_the_same_seed_gives_the_same_run_wherever_an_environment_draws_from(drawing):
    with registered(drawing) as name:
        settings = tiny(task=name, evaluate_episodes=2)
        runs = []
        for disturbance in (1, 2):
            simulator = Simulator(run_spec(settings), settings, 'sim')
            evaluator = Evaluator(run_spec(settings), settings, 'evaluate')
            records = []
            for phase in (0, 1):
                for core in (simulator, evaluator):
                    core.receive(permit(phase, 120))
            works = simulator.work(), evaluator.work()
            for _ in range(20):
                for work in works:
                    records += next(work) or []
                    # what others draw between two slices must not matter
                    OfPython().drift(), OfNumpy().drift(), OfTorch().drift()
                    if disturbance == 2:
                        OfPython().drift(), OfNumpy().drift(), OfTorch().drift()
            simulator.close()
            evaluator.close()
            runs.append(deterministic(records))
        other = deterministic(simulate(settings.changed({'seed': 1}), [permit(0, 120)]))
    assert len(runs[0]) == len(runs[1]) > 10
    assert all(map(same, *runs))
    assert not same(kind(Transitions, runs[0])[0], kind(Transitions, other)[0])


@pytest.mark.parametrize('drawing', [OfItsSpace, Forgetful, OfOldNumpy])
def test_the_same_seed_gives_the_same_start(drawing):
    with registered(drawing) as name:
        environment = make(name)
        starts = [environment.reset(seed)[0] for seed in (1, 2, 1)]
        again = make(name).reset(2)[0]
    assert starts[0] == starts[2] != starts[1] == again


def test_simulator_and_evaluator_make_the_same_environment_although_it_is_built_at_random():
    with registered(BuiltAtRandom) as name:
        settings = tiny(task=name, envs=2)
        simulator = Simulator(run_spec(settings), settings, 'sim')
        evaluator = Evaluator(run_spec(settings), settings, 'evaluate')
        goals = {source.environment._env.goal for source in simulator._sources}
    assert goals == {evaluator._environment._env.goal}
