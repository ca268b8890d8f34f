"""Tasks: what their names mean, the contract of every environment, and what is refused."""

import math
import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium import spaces

from codetr_ros.config import SettingsError
from codetr_ros.simulation.tasks import TASKS, TaskError, check, find, make, r_max
from helpers.builders import tiny

NAMES = [
    *('HalfCheetah-v5', 'Hopper-v5', 'Walker2d-v5', 'Ant-v4', 'Humanoid-v5', 'Swimmer-v5'),
    *('InvertedPendulum-v5', 'InvertedDoublePendulum-v5', 'Reacher-v5'),
    *('HalfCheetah-v4', 'Hopper-v4', 'Walker2d-v4'),
    *('cheetah-run', 'walker-walk', 'walker-run', 'hopper-hop', 'quadruped-walk'),
    *('fish-upright', 'cartpole-swingup', 'ball_in_cup-catch', 'reacher-hard', 'finger-spin'),
]


class Counting(gymnasium.Env):
    """Counts steps: the first observation. The second is the action as it arrived."""

    metadata = {'render_fps': 20, 'render_modes': []}
    shape = (2,)
    observation_space = spaces.Box(-np.inf, np.inf, (2,))
    action_space = spaces.Box(np.float32(-1), np.float32(3), (1,))

    def __init__(self, at=None, observation=0.0, reward=1.0, truncated=False, **changed):
        self.at, self.said, self.reward, self.truncated = at, observation, reward, truncated
        self.__dict__ |= changed

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        self.seen = np.array([self.np_random.random(), 0], np.float32)
        return self.seen.reshape(self.shape), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.steps += 1
        self.seen[:] = self.steps, action.flat[0]  # in place, as some environments do
        if self.steps == self.at:
            self.seen[0] += self.said
            return self.seen, self.reward, False, self.truncated, {}
        return self.seen, 1.0, False, False, {}


@pytest.fixture
def counting():
    """Register a `Counting` with these arguments; gives its name."""
    names = []

    def register(horizon=10, **arguments):
        name = f'Counting{len(names)}-v0'
        gymnasium.register(name, Counting, max_episode_steps=horizon, kwargs=arguments)
        names.append(name)
        return name

    yield register
    for name in names:
        del gymnasium.registry[name]


def test_the_named_tasks_are_these():
    assert sorted(TASKS) == sorted(NAMES)


@pytest.mark.parametrize('name', NAMES)
def test_every_task_keeps_the_contract(name):
    environment = make(name)
    observation = environment.reset(seed=3)
    size, horizon = environment.observation_size, environment.horizon
    assert horizon == (50 if name == 'Reacher-v5' else 1000)
    assert environment.r_max > 0
    assert 0 < environment.control_period < 1
    rng = np.random.default_rng(0)
    for _ in range(5):
        assert observation.dtype == np.float32
        assert observation.shape == (size,)
        before = observation.copy()
        action = rng.uniform(-1, 1, environment.action_size).astype(np.float32)
        following, reward, terminated = environment.step(action)
        assert (observation == before).all()  # not overwritten by the step
        assert isinstance(reward, float)
        assert isinstance(terminated, bool)
        observation = following
    environment.close()


@pytest.mark.parametrize('name', ['Ant-v4', 'InvertedDoublePendulum-v5', *NAMES[12:]])
def test_the_same_seed_gives_the_same_episode_in_another_environment(name):
    def episode(environment, seed):
        observations = [environment.reset(seed)]
        for _ in range(3):
            action = np.full(environment.action_size, 0.3, np.float32)
            observations.append(environment.step(action)[0])
        return np.array(observations).tobytes()

    a, b = make(name), make(name)
    first = episode(a, 1)
    assert episode(a, 2) != first
    assert episode(b, 1) == first
    assert episode(a, 1) == first


def test_an_ant_that_stands_still_survives_and_earns_about_one_a_step():
    environment = make('Ant-v4')
    environment.reset(seed=0)
    steps = [environment.step(np.zeros(8, np.float32)) for _ in range(1000)]
    assert environment.observation_size == 27
    assert not any(terminated for _, _, terminated in steps)
    assert sum(reward for _, reward, _ in steps) == pytest.approx(1001, abs=3)


def test_a_double_pendulum_that_stands_upright_earns_its_largest_reward():
    environment = make('InvertedDoublePendulum-v5')
    environment.reset(seed=0)
    environment._env.set_state(np.zeros(3), np.zeros(3))
    _, reward, terminated = environment.step(np.zeros(1, np.float32))
    assert not terminated
    assert reward == pytest.approx(environment.r_max, abs=1e-6)


