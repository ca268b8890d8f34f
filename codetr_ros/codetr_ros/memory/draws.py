"""The draws of a policy learner's updates from the memory, which the reward side can predict.

An update's randomness depends only on the run's seed, the phase and the update's place in it. So
the reward side, whose memory has the same steps and the same labels, knows which steps the learner
is about to draw, and need not label any others (`relabel` 'drawn').
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import I64
from codetr_ros.seeding import generator


@dataclass(frozen=True, eq=False, slots=True)
class Burst:
    """Updates in a row with a random stream of their own: neither interleaving nor a restart
    changes their draws.
    """

    first: int  # the number of its first update within the phase
    updates: int
    rng: np.random.Generator


def updates_of(settings: Settings, phase: int) -> int:
    """Updates that an off-policy learner takes after a phase."""
    return round(settings.steps_of(phase) * settings.sac.updates_per_step)


def bursts(settings: Settings, phase: int) -> Iterator[Burst]:
    """The updates of a phase, `sac.burst` at a time."""
    due = updates_of(settings, phase)
    for first in range(0, due, settings.sac.burst):
        rng = generator(settings.seed, 'learner', phase, first)
        yield Burst(first, min(settings.sac.burst, due - first), rng)


def drawn(settings: Settings, phase: int, memory: Trajectories) -> I64:
    """The steps that SAC's updates of a phase will draw, from the labelled steps as they are now.

    Returns:
        Places among the labelled steps (`LabelledSteps.draw`), ascending, each once.
    """
    chosen = np.zeros(memory.labelled.count, np.bool_)
    if len(chosen):
        for burst in bursts(settings, phase):
            for _ in range(burst.updates):
                chosen[memory.labelled.draw(burst.rng, settings.sac.batch)] = True
    return np.flatnonzero(chosen)
