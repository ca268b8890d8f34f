"""The steps of the memory D on a device: labelled ones for SAC, segments for a reward model.

A step is one row there. New steps are copied in a few pieces, and batches are gathered on the
device. `DeviceMemory` holds for SAC

    s (O) | a (A) | s' (O) | gamma (1 - terminated) | label

with s' spelt out, at 4 (2 O + A + 2) bytes a step: 0.9 GB for a million steps of Ant with 105
observations. Room is made with the first steps, for as many as each source may have. The labels
are all copied together, since a reward model changes all of them: 4 MB for a million. Evicted
steps have no label any more.

`DeviceSteps` holds observation and action, at 4 (O + A) bytes a step: 140 MB for a million of Ant.
Gathering a million steps in whole segments takes half a second on a CPU, and every phase labels
all of them. Therefore segments are put together on the device.
"""

from abc import ABC, abstractmethod

import numpy as np
import torch
from torch import Tensor

from codetr_ros.memory.ring import SourceRing
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F32, I64
from codetr_ros.system.devices import DeviceError

COPIED_AT_ONCE = 65_536
"""Steps that are put into rows at once: more would take memory and save no time."""


class DeviceRows(ABC):
    """The steps of the memory D on a device, each in the row of its slot, source after source.

    The tensors stay where they are, so that a recorded update finds them, until another source
    appears.

    Args:
        memory: the memory D, on the host.
        device: where the rows lie.
        setting: the setting that names the device.
        bytes_per_step: memory of a step there.
    """

    rows: Tensor

    def __init__(
        self, memory: Trajectories, device: torch.device, setting: str, bytes_per_step: int
    ) -> None:
        self.memory = memory
        self._device = device
        self._setting = setting
        self._bytes_per_step = bytes_per_step
        self._copied: list[int] = []  # of each source, the row after the last one that is here

    @abstractmethod
    def _take(self, size: int) -> None:
        """Make the tensors for so many steps, `rows` among them."""

    @abstractmethod
    def _packed(self, ring: SourceRing, slots: I64) -> F32:
        """The rows of the steps in some slots of a source."""

    def _blocks(self, rings: list[SourceRing]) -> tuple[Tensor, ...]:
        """The rows of each source."""
        return torch.split(self.rows, [ring.capacity for ring in rings])

    def _copy(self, rings: list[SourceRing]) -> bool:
        """Copy the steps that are new in D.

        Returns:
            Whether the rows have stayed where they were.

        Raises:
            DeviceError: the device has no room.
        """
        stayed = len(rings) == len(self._copied)
        if not stayed:
            self._allocate(rings)
        for i, (ring, rows) in enumerate(zip(rings, self._blocks(rings), strict=True)):
            for slots in ring.slots_from(self._copied[i], COPIED_AT_ONCE):
                new = torch.from_numpy(self._packed(ring, slots)).to(self._device)
                rows.index_copy_(0, torch.from_numpy(slots).to(self._device), new)
            self._copied[i] = ring.end
        return stayed

    def _allocate(self, rings: list[SourceRing]) -> None:
        """Make room for all that the sources' rings can hold."""
        size = sum(ring.capacity for ring in rings)
        self._take(0)  # frees the old rows before the new ones are made
        try:
            self._take(size)
        except RuntimeError as error:  # torch's error when a GPU is out of memory
            raise DeviceError(
                f'{self._setting}={self._device}: no room for {size} steps of '
                f'{self._bytes_per_step} bytes, memory_steps for each of {len(rings)} '
                'environments: lower memory_steps, simulators or envs, or set '
                f'{self._setting}=cpu. Error of torch: {error}'
            ) from error
        self._copied = [0] * len(rings)


