"""Environments as people write them, each with one peculiarity, and what they wrap around them."""

import random
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.envs.registration import WrapperSpec

HORIZON = 50


class Point(gymnasium.Env):
    """A point that is to stay near 0. Observation: place and time; reward: minus the distance."""

    metadata = {'render_modes': []}
    observation_space = spaces.Box(-np.inf, np.inf, (2,))
    action_space = spaces.Box(-1.0, 1.0, (1,))

    def __init__(self) -> None:
        self.seen = []

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.t = float(self.np_random.uniform(-1, 1)), 0
        return self.observe(), {}

    def step(self, action):
        self.seen.append(action.copy())
        self.x = float(np.clip(self.x + 0.1 * float(np.ravel(action)[0]), -2, 2)) + self.drift()
        self.t += 1
        return self.observe(), self.reward(), *self.ends(), {}

    def observe(self):
        return np.array([self.x, self.t], self.observation_space.dtype)

    def reward(self):
        return -abs(self.x)

    def ends(self):
        return False, False

    def drift(self):
        return 0.0


class OfParts(Point):
    """Its observations are dictionaries."""

    observation_space = spaces.Dict(
        place=spaces.Box(-9, 9, (1,)), clock=spaces.Box(0, 99, (1,), np.float64)
    )

    def observe(self):
        return {'place': np.array([self.x], np.float32), 'clock': np.array([float(self.t)])}


class Wide(Point):
    """Its actions are large and not around 0."""

    action_space = spaces.Box(-30.0, 90.0, (1,))


class Ends(Point):
    """Falls into a terminal state, or cuts the episode off itself, at random."""

    def ends(self):
        u = self.np_random.random()
        return bool(u < 0.03), bool(u > 0.9)


class TimesTen(gymnasium.RewardWrapper):
    """Another reward."""

    def reward(self, reward):
        return 10 * reward + 100


class PlusOne(gymnasium.ObservationWrapper):
    """Another observation."""

    def observation(self, observation):
        return observation + 1


class Skip(gymnasium.Wrapper):
    """Four frames for each action."""

    def step(self, action):
        total = 0.0
        for _ in range(4):
            observation, reward, terminated, truncated, info = self.env.step(action)
            total += reward
            if terminated or truncated:
                break
        return observation, total, terminated, truncated, info


@contextmanager
def registered(
    entry_point: Any, horizon: int | None = HORIZON, wrappers: tuple[WrapperSpec, ...] = ()
) -> Iterator[str]:
    """The name of an environment that is registered meanwhile."""
    name = 'Own-v0'
    gymnasium.register(name, entry_point, max_episode_steps=horizon, additional_wrappers=wrappers)
    try:
        yield name
    finally:
        del gymnasium.registry[name]


def around(entry_point: str, **arguments: Any) -> WrapperSpec:
    """A wrapper in a registration."""
    return WrapperSpec(entry_point.rpartition(':')[2], entry_point, arguments)


class OfPython(Point):
    """Draws from Python's generator."""

    def drift(self):
        return random.uniform(-0.1, 0.1)


class OfNumpy(Point):
    """Draws from numpy's generator."""

    def drift(self):
        return float(np.random.uniform(-0.1, 0.1))  # noqa: NPY002


class OfTorch(Point):
    """Draws from torch's generator."""

    def drift(self):
        return float(torch.rand(())) / 10


class OfItsSpace(Point):
    """Draws its starts from a space of its own."""

    def __init__(self) -> None:
        super().__init__()
        self.observation_space = spaces.Box(-1.0, 1.0, (2,))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.x, self.t = float(self.observation_space.sample()[0]), 0
        return self.observe(), {}


class Forgetful(Point):
    """Does not pass its seed on."""

    def reset(self, *, seed=None, options=None):
        self.x, self.t = float(self.np_random.uniform(-1, 1)), 0
        return self.observe(), {}


class OfOldNumpy(Point):
    """Has a generator of its own, of another kind, as environments had before Gymnasium."""

    def reset(self, *, seed=None, options=None):
        self.np_random = np.random.RandomState(seed)
        self.x, self.t = float(self.np_random.rand()), 0
        return self.observe(), {}


class BuiltAtRandom(Point):
    """Draws what it is when it is made."""

    def __init__(self) -> None:
        super().__init__()
        self.goal = random.uniform(-1, 1)

    def reward(self):
        return -abs(self.x - self.goal)
