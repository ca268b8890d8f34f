"""The tasks of the DM Control suite."""

import math
from typing import Any

from numpy.typing import NDArray

from codetr_ros.records import F32
from codetr_ros.simulation.environments import Environment, Task, TaskError, flat, quiet


class ControlSuiteEnvironment(Environment):
    """A task of the DM Control suite at action repeat 1, its observations in one array."""

    def __init__(self, task: Task) -> None:
        domain, name = task.environment_id.split('-')
        try:
            with quiet():
                from dm_control import suite
            with quiet():  # again: the import has put MuJoCo's warnings elsewhere
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
        return flat(self._env.reset().observation['observations'])

    def _step(self, action: NDArray[Any]) -> tuple[F32, float, bool, bool]:
        from dm_control.rl.control import PhysicsError

        try:
            step = self._env.step(action)
        except PhysicsError as error:
            raise TaskError(
                f'task {self.name!r}, step {self._steps} of the episode: {error}'
            ) from error
        # these tasks have no terminal states, and were made without a time limit
        return flat(step.observation['observations']), float(step.reward), False, False

    def physics(self) -> tuple[Any, Any]:
        """MuJoCo's model and data."""
        return self._env.physics.model.ptr, self._env.physics.data.ptr

    def close(self) -> None:
        """Free what the environment holds."""
        self._env.close()