class DeviceMemory(DeviceRows):
    """Steps as SAC draws them, and which of them are labelled.

    Args:
        memory: the memory D, on the host.
        discount: gamma.
        device: where the rows lie.
    """

    def __init__(self, memory: Trajectories, discount: float, device: torch.device) -> None:
        self._width = 2 * memory.observation_size + memory.action_size + 2
        super().__init__(memory, device, 'device', 4 * self._width + 8)
        self._discount = discount

    def update(self) -> bool:
        """Copy the steps that are new in D, and all labels, new or changed or gone.

        Returns:
            Whether the rows have stayed where they were.

        Raises:
            DeviceError: the device has no room.
        """
        rings = self.memory.store.sources
        stayed = self._copy(rings)
        for ring, rows in zip(rings, self._blocks(rings), strict=True):
            labels = torch.from_numpy(ring.labels[: ring.used])
            rows[: ring.used, -1] = labels.to(self._device)
        labelled = self.rows[:, -1].isfinite().nonzero().squeeze(1)  # waits for the device
        self._labelled[: len(labelled)] = labelled
        self._count.fill_(len(labelled))
        return stayed

    def _take(self, size: int) -> None:
        self.rows = torch.full((size, self._width), torch.nan, device=self._device)
        self._labelled = torch.zeros(size, dtype=torch.int64, device=self._device)
        self._count = torch.zeros((), dtype=torch.int64, device=self._device)

    def _packed(self, ring: SourceRing, slots: I64) -> F32:
        steps = ring.steps_in(slots)
        going_on = np.float32(self._discount) * (1 - steps.terminated.astype(np.float32))
        last = np.stack([going_on, steps.rewards], 1)
        parts = (steps.observations, steps.actions, steps.next_observations, last)
        return np.concatenate(parts, 1)

    def draw(self, batch: int) -> Tensor:
        """Rows (B,) of labelled steps, uniform and with replacement; one step must be labelled.

        It draws from the device's generator. Odds are even up to (labelled steps) / 2^62: the
        number of labelled steps is read on the device, so that a recorded draw follows it.
        """
        numbers = torch.randint(1 << 62, (batch,), device=self._device)
        return self._labelled[numbers % self._count]

    def read(self, rows: Tensor) -> tuple[Tensor, ...]:
        """The steps of some rows (B,), as `columns` gives them."""
        return columns(self.rows[rows], self.memory.observation_size, self.memory.action_size)


def columns(rows: Tensor, observation_size: int, action_size: int) -> tuple[Tensor, ...]:
    """The parts of rows (B, 2 O + A + 2), in views.

    Returns:
        s (B, O), a (B, A), labels (B,), s' (B, O), gamma (1 - terminated) (B,).
    """
    widths = [observation_size, action_size, observation_size, 1, 1]
    s, a, s2, going_on, r = torch.split(rows, widths, 1)
    return s, a, r.squeeze(1), s2, going_on.squeeze(1)


class DeviceSteps(DeviceRows):
    """Steps as a reward model reads them, the sources in the order of their names.

    Args:
        memory: the memory D, on the host.
        device: where the rows lie.
    """

    def __init__(self, memory: Trajectories, device: torch.device) -> None:
        self._sizes = [memory.observation_size, memory.action_size]
        super().__init__(memory, device, 'reward_device', 4 * sum(self._sizes))

    def update(self) -> None:
        """Copy the steps that are new in D.

        Raises:
            DeviceError: the device has no room.
        """
        rings = self.memory.store.by_name()
        if not self._copy(rings):
            capacities = torch.tensor([ring.capacity for ring in rings])
            self._capacities = capacities.to(self._device)
            self._firsts = (capacities.cumsum(0) - capacities).to(self._device)

    def _take(self, size: int) -> None:
        self.rows = torch.zeros(size, sum(self._sizes), device=self._device)

    def _packed(self, ring: SourceRing, slots: I64) -> F32:
        return np.concatenate([ring.observations[slots], ring.actions[slots]], 1)

    def read(self, ids: I64, context: int) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Segments by id, each with up to `context` steps of its episode before it.

        Returns:
            Observations (B, L, O) before each step and actions (B, L, A), 0 in the padding on the
            right; which steps (B, L) exist, and which of them are the segments' own.
        """
        places = np.stack(self.memory.segments.places(ids, context))  # (4, B)
        source, row, length, before = torch.from_numpy(places).to(self._device)[..., None]
        step = torch.arange(int(places[2].max()), device=self._device)
        there = step < length  # (B, L)
        slots = self._firsts[source] + (row + step) % self._capacities[source]
        steps = self.rows[slots].masked_fill_(~there[..., None], 0)
        observations, actions = torch.split(steps, self._sizes, -1)
        return observations, actions, there, there & (step >= before)
