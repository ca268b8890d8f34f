"""The smallest task worth learning: a point that is to stay near 0."""

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

from codetr_ros.records import F32

HORIZON = 5
TASK = f'{__name__}:CodetrSimTest-v0'


class Point(gymnasium.Env[F32, F32]):
    """Observation: place and time. Reward: minus the distance from 0. Some episodes fall."""

    def __init__(self) -> None:
        self.observation_space = spaces.Box(-np.inf, np.inf, (2,))
        self.action_space = spaces.Box(-1.0, 1.0, (1,))
        self._place, self._time = 0.0, 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[F32, dict[str, Any]]:
        """Begin at a place drawn from -1 to 1."""
        super().reset(seed=seed)
        self._place, self._time = float(self.np_random.uniform(-1, 1)), 0
        return self._seen(), {}

    def step(self, action: F32) -> tuple[F32, float, bool, bool, dict[str, Any]]:
        """Move by a tenth of the action."""
        self._place = float(np.clip(self._place + 0.1 * float(np.ravel(action)[0]), -2, 2))
        self._time += 1
        fallen = bool(self.np_random.random() < 0.1)
        return self._seen(), -abs(self._place), fallen, False, {}

    def _seen(self) -> F32:
        return np.array([self._place, self._time], np.float32)


gymnasium.register(TASK.partition(':')[2], f'{__name__}:Point', max_episode_steps=HORIZON)
