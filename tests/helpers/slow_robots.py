"""Tasks whose steps take long until a test lets them go: meanwhile a run answers as any other, and
does not end, however late the test gets to look at it.
"""

import os
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box

MODULE = __name__
POINT, REACHER, PENDULUM = (
    f'{MODULE}:{name}-v0' for name in ('SlowPoint', 'SlowReacher', 'SlowPendulum')
)
LET_GO, SECONDS, AFTER = (f'CODETR_TEST_{name}' for name in ('LET_GO', 'SECONDS', 'AFTER'))


class Held:
    """Robots that are slow until they are let go.

    Attributes:
        variables: for the environment of the run.

    Args:
        folder: takes a file.
        seconds: that each step takes.
        after: steps of a process that are as quick as they can be, before these.
    """

    def __init__(self, folder: Path, seconds: float, after: int = 0) -> None:
        self._file = folder / 'let_go'
        path = os.pathsep.join(filter(None, [str(TESTS), os.environ.get('PYTHONPATH', '')]))
        self.variables = {
            'PYTHONPATH': path,
            LET_GO: str(self._file),
            SECONDS: str(seconds),
            AFTER: str(after),
        }

    def let_go(self) -> None:
        """Let them be as quick as they can from now on."""
        self._file.touch()


TESTS = Path(__file__).resolve().parents[1]


class Slow(gymnasium.Wrapper):
    """An environment that is slow as long as a file does not exist."""

    steps = 0  # of all of them in this process

    def step(self, action: Any) -> Any:
        Slow.steps += 1
        file = os.environ.get(LET_GO)
        if file and Slow.steps > int(os.environ[AFTER]) and not os.path.exists(file):
            time.sleep(float(os.environ[SECONDS]))
        return super().step(action)


class Point(gymnasium.Env):
    """A point that is pushed about."""

    observation_space = Box(-np.inf, np.inf, (2,), np.float64)
    action_space = Box(-1.0, 1.0, (1,), np.float64)

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        super().reset(seed=seed)
        self._state = self.np_random.uniform(-1, 1, 2)
        return self._state.copy(), {}

    def step(self, action: Any) -> Any:
        self._state = 0.9 * self._state + 0.1 * action[0]
        return self._state.copy(), -abs(float(self._state[0])), False, False, {}


gymnasium.register('SlowPoint-v0', lambda: Slow(Point()), max_episode_steps=10)
for slow, own, steps in (('Reacher', 'Reacher', 50), ('Pendulum', 'InvertedPendulum', 1000)):
    gymnasium.register(
        f'Slow{slow}-v0',
        lambda own=own: Slow(gymnasium.make(f'{own}-v5').unwrapped),
        max_episode_steps=steps,
    )