def test_a_pendulum_that_tips_is_terminated():
    environment = make('InvertedPendulum-v5')
    environment.reset(seed=0)
    steps = [environment.step(np.ones(1, np.float32))[2] for _ in range(20)]
    assert not steps[0]
    assert any(steps)


@pytest.mark.parametrize('name', ['HalfCheetah-v5', 'Humanoid-v5', 'InvertedPendulum-v5'])
def test_steps_are_those_of_gymnasium_itself(name):
    environment, theirs = make(name), gymnasium.make(name)
    low, high = theirs.action_space.low, theirs.action_space.high
    assert environment.reset(seed=7) == pytest.approx(theirs.reset(seed=7)[0], abs=1e-6)
    rng = np.random.default_rng(0)
    for _ in range(5):
        action = rng.uniform(-1, 1, environment.action_size).astype(np.float32)
        observation, reward, terminated = environment.step(action)
        expected = theirs.step((low + (action + 1) / 2 * (high - low)).astype(np.float32))
        np.testing.assert_allclose(observation, expected[0], rtol=1e-4, atol=1e-4)
        assert reward == pytest.approx(expected[1], rel=1e-4)
        assert terminated == expected[2]


def test_steps_are_those_of_dm_control_itself():
    from dm_control import suite

    environment = make('walker-walk')
    environment.reset(seed=7)
    theirs = suite.load('walker', 'walk', task_kwargs={'random': 7})
    theirs.reset()
    for _ in range(5):
        observation, reward, _ = environment.step(np.full(6, 0.5, np.float32))
        step = theirs.step(np.full(6, 0.5))
        assert reward == step.reward
        flat = np.concatenate([np.ravel(part) for part in step.observation.values()])
        np.testing.assert_array_equal(observation, flat.astype(np.float32))


@pytest.mark.parametrize(
    ('action', 'bound'), [(-1, -1), (1, 3), (0, 1)], ids=['lowest', 'highest', 'middle']
)
def test_actions_are_scaled_to_the_environments_bounds(counting, action, bound):
    environment = make(counting())
    environment.reset(seed=0)
    assert environment.step(np.array([action], np.float32))[0][1] == bound


def test_an_observation_stays_as_it_was_although_the_environment_reuses_its_array(counting):
    environment = make(counting())
    environment.reset(seed=0)
    first, _, _ = environment.step(np.zeros(1, np.float32))
    environment.step(np.zeros(1, np.float32))
    assert first[0] == 1


def test_an_environment_steps_beyond_its_horizon_without_ending_by_itself(counting):
    environment = make(counting(horizon=3))
    environment.reset(seed=0)
    assert [environment.step(np.zeros(1, np.float32))[2] for _ in range(5)] == [False] * 5
    assert environment.horizon == 3


def test_an_observation_of_two_dimensions_is_flattened(counting):
    environment = make(
        counting(observation_space=spaces.Box(-np.inf, np.inf, (1, 2)), shape=(1, 2))
    )
    assert environment.observation_size == 2
    assert environment.reset(seed=0).shape == (2,)


@pytest.mark.parametrize('bound', [1, 2], ids=['as they are', 'scaled'])
def test_an_action_of_two_dimensions_arrives_in_its_shape(counting, bound):
    environment = make(counting(action_space=spaces.Box(-bound, bound, (1, 2))))
    environment.reset(seed=0)
    assert environment.action_size == 2
    assert environment.step(np.array([0.5, 0.0], np.float32))[0][1] == 0.5 * bound


def test_any_other_id_with_boxes_works_with_the_horizon_of_its_spec():
    environment = make('Pendulum-v1')
    assert (environment.observation_size, environment.action_size) == (3, 1)
    assert environment.horizon == 200
    assert environment.r_max == 1.0
    assert environment.control_period == 0.05
    assert 'r_max' in environment.task.note


def test_the_settings_r_max_goes_before_the_tasks():
    assert r_max(tiny(), find('Ant-v4')) == 6.0
    assert r_max(tiny(r_max=2.5), find('Ant-v4')) == 2.5


def test_a_delay_beyond_the_horizon_is_refused_and_one_as_long_is_not():
    check(tiny(delay=50), find('Reacher-v5'))
    with pytest.raises(SettingsError, match=r"delay = 51: task 'Reacher-v5' has a horizon of 50"):
        check(tiny(delay=51), find('Reacher-v5'))


