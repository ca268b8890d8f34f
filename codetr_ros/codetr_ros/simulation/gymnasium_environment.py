"""Environments of Gymnasium, whoever wrote them.

What a registration or an entry point wraps around an environment (its reward, its observations,
its actions, frames that it skips) is part of the environment. Only what `gymnasium.make` adds by
itself is left out: the checker, the enforcer of the order of calls, and the time limit, which is
kept by whoever steps the environment.

The code of an environment is somebody's own. Every error in it names the task, the call and what
to do.
"""

import dataclasses
import logging
import math
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from codetr_ros.records import F32
from codetr_ros.simulation.environments import Environment, Task, TaskError, flat, quiet
from codetr_ros.simulation.faults import FAULTS, described, in_words

_log = logging.getLogger(__name__)

_ONE_STEP = ('gymnasium.core', 'gymnasium.wrappers.common')
"""Modules whose wrappers take one step of the inner environment in each of theirs."""


class GymnasiumEnvironment(Environment):
    """An environment of Gymnasium with Box spaces, with all wrappers of its author.

    Args:
        task: a task whose environment is registered.

    Raises:
        TaskError: the environment cannot be made, or has spaces that cannot be used.
    """

    def __init__(self, task: Task) -> None:
        self._env = _made(task)
        try:
            observation, action = self._env.observation_space, self._env.action_space
        except FAULTS as error:
            raise TaskError(
                f'task {task.name!r}: its spaces cannot be read: {in_words(error)}: set '
                '`observation_space` and `action_space` in the constructor'
            ) from error
        _check_space(task, 'observation', observation)
        _check_space(task, 'action', action)
        size = math.prod(observation.shape)
        super().__init__(task, size, action.low, action.high, _period(self._env))
        self._shape = action.shape
        self._spaces = _spaces(self._env)
        self._lent: Any = None  # the generator that the environment was given, if it had none

    def _reset(self, seed: int) -> F32:
        try:
            self._seed(seed)
            answer = self._env.reset(seed=seed)
        except FAULTS as error:
            raise self._raised(
                error, 'reset must take `seed` and `options` by name, as gymnasium.Env has it'
            ) from error
        if not isinstance(answer, tuple) or len(answer) != 2:
            raise self._fault(f'it returned {described(answer)}: return (observation, info)')
        return self._numbers(answer[0])

    def _seed(self, seed: int) -> None:
        """Seed what `reset(seed=...)` of Gymnasium leaves alone: the spaces, which some
        environments draw from, and the generator of one that does not pass its seed on.
        """
        for space in self._spaces:
            space.seed(seed)
        import gymnasium

        inner = self._env.unwrapped
        usual = type(inner).np_random is gymnasium.Env.np_random
        # the public name would give it a generator of a seed that nobody knows
        if usual and inner._np_random in (None, self._lent):  # noqa: SLF001
            self._lent, _ = gymnasium.utils.seeding.np_random(seed)
            inner.np_random = self._lent

    def _step(self, action: NDArray[Any]) -> tuple[F32, float, bool, bool]:
        try:
            answer = self._env.step(action.reshape(self._shape))
        except FAULTS as error:
            raise self._raised(error, 'step must take every action of its action space') from error
        if not isinstance(answer, tuple) or len(answer) != 5:
            raise self._fault(
                f'it returned {described(answer)}: return (observation, reward, terminated, '
                'truncated, info), as Gymnasium has it since 0.26'
            )
        observation, reward, terminated, truncated, _ = answer
        return (
            self._numbers(observation),
            reward if type(reward) is float else self._reward(reward),
            terminated if type(terminated) is bool else self._flag('terminated', terminated),
            truncated if type(truncated) is bool else self._flag('truncated', truncated),
        )

    def _numbers(self, observation: Any) -> F32:
        """An observation, in one dimension and in memory of our own."""
        try:
            return flat(observation)
        except (TypeError, ValueError) as error:
            raise self._fault(
                f'the observation is {described(observation)}, no array of numbers ({error}): '
                'return what its observation space announces'
            ) from error

    def _reward(self, reward: Any) -> float:
        """A reward that is a number of another type than float."""
        if isinstance(reward, np.floating):
            return float(reward)
        try:
            number = np.asarray(reward)
        except FAULTS as error:
            raise self._raised(error, 'return the reward as a float') from error
        if number.ndim or number.dtype.kind not in 'fiub':
            raise self._fault(f'the reward is {described(reward)}: return one number, as a float')
        return float(number)

    def _flag(self, field: str, value: Any) -> bool:
        """A truth value of another type than bool: numpy's, or 0 or 1."""
        if isinstance(value, np.bool_) or (
            isinstance(value, (int, np.integer)) and value in (0, 1)
        ):
            return bool(value)
        if isinstance(value, np.ndarray) and value.ndim == 0 and value.dtype.kind == 'b':
            return bool(value)
        raise self._fault(f'{field} is {described(value)}: return a bool')

    def _fault(self, what: str) -> TaskError:
        return TaskError(f'task {self.name!r}, {self._call()}: {what}')

    def _raised(self, error: BaseException, remedy: str) -> TaskError:
        return self._fault(f'the environment raised {in_words(error)}. Mend it there; {remedy}')

    def physics(self) -> tuple[Any, Any] | None:
        """MuJoCo's model and data; None for an environment that is not of MuJoCo."""
        import mujoco

        env = self._env.unwrapped
        model, data = getattr(env, 'model', None), getattr(env, 'data', None)
        mine = isinstance(model, mujoco.MjModel) and isinstance(data, mujoco.MjData)
        return (model, data) if mine else None

    def close(self) -> None:
        """Free what the environment holds. An error in that costs nothing that was learnt: it is
        logged.
        """
        try:
            self._env.close()
        except FAULTS as error:
            _log.warning('task %r, close: the environment raised %s', self.name, in_words(error))


