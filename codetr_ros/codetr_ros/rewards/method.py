"""What a reward method is: it turns composite rewards of segments into a reward for every step."""

from collections.abc import Mapping
from typing import ClassVar, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from codetr_ros.records import F32
from codetr_ros.trajectories import SegmentBatch, Trajectories


class RewardModelError(ValueError):
    """A reward model cannot be asked, trained or restored: names value, field and remedy."""


class RewardMethod(Protocol):
    """One way of making step rewards. Algorithm 1 knows reward methods by this protocol only.

    Labels are in the unit that `settings.reward_unit` asks for: in units of the target scale c
    (`scaled`), or as the task gives them (`raw`).
    """

    name: ClassVar[str]
    in_process_only: ClassVar[bool]
    """A reference that sees what no node may see; it runs in process only."""
    frozen: ClassVar[bool]
    """A label never changes once given: there is nothing to fit."""
    context: int
    """Steps before a segment that `label` wants in its batches: pass it to `segment_batch`."""

    @property
    def version(self) -> int:
        """Gradient steps taken."""

    @property
    def target_scale(self) -> float:
        """The unit c of composite rewards per step; 0 before `prepare`."""

    def prepare(self, memory: Trajectories) -> None:
        """Freeze the target scale c and the observations' moments: once, after the warm-up."""

    def gradient_step(self, memory: Trajectories, rng: np.random.Generator) -> dict[str, float]:
        """Learn from one batch, drawn from `memory` with `rng`.

        What else is random (dropout) comes from torch's global generator, which the caller seeds.
        """

    def label(self, batch: SegmentBatch) -> F32:
        """Step rewards (B, L) of segments, in the places of the batch's steps.

        Outside of `segment_steps(batch)`, in context and padding, they are 0.
        """

    def label_windows(self, batch: SegmentBatch) -> F32:
        """Step rewards (B,) of each window's last step (`codetr.labelling` is 'window')."""

    def state(self) -> dict[str, torch.Tensor]:
        """Everything that it takes to go on from here, in copies."""

    def load_state(self, state: Mapping[str, torch.Tensor]) -> None:
        """Go on from a `state()`.

        Raises:
            RewardModelError: it is another method's or architecture's; nothing has changed then.
        """


def segment_steps(batch: SegmentBatch) -> NDArray[np.bool_]:
    """Which steps (B, L) of a batch are its segments' own: neither context nor padding."""
    step = np.arange(batch.actions.shape[1])
    inside: NDArray[np.bool_] = (step >= batch.context[:, None]) & (step < batch.lengths[:, None])
    return inside


def measure_scale(target_scale: str, memory: Trajectories) -> float:
    """The unit c of composite rewards per step: positive, so that no sign ever changes."""
    return memory.score_scale() if target_scale == 'rms' else 1.0


def check_state(
    method: str, expected: Mapping[str, torch.Tensor], given: Mapping[str, torch.Tensor]
) -> None:
    """Refuse a state that is not one of this very method and architecture.

    Args:
        method: whose state is expected, for the error.
        expected: a state of it, for names, shapes and types.
        given: the state to be loaded.

    Raises:
        RewardModelError: a tensor is missing, unknown, of another shape or type, or not finite.
    """
    wrong = [f'{name} is missing' for name in expected if name not in given]
    wrong += [f'{name} is unknown' for name in given if name not in expected]
    for name, tensor in given.items():
        if name not in expected:
            continue
        want = expected[name]
        if (tensor.shape, tensor.dtype) != (want.shape, want.dtype):
            wrong.append(
                f'{name} is {tuple(tensor.shape)} {tensor.dtype}, '
                f'expected {tuple(want.shape)} {want.dtype}'
            )
        elif tensor.is_floating_point() and not bool(tensor.isfinite().all()):
            wrong.append(f'{name} has values that are not finite')
    if wrong:
        more = f' and {len(wrong) - 5} more' if len(wrong) > 5 else ''
        raise RewardModelError(
            f'state of reward method {method!r} refused: {"; ".join(wrong[:5])}{more}. '
            f'It belongs to other settings or another task: use those it was saved with'
        )
