"""SAC that learns where its memory is: on a GPU, without the host in between.

An update is one CUDA graph, recorded once: the drawing of steps and noise, the targets, both
losses, Adam, the temperature and the targets' step. The host only starts replays and waits for
none: it is ahead of the GPU until a phase's metrics are fetched. Between phases it copies what is
new in the memory D.

Only the steps and the noise drawn differ from `FlatSAC`, because they come from the device's
generator. The update itself and the states are the same. On a CPU the same functions run without
being recorded. `sac.compile` compiles the update for the GPU before it is recorded.
"""

import gc
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeAlias

import torch
from torch import Tensor

from codetr_ros.config import SacSettings
from codetr_ros.learners.flat_sac import FlatSAC
from codetr_ros.memory.on_device import DeviceMemory, columns
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.system.devices import usable

Call: TypeAlias = Callable[[], None]
WARM_UP_CALLS = 3
"""Calls before the recorded one, in which libraries set themselves up."""


class DeviceSAC(FlatSAC):
    """SAC whose weights, moments and steps lie on a device.

    Args:
        observation_size: O.
        action_size: A.
        settings: widths, learning rates and the rest.
        seed: of the initial weights; torch's global generators are seeded from it.
        device: cpu, cuda, cuda:1, ...
        record: turns an update into a faster one that does the same. Any updates that it takes
            meanwhile are undone. None: `cuda_graph` on a GPU, else the update itself.

    Raises:
        DeviceError: there is no such device here.
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        settings: SacSettings,
        seed: int,
        device: str,
        record: Callable[[Call], Call] | None = None,
    ) -> None:
        self.device = usable(device)
        with torch.accelerator.device_index(self.device.index):
            super().__init__(observation_size, action_size, settings, seed, self.device)
        self._record = record or (cuda_graph if self.device.type == 'cuda' else lambda call: call)
        self._steps: DeviceMemory | None = None
        self._recorded = self._sample_and_update

    def _example(self, observation_size: int, action_size: int) -> tuple[Tensor, ...]:
        width = 2 * observation_size + action_size + 2
        rows = torch.zeros(self.batch, width, device=self.device)
        noise = torch.zeros(2, self.batch, action_size, device=self.device)
        return *columns(rows, observation_size, action_size), noise

    def take(self, memory: Trajectories) -> bool:
        """Bring the steps on the device up to date with the memory D.

        To record an update uses the device's generator: at the first labelled steps, and when a
        source appears.

        Returns:
            Whether any step is labelled, so that `replay` may be called.
        """
        if not memory.labelled.count:
            return False
        if self._steps is None or self._steps.memory is not memory:
            self._steps = DeviceMemory(memory, self.discount, self.device)
        with torch.accelerator.device_index(self.device.index):
            if not self._steps.update():
                state = self.state()
                self._recorded = self._record(self._sample_and_update)
                self.load_state(state)
                self._sums.zero_()
        return True

    def replay(self, updates: int) -> dict[str, Tensor]:
        """Updates in a row, from the steps that were taken; on a GPU the host does not wait.

        Returns:
            The metrics of `SAC.update`, summed over the updates: scalars on the device.
        """
        with torch.accelerator.device_index(self.device.index):
            for _ in range(updates):
                self._recorded()
            return self._take_metrics()

    @torch.no_grad()
    def _sample_and_update(self) -> None:
        assert self._steps is not None, 'take a memory first'
        s, a, r, s2, going_on = self._steps.read(self._steps.draw(self.batch))
        noise = torch.randn(2, *a.shape, device=self.device)
        self._step(s, a, r, s2, going_on, noise)


def cuda_graph(call: Call) -> Call:
    """Record the work that a call starts on the current GPU; the result starts it again.

    The call must read and write tensors that stay where they are, and wait for nothing. Random
    numbers go on from one replay to the next: a graph uses the GPU's default generator, and a seed
    that is set between two replays takes effect in the second.

    Each recording has a stream of its own: when the first graph of a stream is freed, torch also
    frees what cuBLAS keeps for that stream, which its other graphs would still use.
    """
    stream = torch.cuda.Stream()  # type: ignore[no-untyped-call]
    stream.wait_stream(torch.cuda.current_stream())
    with torch.cuda.stream(stream):
        for _ in range(WARM_UP_CALLS):
            call()
    torch.cuda.current_stream().wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with _nothing_freed(), torch.cuda.graph(graph, stream=stream):
        call()
    return graph.replay


@contextmanager
def _nothing_freed() -> Iterator[None]:
    """Collect garbage before a recording and not during it: CUDA ends a recording during which
    another graph is freed, and only the collector frees learners, which refer to themselves.
    """
    gc.collect()
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()