@pytest.mark.parametrize(
    ('name', 'close'),
    [('HalfChetah-v5', 'HalfCheetah-v5'), ('ant-v2', 'Ant-v4'), ('walker-wlak', 'walker-walk')],
)
def test_an_unknown_task_is_refused_with_close_matches(name, close):
    with pytest.raises(TaskError, match=rf"no task '{name}' \(close: .*{close}.*`codetr tasks`"):
        find(name)


def test_a_name_that_is_no_id_at_all_is_refused():
    with pytest.raises(TaskError, match="no task 'a b'.*`codetr tasks` lists"):
        find('a b')


def test_the_papers_own_version_of_a_task_is_refused_with_the_one_that_stands_in_for_it():
    with pytest.raises(TaskError, match=r"'Ant-v2' \(close: Ant-v4.*max_episode_steps is None"):
        find('Ant-v2')


def test_a_task_whose_environment_cannot_be_imported_is_refused_with_the_reason(counting):
    name = counting()
    gymnasium.registry[name].entry_point = 'no_such_module:Environment'
    with pytest.raises(TaskError, match=rf"'{name}' cannot be made: .*no_such_module.* Install"):
        make(name)


def test_a_task_without_a_horizon_is_refused(counting):
    name = counting(horizon=None)
    with pytest.raises(
        TaskError, match=f"'{name}'.* has no horizon, its max_episode_steps is None"
    ):
        find(name)


@pytest.mark.parametrize('field', ['observation', 'action'])
def test_spaces_that_are_no_boxes_of_real_numbers_are_refused(counting, field):
    name = counting(**{f'{field}_space': spaces.Discrete(3)})
    with pytest.raises(TaskError, match=rf"'{name}': its {field} space is Discrete\(3\)"):
        make(name)


def test_an_observation_of_another_size_than_announced_is_refused(counting):
    environment = make(counting(observation_space=spaces.Box(-1, 1, (5,))))
    with pytest.raises(TaskError, match='reset: 2 observations, 5 announced'):
        environment.reset(seed=0)


def test_action_bounds_that_are_not_finite_are_refused(counting):
    name = counting(action_space=spaces.Box(-np.inf, np.inf, (1,)))
    with pytest.raises(TaskError, match=r'low=\[-inf\]: bounds must be finite'):
        make(name)


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf])
def test_an_observation_that_is_not_finite_is_refused_naming_task_step_and_field(counting, value):
    name = counting(at=3, observation=value)
    environment = make(name)
    environment.reset(seed=0)
    for _ in range(2):
        environment.step(np.zeros(1, np.float32))
    with pytest.raises(TaskError, match=rf"'{name}', step 3 .* observation\[0\] is {value}"):
        environment.step(np.zeros(1, np.float32))


@pytest.mark.parametrize('value', [math.nan, math.inf])
def test_a_reward_that_is_not_finite_is_refused_naming_task_step_and_field(counting, value):
    name = counting(at=2, reward=value)
    environment = make(name)
    environment.reset(seed=0)
    environment.step(np.zeros(1, np.float32))
    with pytest.raises(TaskError, match=rf"'{name}', step 2 .* reward is {value}"):
        environment.step(np.zeros(1, np.float32))


def test_an_environment_that_truncates_before_its_horizon_states_it(counting):
    environment = make(counting(at=2, truncated=True))
    environment.reset(seed=0)
    for truncated in (False, True):
        _, _, terminated = environment.step(np.zeros(1, np.float32))
        assert (terminated, environment.truncated) == (False, truncated)


def test_finding_a_task_imports_no_simulation_and_making_an_old_version_warns_of_nothing(tmp_path):
    code = (
        'import sys; from codetr_ros.simulation import tasks; tasks.find("cheetah-run")\n'
        'heavy = {"gymnasium", "mujoco", "dm_control", "torch"} & set(sys.modules)\n'
        'assert not heavy, heavy\n'
        'tasks.make("HalfCheetah-v4").reset(0); tasks.make("cheetah-run").reset(0)'
    )
    arguments = [sys.executable, '-W', 'default::DeprecationWarning:gymnasium', '-c', code]
    done = subprocess.run(arguments, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout + done.stderr == ''
    assert list(tmp_path.iterdir()) == []  # MuJoCo would leave MUJOCO_LOG.TXT


def test_the_warnings_of_others_are_left_alone():
    make('Ant-v4')
    with pytest.warns(UserWarning, match='out of date'):
        warnings.warn('out of date', UserWarning, stacklevel=1)
