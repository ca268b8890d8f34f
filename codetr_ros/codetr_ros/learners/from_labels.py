"""SAC on the inferred step rewards: the policy learner of every method that labels steps."""

from collections.abc import Mapping
from functools import partial

import numpy as np
from torch import Tensor

from codetr_ros.config import Settings
from codetr_ros.learners.base import OffPolicy
from codetr_ros.learners.device_sac import DeviceSAC
from codetr_ros.learners.flat_sac import FlatSAC
from codetr_ros.memory.ring import PROGRESS
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.policy.actor import Actor
from codetr_ros.policy.network import describe_network


class FromLabels(OffPolicy):
    """Soft actor-critic that draws labelled steps.

    Args:
        settings: the run's settings.
        observation_size: O of the task.
        action_size: A of the task.
    """

    lacking = 'nothing labelled'

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        super().__init__(settings)
        self._sac = self._make(observation_size, action_size)
        self.network = describe_network(observation_size, action_size, settings.sac.hidden)

    def _make(self, observation_size: int, action_size: int) -> FlatSAC:
        settings = self._settings
        progress = PROGRESS if settings.progress else 0
        return FlatSAC(
            observation_size, action_size, settings.sac, settings.seed, progress=progress
        )

    @property
    def actor(self) -> Actor:
        """The policy network."""
        return self._sac.actor

    def _prepare(self, memory: Trajectories) -> bool:
        return memory.labelled.count > 0

    def _burst(
        self, memory: Trajectories, rng: np.random.Generator, updates: int
    ) -> dict[str, Tensor]:
        return self._sac.burst(updates, partial(memory.labelled.sample, rng))

    def state(self) -> dict[str, Tensor]:
        """Copies of everything needed to go on from here."""
        return self._sac.state()

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a `state()`.

        Raises:
            SacError: it is of another architecture; nothing has changed then.
        """
        self._sac.load_state(dict(state))


class FromLabelsOnDevice(FromLabels):
    """The same learner on the device of the settings, which draws the steps itself."""

    _sac: DeviceSAC

    def _make(self, observation_size: int, action_size: int) -> DeviceSAC:
        settings = self._settings
        return DeviceSAC(
            observation_size, action_size, settings.sac, settings.seed, settings.device
        )

    def _prepare(self, memory: Trajectories) -> bool:
        return self._sac.take(memory)

    def _burst(
        self, memory: Trajectories, rng: np.random.Generator, updates: int
    ) -> dict[str, Tensor]:
        return self._sac.replay(updates)
