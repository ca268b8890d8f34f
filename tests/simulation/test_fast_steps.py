"""Steps without Gymnasium's ado are Gymnasium's steps, bit for bit."""

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.mujoco.half_cheetah_v5 import HalfCheetahEnv

from codetr_ros.simulation import fast_steps, tasks
from codetr_ros.simulation.tasks import TASKS, TaskError, make

NAMES = [name for name, task in TASKS.items() if task.library == 'gymnasium']
STEPS = 300
RESTLESS = [name for name in NAMES if not name.startswith(('HalfCheetah', 'Swimmer', 'Reacher'))]


def walk(name, strength, seed=0):
    """Step a task and Gymnasium's own environment alike; what each gave, step by step."""
    ours, theirs = make(name), gymnasium.make(name)
    low, high = theirs.action_space.low, theirs.action_space.high
    rng = np.random.default_rng(seed)
    got, expected, over = [], [], True
    for number in range(STEPS):
        if over:
            got.append((ours.reset(number), 0.0, False))
            expected.append((theirs.reset(seed=number)[0], 0.0, False))
        action = strength * rng.uniform(-1, 1, ours.action_size).astype(np.float32)
        got.append(ours.step(action))
        bounded = (high + low) / 2 + (high - low) / 2 * action
        observation, reward, terminated, truncated, _ = theirs.step(bounded)
        expected.append((observation, reward, terminated))
        over = terminated or truncated
    return got, expected


@pytest.mark.parametrize('strength', [1.0, 0.05])
@pytest.mark.parametrize('name', NAMES)
def test_every_step_is_gymnasiums_to_the_last_bit(name, strength):
    got, expected = walk(name, np.float32(strength))
    for (observation, reward, terminated), theirs in zip(got, expected, strict=True):
        assert observation.tobytes() == np.asarray(theirs[0], np.float32).tobytes()
        assert type(reward) is float and reward == theirs[1]
        assert type(terminated) is bool and terminated == theirs[2]
    if name in RESTLESS and strength == 1:
        assert any(terminated for *_, terminated in got)


def test_all_tasks_with_a_name_are_stepped_so():
    assert [name for name in NAMES if make(name)._stepper is None] == []


def test_bounds_of_walkers_are_kept():
    """Velocities beyond 10, and a state beyond 100, which random actions do not bring about."""
    ours, theirs = make('Hopper-v5'), gymnasium.make('Hopper-v5')
    for speed, survives in ((20.0, True), (-20.0, True), (130.0, False), (-130.0, False)):
        for env, reset in (
            (ours._env, ours.reset),
            (theirs, lambda seed: theirs.reset(seed=seed)),
        ):
            reset(1)
            velocities = np.zeros(6)
            velocities[5] = speed
            env.unwrapped.set_state(env.unwrapped.init_qpos, velocities)
        observation, reward, terminated = ours.step(np.zeros(3, np.float32))
        expected = theirs.step(np.zeros(3, np.float32))
        assert observation.tobytes() == expected[0].astype(np.float32).tobytes()
        assert (reward, terminated) == (expected[1], expected[2])
        assert terminated != survives
        assert np.abs(observation[5:]).max() <= 10


def test_an_environment_with_arguments_of_its_own_steps_itself():
    gymnasium.register(
        'Braked-v0', HalfCheetahEnv, max_episode_steps=10, kwargs={'ctrl_cost_weight': 5.0}
    )
    gymnasium.register('Plain-v0', HalfCheetahEnv, max_episode_steps=10)
    try:
        braked, plain = make('Braked-v0'), make('Plain-v0')
        action = np.ones(6, np.float32)
        earned = []
        for environment in (braked, plain, make('HalfCheetah-v5')):
            environment.reset(0)
            earned.append(environment.step(action)[1])
    finally:
        del gymnasium.registry['Braked-v0'], gymnasium.registry['Plain-v0']
    assert braked._stepper is None
    assert earned[0] == pytest.approx(earned[2] - 6 * 4.9)
    assert earned[1] == earned[2]


def test_a_state_that_is_not_finite_is_refused():
    environment = make('Reacher-v5')
    environment.reset(0)
    environment._stepper._simulate = lambda action: environment._env.data.qvel.fill(np.nan)
    with pytest.raises(TaskError, match=r"'Reacher-v5', step 1 .* observation\[6\] is nan"):
        environment.step(np.zeros(2, np.float32))


@pytest.mark.filterwarnings('ignore:overflow')
def test_large_but_finite_observations_are_taken():
    environment = make('Reacher-v5')
    environment.reset(0)
    environment._stepper._simulate = lambda action: environment._env.data.qvel.fill(1e30)
    observation, _, _ = environment.step(np.zeros(2, np.float32))
    assert (observation[6:8] == np.float32(1e30)).all()


def test_only_environments_of_the_registry_have_a_stepper():
    env = gymnasium.make('HalfCheetah-v5').unwrapped
    assert fast_steps.stepper(env) is not None
    env.spec = None
    assert fast_steps.stepper(env) is None
    assert fast_steps.stepper(gymnasium.make('Pendulum-v1').unwrapped) is None


def test_the_registry_still_names_the_entry_points_that_are_known_here():
    known = {str(gymnasium.spec(tasks.find(name).environment_id).entry_point) for name in NAMES}
    assert set(fast_steps.STEPPERS) == known
