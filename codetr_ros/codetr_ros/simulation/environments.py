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

LARGEST = float(np.finfo(np.float32).max)
"""The largest reward or observation: records hold them in float32."""


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
        truncated: whether the environment itself cut the episode off at the last step.

    Raises:
        TaskError: the action space has bounds that are not finite, or a space holds no number.
    """

    def __init__(
        self,
        task: Task,
        observation_size: int,
        low: NDArray[np.floating[Any]],
        high: NDArray[np.floating[Any]],
        control_period: float,
    ) -> None:
        _check_sizes(task, observation_size, int(low.size))
        for field, bounds in (('low', low), ('high', high)):
            _check_bounds(task, field, bounds)
        self.task = task
        self.name = task.name
        self.horizon = task.horizon
        self.r_max = task.r_max
        self.observation_size = observation_size
        self.action_size = int(low.size)
        self.control_period = control_period
        self.truncated = False
        self._type = low.dtype
        self._low, self._high = low.reshape(-1), high.reshape(-1)
        # halved before they are added, so that no bound is too large
        self._middle = self._high / 2 + self._low / 2
        self._half = self._high / 2 - self._low / 2
        self._shifted = bool((self._middle != 0).any())
        self._scaled = self._shifted or bool((self._half != 1).any())
        self._steps = 0

    def reset(self, seed: int) -> F32:
        """Start an episode and observe (O,). The same seed, 0 to 2**32 - 1, gives the same start.

        Raises:
            TaskError: the observation is not finite, or not of the size that the environment
                announced, or the environment is at fault in another way.
        """
        self._steps = 0
        self.truncated = False
        observation = self._reset(seed)
        self._check(observation)
        return observation

    def step(self, action: F32) -> tuple[F32, float, bool]:
        """Take an action (A,) in [-1, 1]. `truncated` states whether that cut the episode off.

        Returns:
            The observation (O,) after it, the reward, and whether a terminal state was reached.

        Raises:
            TaskError: the observation or the reward is not finite, or the environment is at fault
                in another way.
        """
        self._steps += 1
        observation, reward, terminated, self.truncated = self._step(self._within_bounds(action))
        if not -LARGEST <= reward <= LARGEST:  # not a number neither
            raise TaskError(self._not_finite('reward', reward))
        self._check(observation)
        return observation, reward, terminated

    def _within_bounds(self, action: F32) -> NDArray[Any]:
        """The action (A,) as the environment expects it, in memory that it may change."""
        if not self._scaled:
            return np.array(action, self._type)
        scaled: NDArray[Any] = self._half * action
        if self._shifted:
            scaled = self._middle + scaled
            # rounding may have led beyond a bound
            np.minimum(np.maximum(scaled, self._low, out=scaled), self._high, out=scaled)
        return scaled.astype(self._type, copy=False)

    def _call(self) -> str:
        """The call that the environment answered last, for errors."""
        return f'step {self._steps} of the episode' if self._steps else 'reset'

    def _check(self, observation: F32) -> None:
        if len(observation) != self.observation_size:
            raise TaskError(
                f'task {self.name!r}, {self._call()}: {len(observation)} observations, '
                f'{self.observation_size} announced: the environment must return as many as its '
                'observation space has'
            )
        # a fifth of the time of a check of each number, and not finite where one of them is not
        if math.isfinite(observation.dot(observation)):
            return
        finite = np.isfinite(observation)
        if not finite.all():  # else it was the sum of squares that overflowed
            i = int(np.argmin(finite))
            raise TaskError(self._not_finite(f'observation[{i}]', observation[i]))

    def _not_finite(self, field: str, value: float) -> str:
        return (
            f'task {self.name!r}, {self._call()}: {field} is {value}, it must be finite, also as '
            f'float32 (at most {LARGEST:.2g}): the simulation has diverged, or the environment '
            'is at fault'
        )

    @abstractmethod
    def _reset(self, seed: int) -> F32:
        """The first observation, in memory of the caller's own."""

    @abstractmethod
    def _step(self, action: NDArray[Any]) -> tuple[F32, float, bool, bool]:
        """The next observation, reward, termination and truncation after an action (A,) within the
        bounds, which the environment may change.
        """

    def physics(self) -> tuple[Any, Any] | None:
        """MuJoCo's model and data; None for an environment that is not of MuJoCo."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Free what the environment holds."""


def _check_sizes(task: Task, observation_size: int, action_size: int) -> None:
    for field, size in (('observation', observation_size), ('action', action_size)):
        if size < 1:
            raise TaskError(
                f'task {task.name!r}: its {field} space has no numbers in it: it needs one at '
                'least. `codetr tasks` lists the tasks that work'
            )


def _check_bounds(task: Task, field: str, bounds: NDArray[np.floating[Any]]) -> None:
    """Refuse bounds of actions that are none: infinite, or the largest number of a type."""
    largest = min(float(np.finfo(bounds.dtype).max), LARGEST)
    # not a number fails the comparison too
    if not (np.abs(bounds) < largest).all():
        raise TaskError(
            f'task {task.name!r}: its action space has {field}={bounds.tolist()}: bounds must be '
            f'finite, and below {largest:.3g}, which stands for none, for actions in [-1, 1] to '
            'be scaled to them. Give the action space the bounds of the actuators, or choose a '
            'task that `codetr tasks` lists'
        )


def flat(raw: NDArray[Any]) -> F32:
    """A copy in one dimension: environments reuse their arrays."""
    return np.array(raw, np.float32).reshape(-1)


@contextmanager
def quiet() -> Iterator[None]:
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
