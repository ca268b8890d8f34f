"""The protocol of policy learners, which turn the memory D into a policy, phase by phase."""

import time
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import Protocol

import numpy as np
import torch
from torch import Tensor, nn

from codetr_ros.config import Settings
from codetr_ros.memory import draws
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.policy.actor import Actor
from codetr_ros.seeding import seed_torch


class LearnerError(ValueError):
    """A policy learner that has diverged, cannot be restored or lacks room: names value, field and
    remedy.
    """


class PolicyLearner(Protocol):
    """One way of learning a policy. Algorithm 1 knows policy learners by this protocol only."""

    updates: int
    """Updates taken so far, whatever an update is."""
    counters: 'Counter[str]'
    """What was left out and why, for the run's summary."""

    @property
    def actor(self) -> nn.Module:
        """The policy network, with whose weights simulators act."""

    @property
    def network(self) -> str:
        """The description of the policy network, as `describe_network` makes it."""

    def train(self, phase: int, memory: Trajectories) -> Iterator[dict[str, float]]:
        """Learn from the memory once it has received a phase.

        Each `next()` does one slice, which seeds its own random streams, so that neither
        interleaving nor a restart changes what is drawn. It yields metrics, mostly none.

        Raises:
            LearnerError: the policy is not finite any more.
        """

    def state(self) -> dict[str, Tensor]:
        """Copies of everything needed to go on from here."""

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a `state()`.

        Raises:
            LearnerError: it is another learner's or architecture's; nothing has changed then.
        """


class OffPolicy(ABC):
    """A learner whose updates draw batches from the whole memory, in bursts.

    After each phase it takes `sac.updates_per_step` updates for each step of the phase;
    `sac.burst` of them are a slice.

    Args:
        settings: the run's settings.
    """

    lacking: str
    """Why there is nothing to draw from the memory, for the count of skipped updates."""

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.updates = 0
        self.counters: Counter[str] = Counter()

    @property
    @abstractmethod
    def actor(self) -> Actor:
        """The policy network."""

    @abstractmethod
    def _prepare(self, memory: Trajectories) -> bool:
        """Prepare to draw from the memory, which does not change during a phase's updates. True if
        there is anything to draw.
        """

    @abstractmethod
    def _burst(
        self, memory: Trajectories, rng: np.random.Generator, updates: int
    ) -> dict[str, Tensor]:
        """Updates in a row, from batches drawn with `rng`; torch's global generator is seeded.

        Returns:
            Scalar tensors, summed over the updates: their means over the phase are its metrics.
        """

    def train(self, phase: int, memory: Trajectories) -> Iterator[dict[str, float]]:
        """Take the updates of the phase, or none if there is nothing to draw.

        Raises:
            LearnerError: the policy is not finite any more.
        """
        settings = self._settings
        due = draws.updates_of(settings, phase)
        began = time.perf_counter()
        if not self._prepare(memory):
            self.counters[f'updates skipped, {self.lacking}'] += due
            return
        totals: dict[str, Tensor] = {}
        for burst in draws.bursts(settings, phase):
            seed_torch(settings.seed, 'learner', phase, burst.first)
            add(totals, self._burst(memory, burst.rng, burst.updates))
            self.updates += burst.updates
            yield {}
        means = {name: float(total) / due for name, total in totals.items()}
        if not all(bool(weight.isfinite().all()) for weight in self.actor.parameters()):
            raise LearnerError(
                f'the policy is not finite after phase {phase} ({means}): training has diverged. '
                'Lower sac.actor_learning_rate and sac.critic_learning_rate, or set '
                'target_scale=rms and reward_unit=scaled'
            )
        yield means | {'update_seconds': time.perf_counter() - began}


def add(totals: dict[str, Tensor], values: Mapping[str, Tensor]) -> None:
    """Add values to totals of the same names."""
    for name, value in values.items():
        totals[name] = totals.get(name, torch.zeros(())) + value
