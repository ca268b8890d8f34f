"""A recorded episode once more: reset with its seed, an environment takes its actions again."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from codetr_ros.records import F32
from codetr_ros.seeding import generator
from codetr_ros.simulation.environments import Environment
from codetr_ros.simulation.open_episode import DiffersError


@dataclass(frozen=True, eq=False)
class Recorded:
    """An episode from its first step on.

    Attributes:
        source: whose it is.
        episode: its number.
        observations: (T, O) before each step.
        actions: (T, A).
    """

    source: str
    episode: int
    observations: F32
    actions: F32


def replay(environment: Environment, seed: int, recorded: Recorded) -> Iterator[int]:
    """Bring an environment through an episode; yields each step before it is taken.

    Args:
        environment: made under the run's seed, as its source makes it.
        seed: of the run.
        recorded: the episode.

    Raises:
        DiffersError: the environment does something else than recorded, as one does that draws
            random numbers within an episode.
        TaskError: it is at fault.
    """
    seeds = generator(seed, 'reset', recorded.source, recorded.episode)
    observation = environment.reset(int(seeds.integers(2**31)))
    for step, (was, action) in enumerate(
        zip(recorded.observations, recorded.actions, strict=True)
    ):
        if not np.array_equal(observation, was, equal_nan=True):
            raise DiffersError(f'the observation of step {step} is not the recorded one')
        yield step
        observation, _, _ = environment.step(action)
