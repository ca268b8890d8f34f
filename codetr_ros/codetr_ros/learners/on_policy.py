"""Tools of a learner from its own latest steps: running moments, advantages, an Adam with a
gradient.

Shapes: T = steps of a phase, B = steps of a minibatch.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from codetr_ros.memory.ring import Rollout
from codetr_ros.records import F32, F64, I64


class RunningMoments:
    """Mean and standard deviation of all rows added so far, component by component."""

    def __init__(self, size: int) -> None:
        self.tensors = {
            'count': torch.zeros((), dtype=torch.float64),
            'mean': torch.zeros(size, dtype=torch.float64),
            'squares': torch.zeros(size, dtype=torch.float64),  # of the deviations from the mean
        }

    def add(self, values: F32 | F64) -> None:
        """Add rows (T, size), by the parallel form of Welford's algorithm."""
        rows = torch.as_tensor(values, dtype=torch.float64)
        count, mean, squares = self.tensors.values()
        total = count + len(rows)
        delta = rows.mean(0) - mean
        squares += (rows - rows.mean(0)).square().sum(0) + delta.square() * count * (
            len(rows) / total
        )
        mean += delta * (len(rows) / total)
        count += len(rows)

    @property
    def mean(self) -> Tensor:
        """(size,) in float64."""
        return self.tensors['mean']

    @property
    def deviation(self) -> Tensor:
        """(size,) in float64, never 0."""
        variance = self.tensors['squares'] / self.tensors['count'].clamp(min=1)
        return (variance + 1e-8).sqrt()


def discounted_returns(rollout: Rollout, discount: float) -> F64:
    """(T,): the rewards up to each step of its episode, past ones discounted."""
    returns = np.zeros(len(rollout.rewards))
    running = 0.0
    for t, reward in enumerate(rollout.rewards):
        running = running * discount + reward
        returns[t] = running
        if rollout.last[t]:
            running = 0.0
    return returns


def ends(last: NDArray[np.bool_]) -> I64:
    """(T,): the index of the last step of each step's stretch of consecutive steps."""
    where = np.flatnonzero(last)
    indices: I64 = where[np.searchsorted(where, np.arange(len(last)))]
    return indices


def trace(indices: Tensor, stretch_ends: Tensor, decay: float) -> Tensor:
    """Weights (B, T) of generalised advantage estimation (Schulman et al., arXiv 1506.02438).

    Row i has decay^(j - i) at each step j from i to the end of its stretch, 0 elsewhere: times
    the temporal differences (T,) it gives the advantages (B,).

    Args:
        indices: (B,) steps.
        stretch_ends: (T,) as `ends` gives them.
        decay: gamma lambda.
    """
    step = torch.arange(len(stretch_ends))
    ahead = step - indices[:, None]
    inside = (ahead >= 0) & (step <= stretch_ends[indices][:, None])
    return torch.where(inside, decay ** ahead.clamp(min=0), 0.0)


def normalised(advantages: Tensor) -> Tensor:
    """Advantages (B,) of mean 0 and standard deviation 1; all 0 where they are all the same."""
    centred = advantages - advantages.mean()
    return centred / (_root(centred.square().mean()) + 1e-8)


def clipped(gradients: Sequence[Tensor], norm: float) -> list[Tensor]:
    """Gradients whose norm, all together, is at most `norm`."""
    total = _root(torch.stack([gradient.square().sum() for gradient in gradients]).sum())
    factor = norm / torch.clamp(total, min=norm)
    return [gradient * factor for gradient in gradients]


def _root(square: Tensor) -> Tensor:
    """The square root of a scalar, with a derivative of 0 at 0 in place of an infinite one."""
    return square.clamp(min=torch.finfo(square.dtype).tiny).sqrt()


@dataclass(frozen=True, eq=False, slots=True)
class Step:
    """The result of a step of Adam."""

    values: list[Tensor]
    means: list[Tensor]
    squares: list[Tensor]


class DifferentiableAdam:
    """Adam by hand, so that a step can be differentiated by what its gradients depend on.

    The second moment takes the gradient as a constant; the derivative goes through the first one.

    Args:
        parameters: the tensors that it updates.
        learning_rate: its step size.
        epsilon: added to the root of the second moment.
    """

    def __init__(self, parameters: Sequence[Tensor], learning_rate: float, epsilon: float) -> None:
        self.parameters = list(parameters)
        self.learning_rate, self.epsilon = learning_rate, epsilon
        self.means = [torch.zeros_like(p, requires_grad=False) for p in self.parameters]
        self.squares = [torch.zeros_like(p, requires_grad=False) for p in self.parameters]
        self.steps = torch.zeros((), dtype=torch.float64)

    def propose(self, gradients: Sequence[Tensor]) -> Step:
        """The result of a step, as a function of the gradients; nothing changes yet."""
        n = float(self.steps) + 1
        means = [0.9 * m + 0.1 * g for m, g in zip(self.means, gradients, strict=True)]
        squares = [
            0.999 * v + 0.001 * g.detach().square()
            for v, g in zip(self.squares, gradients, strict=True)
        ]
        rate = self.learning_rate / (1 - 0.9**n)
        values = [
            p.detach() - rate * m / ((v / (1 - 0.999**n)).sqrt() + self.epsilon)
            for p, m, v in zip(self.parameters, means, squares, strict=True)
        ]
        return Step(values, means, squares)

    @torch.no_grad()
    def accept(self, step: Step) -> None:
        """Take a proposed step."""
        torch._foreach_copy_(self.parameters, step.values)
        torch._foreach_copy_(self.means, step.means)
        torch._foreach_copy_(self.squares, step.squares)
        self.steps += 1

    def state(self) -> dict[str, Tensor]:
        """Moments and step count: the tensors themselves, not copies."""
        named = {'steps': self.steps}
        for name in ('means', 'squares'):
            named |= {f'{name}.{i}': tensor for i, tensor in enumerate(getattr(self, name))}
        return named