def _made(task: Task) -> Any:
    """The environment of a task with its author's wrappers, as `gymnasium.make` makes it.

    Raises:
        TaskError: it cannot be made.
    """
    import gymnasium

    try:
        with quiet():
            spec = gymnasium.spec(task.environment_id)
            return gymnasium.make(_bare(spec), disable_env_checker=True)
    except (gymnasium.error.Error, ImportError) as error:
        raise TaskError(
            f'task {task.name!r} cannot be made: {error}. '
            'Install what it needs, or choose a task that `codetr tasks` lists'
        ) from error
    except FAULTS as error:
        raise TaskError(
            f'task {task.name!r} cannot be made: its constructor raised {in_words(error)}. '
            f'`gymnasium.make({task.environment_id!r})` must work without further arguments: mend '
            'the environment, or register it with the `kwargs` that it needs'
        ) from error


def _bare(spec: Any) -> Any:
    """A specification without what `gymnasium.make` adds by itself.

    A time limit stays where wrappers of the registration lie around it. It counts the steps of
    the inner environment, of which they may take several or none, and some read it.
    """
    limit = spec.max_episode_steps if spec.additional_wrappers else None
    return dataclasses.replace(
        spec, order_enforce=False, disable_env_checker=True, max_episode_steps=limit
    )


def _check_space(task: Task, field: str, space: Any) -> None:
    from gymnasium.spaces import Box

    if isinstance(space, Box) and (field != 'action' or np.issubdtype(space.dtype, np.floating)):
        return
    remedy = {
        'observation': 'Register it with gymnasium.wrappers.FlattenObservation around it',
        'action': 'Register it with a gymnasium.ActionWrapper around it that makes its actions of '
        'real numbers',
    }[field]
    raise TaskError(
        f'task {task.name!r}: its {field} space is {space}: only Box spaces can be used, of real '
        f'numbers for actions. {remedy}, or choose a task that `codetr tasks` lists'
    )


def _layers(env: Any) -> Iterator[Any]:
    """The wrappers of an environment from the outside, and itself."""
    while env is not env.unwrapped:
        yield env
        env = env.env
    yield env


def _spaces(env: Any) -> list[Any]:
    """All spaces of an environment and its wrappers, each once. An inner one may lack them."""
    names = ('action_space', 'observation_space')
    spaces = [getattr(layer, name, None) for layer in _layers(env) for name in names]
    return list({id(space): space for space in spaces if space is not None}.values())


def _period(env: Any) -> float:
    """Seconds of simulated time that a step takes; 0 where unknown.

    The outermost wrapper that states it is right. Past a wrapper that may take several steps in
    one of its own, nobody knows.
    """
    for layer in _layers(env):
        own = layer is layer.unwrapped
        for name in ('dt', 'tau'):
            stated = own or name in vars(layer) or hasattr(type(layer), name)
            value = getattr(layer, name, None) if stated else None
            if isinstance(value, (int, float)) and value > 0:
                return float(value)
        if not own and type(layer).step.__module__ not in _ONE_STEP:
            return 0.0
    fps = (env.unwrapped.metadata or {}).get('render_fps')
    return 1 / fps if fps else 0.0
