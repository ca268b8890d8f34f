"""Environments of either library behind one interface: thin and fast.

Every environment takes actions in [-1, 1] and gives float32 observations of one dimension. It
never ends an episode at its horizon: the code that steps it does (see `episode`), so that a time
limit is never mistaken for a terminal state. Gymnasium and DM Control are imported when an
environment is made.
"""

import logging
import math
import warnings
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from codetr_ros.records import F32

_log = logging.getLogger(__name__)


class TaskError(ValueError):
    """A task that is unknown, cannot be used or misbehaves: names task, field and remedy."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A task: an environment with a horizon and a unit of scores.

    Attributes:
        name: its name in settings.
        environment_id: the environment's name in its library.
        library: the library that has the environment.
        horizon: steps after which an episode is truncated.
        r_max: the largest reward of one step, the unit of scores; positive.
        note: what to know about it.
    """

    name: str
    environment_id: str
    library: Literal['gymnasium', 'dm_control']
    horizon: int
    r_max: float
    note: str


class Environment(ABC):
    """An environment with actions in [-1, 1], float32 observations (O,), and no time limit.

    Attributes:
        task: the task that it simulates.
        name, horizon, r_max: those of the task.
        observation_size: O.
        action_size: A.
        control_period: seconds of simulated time that a step takes; 0 where unknown.
    """

    def __init__(
        self,
        task: Task,
        observation_size: int,
        low: NDArray[np.floating[Any]],
        high: NDArray[np.floating[Any]],
        control_period: float,
    ) -> None:
        for field, bounds in (('low', low), ('high', high)):
            if not np.isfinite(bounds).all():
                raise TaskError(
                    f'task {task.name!r}: its action space has {field}={bounds.tolist()}: bounds '
                    'must be finite, for actions in [-1, 1] to be scaled to them. `codetr tasks` '
                    'lists the tasks that work'
                )
        self.task = task
        self.name = task.name
        self.horizon = task.horizon
        self.r_max = task.r_max
        self.observation_size = observation_size
        self.action_size = int(low.size)
        self.control_period = control_period
        self._middle = (high + low).reshape(-1) / 2
        self._half = (high - low).reshape(-1) / 2
        self._shifted = bool((self._middle != 0).any())
        self._scaled = self._shifted or bool((self._half != 1).any())
        self._steps = 0

    def reset(self, seed: int) -> F32:
        """Start an episode and observe (O,). The same seed, 0 to 2**32 - 1, gives the same start.

        Raises:
            TaskError: the observation is not finite, or not of the size that the environment
                announced.
        """
        self._steps = 0
        observation = self._reset(seed)
        self._check(observation)
        if len(observation) != self.observation_size:
            raise TaskError(
                f'task {self.name!r}, reset: {len(observation)} observations, '
                f'{self.observation_size} announced'
            )
        return observation

    def step(self, action: F32) -> tuple[F32, float, bool]:
        """Take an action (A,) in [-1, 1].

        Returns:
            The observation (O,) after it, the reward, and whether a terminal state was reached.

        Raises:
            TaskError: the observation or the reward is not finite.
        """
        self._steps += 1
        scaled: NDArray[Any] = action
        if self._scaled:
            scaled = self._half * action
        if self._shifted:
            scaled = self._middle + scaled
        observation, reward, terminated = self._step(scaled)
        if not math.isfinite(reward):
            raise TaskError(self._not_finite('reward', reward))
        self._check(observation)
        return observation, reward, terminated

    def _check(self, observation: F32) -> None:
        # a fifth of the time of a check of each number, and not finite where one of them is not
        if math.isfinite(observation.dot(observation)):
            return
        finite = np.isfinite(observation)
        if not finite.all():  # else it was the sum of squares that overflowed
            i = int(np.argmin(finite))
            raise TaskError(self._not_finite(f'observation[{i}]', observation[i]))

    def _not_finite(self, field: str, value: float) -> str:
        return (
            f'task {self.name!r}, step {self._steps} of the episode: {field} is {value}, it must '
            'be finite: the simulation has diverged, or the environment is at fault'
        )

    @abstractmethod
    def _reset(self, seed: int) -> F32:
        """The first observation, in memory of the caller's own."""

    @abstractmethod
    def _step(self, action: NDArray[Any]) -> tuple[F32, float, bool]:
        """The next observation, reward and termination after an action (A,) within the bounds."""

    @abstractmethod
    def close(self) -> None:
        """Free what the environment holds."""


