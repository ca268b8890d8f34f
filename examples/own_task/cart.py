"""A task of one's own: bring a cart on a rail to its middle, scored every 20 steps.

python examples/own_task/cart.py [any flag of `codetr train`]

Over topics, from this folder: codetr train --task cart:Cart-v0 --delay 20
"""

import sys
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from codetr_ros.cli import main

PERIOD = 0.1
"""Seconds of a step."""


class Cart(gymnasium.Env[NDArray[np.float32], NDArray[np.float32]]):
    """Observation: position [m] and velocity [m/s]. Action: acceleration [m/s^2]."""

    observation_space = Box(-np.inf, np.inf, (2,))
    action_space = Box(-1.0, 1.0, (1,))

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """Start at rest, up to a metre beside the middle."""
        super().reset(seed=seed)
        self.state = np.array([self.np_random.uniform(-1, 1), 0.0])
        return self.state.astype(np.float32), {}

    def step(
        self, action: NDArray[np.float32]
    ) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Push for a tenth of a second. The rail ends 3 m beside the middle."""
        position, velocity = self.state
        velocity += PERIOD * float(action[0])
        position += PERIOD * velocity
        self.state = np.array([position, velocity])
        reward = 1.0 - position**2
        return self.state.astype(np.float32), reward, bool(abs(position) > 3), False, {}


gymnasium.register('Cart-v0', entry_point=Cart, max_episode_steps=200)

if __name__ == '__main__':
    sys.exit(main(['train', '--task', 'Cart-v0', '--delay', '20', '--in-process', *sys.argv[1:]]))
