"""The steps of a segment before a given one: drawn from the memory, and valued by a network.

Shapes: S = segments, L = steps of the longest, B = batch of steps, O = observation size, A =
action size. Everything comes for two critics at once, in a leading dimension of 2.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from codetr_ros.config import HcSettings
from codetr_ros.learners.sac import q_values, twin_critic
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import F32, F64, I64


@dataclass(frozen=True, eq=False, slots=True, kw_only=True)
class HistoryBatch:
    """Steps with their whole segments, which are padded with zeros on the right to L steps."""

    observations: F32  # (S, L+1, O): the observation before each step, and the one after the last
    actions: F32  # (S, L, A)
    lengths: I64  # (S,)
    values: F64  # (S,) the composite rewards
    terminal: NDArray[np.bool_]  # (S,) the segment ended in a terminal state
    owners: I64  # (B,) each step's segment: an index of the segments
    steps: I64  # (B,) the step's index t - t_i within its segment


class ScoredSteps:
    """The steps of all scored segments, as the memory holds them now."""

    def __init__(self, memory: Trajectories) -> None:
        self._memory = memory
        self._ids = memory.segments.ids()
        lengths = [lengths for *_, lengths in memory.segments.spans(self._ids)]
        self._ends = np.cumsum(np.concatenate(lengths)) if lengths else np.zeros(0, np.int64)

    def __len__(self) -> int:
        return int(self._ends[-1]) if len(self._ends) else 0

    def sample(self, rng: np.random.Generator, segments: int, batch: int) -> HistoryBatch:
        """Draw steps uniformly, with replacement, `batch` of them from `segments` segments.

        Each step is as likely as any other; steps that share a segment share the pass over it. A
        segment is drawn in proportion to its length.
        """
        drawn = np.searchsorted(self._ends, rng.integers(0, len(self), segments), side='right')
        ids = self._ids[drawn]
        whole = self._memory.segments.batch(ids)
        owners = np.arange(batch, dtype=np.int64) % segments
        return HistoryBatch(
            observations=whole.observations,
            actions=whole.actions,
            lengths=whole.lengths,
            values=whole.values,
            terminal=self._memory.segments.terminal(ids),
            owners=owners,
            steps=rng.integers(0, whole.lengths[owners]),
        )


class Singleton(nn.Module):
    """H(history) = the sum of b(s, a) over the history, b a network like the critic."""

    def __init__(
        self, observation_size: int, action_size: int, hidden: Sequence[int], _: HcSettings
    ) -> None:
        super().__init__()
        sizes = [observation_size + action_size, *hidden, 1]
        self.steps = nn.ParameterList(twin_critic(sizes))

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        """The values (2, S, L+1) of the first 0, 1, ..., L steps of segments.

        Args:
            observations: (S, L, O), before each step.
            actions: (S, L, A).
        """
        segments, steps, _ = actions.shape
        values = q_values(list(self.steps), observations.flatten(0, 1), actions.flatten(0, 1))
        return nn.functional.pad(values.view(2, segments, steps).cumsum(-1), (1, 0))


class Recurrent(nn.Module):
    """H(history) = a linear function of the state of a GRU that has read the history.

    The state before the first step is zero, so that only the linear function's bias is learnt
    there. A segment is read once and gives the values of all its beginnings: the GRU is causal, so
    that whatever follows a beginning, padding included, changes nothing.
    """

    def __init__(
        self, observation_size: int, action_size: int, _: Sequence[int], settings: HcSettings
    ) -> None:
        super().__init__()
        inputs, width = observation_size + action_size, settings.width
        self.grus = nn.ModuleList(nn.GRU(inputs, width, batch_first=True) for _ in range(2))
        self.heads = nn.ModuleList(nn.Linear(width, 1) for _ in range(2))

    def forward(self, observations: Tensor, actions: Tensor) -> Tensor:
        """The values (2, S, L+1) of the first 0, 1, ..., L steps of segments.

        Args:
            observations: (S, L, O), before each step.
            actions: (S, L, A).
        """
        x = torch.cat([observations, actions], -1)
        values = []
        for gru, head in zip(self.grus, self.heads, strict=True):
            states = nn.functional.pad(gru(x)[0], (0, 0, 1, 0))  # (S, L+1, width)
            values.append(head(states).squeeze(-1))
        return torch.stack(values)


HISTORIES: dict[str, type[Singleton | Recurrent]] = {
    'singleton': Singleton,
    'recurrent': Recurrent,
}
"""Networks that value a history, by their name in `hc.history`."""