class GymnasiumEnvironment(Environment):
    """An environment of Gymnasium with Box spaces, without the wrappers of `gymnasium.make`."""

    def __init__(self, task: Task) -> None:
        import gymnasium

        try:
            with _quiet():
                # no checker, time limit or order enforcer: they would cost more than some
                # simulations do
                self._env = gymnasium.make(task.environment_id, disable_env_checker=True).unwrapped
        except (gymnasium.error.Error, ImportError) as error:
            raise TaskError(
                f'task {task.name!r} cannot be made: {error}. '
                'Install what it needs, or choose a task that `codetr tasks` lists'
            ) from error
        spaces: dict[str, Any] = {
            'observation': self._env.observation_space,
            'action': self._env.action_space,
        }
        for field, space in spaces.items():
            floats = field == 'observation' or np.issubdtype(space.dtype, np.floating)
            if not isinstance(space, gymnasium.spaces.Box) or not floats:
                raise TaskError(
                    f'task {task.name!r}: its {field} space is {space}: only Box spaces can be '
                    'used, of real numbers for actions. `codetr tasks` lists the tasks that work'
                )
        box = spaces['action']
        size = math.prod(spaces['observation'].shape)
        super().__init__(task, size, box.low, box.high, _period(self._env))

    def _reset(self, seed: int) -> F32:
        return _own(self._env.reset(seed=seed)[0])

    def _step(self, action: NDArray[Any]) -> tuple[F32, float, bool]:
        shaped = action.reshape(self._env.action_space.shape)
        observation, reward, terminated, truncated, _ = self._env.step(shaped)
        if truncated and self._steps < self.horizon:
            raise TaskError(
                f'task {self.name!r} truncated an episode itself, at step {self._steps} of '
                f'horizon={self.horizon}: register it with max_episode_steps={self._steps}'
            )
        return _own(observation), float(reward), bool(terminated)

    def close(self) -> None:
        """Free what the environment holds."""
        self._env.close()


class ControlSuiteEnvironment(Environment):
    """A task of the DM Control suite at action repeat 1, its observations in one array."""

    def __init__(self, task: Task) -> None:
        domain, name = task.environment_id.split('-')
        try:
            with _quiet():
                from dm_control import suite
            with _quiet():  # again: the import has put MuJoCo's warnings elsewhere
                self._env = suite.load(
                    domain,
                    name,
                    task_kwargs={'time_limit': math.inf, 'random': 0},
                    environment_kwargs={'flat_observation': True},
                )
        except ImportError as error:
            raise TaskError(
                f'task {task.name!r} needs dm_control: {error}. Install dm_control'
            ) from error
        box = self._env.action_spec()
        size = math.prod(self._env.observation_spec()['observations'].shape)
        super().__init__(task, size, box.minimum, box.maximum, float(self._env.control_timestep()))

    def _reset(self, seed: int) -> F32:
        # everything that a task of the suite draws comes from this generator
        self._env.task.random.seed(seed)
        return _own(self._env.reset().observation['observations'])

    def _step(self, action: NDArray[Any]) -> tuple[F32, float, bool]:
        from dm_control.rl.control import PhysicsError

        try:
            step = self._env.step(action)
        except PhysicsError as error:
            raise TaskError(
                f'task {self.name!r}, step {self._steps} of the episode: {error}'
            ) from error
        # these tasks have no terminal states
        return _own(step.observation['observations']), float(step.reward), False

    def close(self) -> None:
        """Free what the environment holds."""
        self._env.close()


def _own(raw: NDArray[Any]) -> F32:
    """A copy in one dimension: environments reuse their arrays."""
    return np.array(raw, np.float32).reshape(-1)


def _period(env: Any) -> float:
    """Seconds of simulated time that a step takes; 0 where unknown."""
    for name in ('dt', 'tau'):
        value = getattr(env, name, None)
        if isinstance(value, (int, float)) and value > 0:
            return float(value)
    fps = env.metadata.get('render_fps')
    return 1 / fps if fps else 0.0


@contextmanager
def _quiet() -> Iterator[None]:
    """Suppress warnings about which a user can do nothing while an environment is made.

    v4 is used on purpose (see Ant-v4), no display is needed, and both libraries' models use
    attributes that MuJoCo has renamed. Afterwards MuJoCo warns through `logging`: by itself it
    would write a file MUJOCO_LOG.TXT into whatever folder the process runs in.
    """
    import mujoco

    mujoco.set_mju_user_warning(_log.debug)
    try:
        with warnings.catch_warnings():
            warnings.filterwarnings('ignore', message='.*out of date')
            warnings.filterwarnings('ignore', message='.*DISPLAY')
            yield
    finally:
        mujoco.set_mju_user_warning(_log.warning)
