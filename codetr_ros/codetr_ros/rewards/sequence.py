"""The base of the methods with a transformer over the steps of a window: CoDeTr and RBT."""

import math
from abc import abstractmethod
from collections.abc import Iterator, Mapping
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from codetr_ros.config import CodetrSettings, Settings
from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.on_device import DeviceSteps
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F32
from codetr_ros.rewards.base import RewardModelError, segment_steps
from codetr_ros.rewards.learned import Learned
from codetr_ros.rewards.transformer import CausalTransformer
from codetr_ros.system import freed_memory

ARRAY_BYTES = 16 << 20
"""The most bytes of activations of one kind, where several windows are processed at once: half of
the largest block that the C library serves from memory it keeps (`freed_memory`).
"""
DEVICE_ARRAY_BYTES = 1 << 30
"""The same on a device other than the CPU, which needs much work at a time.

With an eighth of it an H200 labels 0.84 times as many steps a second (gpu_check in benchmarks/).
"""
PART_WINDOWS = 65_535
"""The most windows at a time: as many sequences as CUDA's kernels for attention take."""

PEAK = 10
"""By how much the highest learning rate exceeds the last one, where it falls."""


class SequenceMethod(Learned):
    """A transformer that sees a segment with up to `context` steps of its episode before it.

    Args:
        settings: the run's settings; the initial weights depend on its seed.
        observation_size: O.
        action_size: A.
        context: steps before a segment that the network sees in training and in labelling.
        whole_window: whether these attend and are attended to within the sequence.
    """

    group: ClassVar[str] = 'codetr'

    def __init__(
        self,
        settings: Settings,
        observation_size: int,
        action_size: int,
        context: int,
        whole_window: bool,
    ) -> None:
        self._codetr = settings.codetr
        self.context = context
        self.label_batch = settings.codetr.label_batch
        self._whole_window = whole_window
        self._positions = max(settings.longest + context, settings.codetr.window)
        self._on_device: DeviceSteps | None = None
        freed_memory.keep()
        super().__init__(settings, observation_size, action_size)

    def label_passes(self, memory: Trajectories, ids: NDArray[np.int64]) -> Iterator[F32]:
        """Labels of the segments' steps, from whole segments or from windows (`labelling`)."""
        if self._codetr.labelling == 'segment' and self.device.type != 'cpu':
            yield self.label_on_device(memory, ids)
        elif self._codetr.labelling == 'segment':
            yield from super().label_passes(memory, ids)
        else:
            for batch in memory.segments.windows(ids, self._codetr.window, self.label_batch):
                yield self.label_windows(batch)

    def label_on_device(self, memory: Trajectories, ids: NDArray[np.int64]) -> F32:
        """The same labels of whole segments, put together on the network's device."""
        self._require_prepared()
        if self._on_device is None or self._on_device.memory is not memory:
            self._on_device = DeviceSteps(memory, self.device)
        self._on_device.update()
        self.network.eval()
        labels = []
        longest = int(memory.segments.lengths(ids).max()) + self.context
        with torch.inference_mode():
            for some in np.array_split(ids, self._part_count(len(ids), longest)):
                observations, actions, there, own = self._on_device.read(some, self.context)
                inside = there if self._whole_window else own
                rewards = self._read_off(self._standardised(observations), actions, inside)
                labels.append(rewards[own].cpu().numpy())
        return self._in_unit(np.concatenate(labels))

    def state(self) -> dict[str, Tensor]:
        """What every network has, and for pairs of tokens which one is first."""
        if self._codetr.tokens == 'merged':
            return super().state()
        return super().state() | {'action_first': torch.tensor(int(self._causal.action_first))}

    def load_state(self, state: Mapping[str, Tensor]) -> None:
        """Go on from a `state()`. One that names no order of tokens has the state first.

        Raises:
            RewardModelError: it is another method's or architecture's; nothing has changed then.
        """
        if self._codetr.tokens == 'merged':
            super().load_state(state)
            return
        state = {'action_first': torch.tensor(0), **state}
        super().load_state(state)
        self._causal.action_first = bool(state['action_first'])

    @property
    def _causal(self) -> CausalTransformer:
        causal = self.network.get_submodule('causal')
        assert isinstance(causal, CausalTransformer)
        return causal

    @property
    def single_steps(self) -> bool:
        """Whether each step has a window of its own (`labelling`)."""
        return self._codetr.labelling == 'window'

    def step_passes(
        self, memory: Trajectories, ids: NDArray[np.int64], within: NDArray[np.int64]
    ) -> Iterator[F32]:
        """Labels of single steps, from windows."""
        for batch in memory.segments.step_windows(
            ids, within, self._codetr.window, self.label_batch
        ):
            yield self.label_windows(batch)

    def label_windows(self, batch: SegmentBatch) -> F32:
        """Step rewards (B,) of the last step of each window."""
        labels = self.label(batch)
        return labels[np.arange(len(labels)), batch.lengths - 1]

    def _parts(self, batch: SegmentBatch) -> list[SegmentBatch]:
        """The batch in parts of equal size, none of which makes larger arrays than `ARRAY_BYTES`.

        They stay in the processor's cache, and their memory is used again.
        """
        windows, steps = batch.actions.shape[:2]
        size = -(-windows // self._part_count(windows, steps))
        return [batch.part(slice(i, i + size)) for i in range(0, windows, size)]

    def _part_count(self, windows: int, steps: int) -> int:
        """The number of parts into which windows of so many steps are divided."""
        most = ARRAY_BYTES if self.device.type == 'cpu' else DEVICE_ARRAY_BYTES
        tokens = steps * (2 if self._codetr.tokens == 'pair' else 1)
        widest = max(4 * self._codetr.embedding, self._codetr.heads * tokens) * tokens * 4
        return -(-windows // min(PART_WINDOWS, max(1, most // widest)))

    @abstractmethod
    def _read_off(self, observations: Tensor, actions: Tensor, inside: Tensor) -> Tensor:
        """Step rewards (B, L) in units of c, of the network's inputs as `_inputs` gives them."""

    def _step_rewards(self, batch: SegmentBatch) -> Tensor:
        return self._read_off(*self._inputs(batch))

    def _learning_rate(self) -> float:
        return learning_rate(self._codetr, self.gradient_steps)

    def _inputs(self, batch: SegmentBatch) -> tuple[Tensor, Tensor, Tensor]:
        """Observations (B, L, O), actions (B, L, A) and the steps that attend (B, L)."""
        step = np.arange(batch.actions.shape[1])
        inside = step < batch.lengths[:, None] if self._whole_window else segment_steps(batch)
        if len(step) > self._positions:
            raise RewardModelError(
                f'a window of {len(step)} steps: this model has places for {self._positions}, by '
                f'delay = {self._settings.delay} and codetr.window = {self._codetr.window}'
            )
        observations = self._standardised(batch.observations[:, :-1])
        return observations, self._put(batch.actions), self._put(inside)


def learning_rate(settings: CodetrSettings, step: int) -> float:
    """The learning rate of gradient step `step` (0, 1, ...).

    It rises linearly over `warmup_gradient_steps`, the last of which has the full rate, then stays
    there or falls on a half cosine to a tenth of it at `total_gradient_steps`, where it remains.

    The schedule 'peaked' of the published code of this family, to which the supplement's rate is
    the first and the last one, is ten times that: it rises from a tenth of its peak.

    In words: docs/methods.md#codetr.
    """
    warmup = settings.warmup_gradient_steps
    peak = settings.learning_rate * (PEAK if settings.schedule == 'peaked' else 1)
    if step < warmup and settings.schedule == 'peaked':
        return settings.learning_rate * (1 + (PEAK - 1) * step / warmup)
    if step < warmup:
        return peak * (step + 1) / warmup
    if settings.schedule == 'constant':
        return peak
    progress = min(1.0, (step - warmup) / max(1, settings.total_gradient_steps - warmup))
    return peak * (1 / PEAK + (1 - 1 / PEAK) * 0.5 * (1 + math.cos(math.pi * progress)))
