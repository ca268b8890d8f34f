"""What a reward model on a GPU reads of the memory D when it labels: copied once, gathered there.

A step is one row, its observation and its action, at 4 (O + A) bytes a step: 140 MB for a million
of Ant. Gathering a million steps in whole segments takes half a second on a CPU, and all of them
are labelled in every phase: so what is new is copied, and segments are put together on the device.
"""

import numpy as np
import torch
from torch import Tensor

from codetr_ros.devices import DeviceError
from codetr_ros.records import I64
from codetr_ros.source_ring import SourceRing
from codetr_ros.trajectories import Trajectories

COPIED_AT_ONCE = 65_536
"""Steps that are copied in one go."""


class DeviceSteps:
    """The steps of the memory on a device, each in the row of its slot, source after source.

    Args:
        memory: the memory D, on the host.
        device: where the rows lie.
    """

    def __init__(self, memory: Trajectories, device: torch.device) -> None:
        self.memory = memory
        self._device = device
        self._copied: list[int] = []  # of each source, the row after the last one that is here

    def update(self) -> None:
        """Take in what is new in D.

        Raises:
            DeviceError: the device has no room.
        """
        rings = sorted(self.memory.sources, key=lambda ring: ring.name)
        if len(rings) != len(self._copied):
            self._allocate(rings)
        blocks = torch.split(self.rows, [ring.capacity for ring in rings])
        for i, (ring, rows) in enumerate(zip(rings, blocks, strict=True)):
            for slots in ring.slots_from(self._copied[i], COPIED_AT_ONCE):
                new = np.concatenate([ring.observations[slots], ring.actions[slots]], 1)
                rows[torch.from_numpy(slots).to(self._device)] = torch.tensor(new).to(self._device)
            self._copied[i] = ring.end

    def _allocate(self, rings: list[SourceRing]) -> None:
        size = sum(ring.capacity for ring in rings)
        width = self.memory.observation_size + self.memory.action_size
        self.rows = torch.empty(0)  # the old ones go before the new ones come
        try:
            self.rows = torch.zeros(size, width, device=self._device)
        except RuntimeError as error:  # torch's own where a GPU is out of memory
            raise DeviceError(
                f'reward_device={self._device}: no room for {size} steps of {4 * width} bytes: '
                f'lower memory_steps, or set reward_device=cpu. torch said: {error}'
            ) from error
        capacities = torch.tensor([ring.capacity for ring in rings])
        self._capacities = capacities.to(self._device)
        self._firsts = (capacities.cumsum(0) - capacities).to(self._device)
        self._copied = [0] * len(rings)

    def read(self, ids: I64, context: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Segments by id, each with up to `context` steps of its episode before it.

        Returns:
            Observations (B, L, O) before each step and actions (B, L, A), 0 in the padding on the
            right, and which steps (B, L) there are, and which of them are the segments' own.
        """
        places = np.stack(self.memory.places(ids, context))  # (4, B)
        source, row, length, before = torch.from_numpy(places).to(self._device)[..., None]
        step = torch.arange(int(places[2].max()), device=self._device)
        there = step < length  # (B, L)
        slots = self._firsts[source] + (row + step) % self._capacities[source]
        steps = self.rows[slots].masked_fill_(~there[..., None], 0)
        sizes = [self.memory.observation_size, self.memory.action_size]
        observations, actions = torch.split(steps, sizes, -1)
        return observations, actions, there, there & (step >= before)
