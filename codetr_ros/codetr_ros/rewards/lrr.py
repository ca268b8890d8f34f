"""LRR: likelihood reward redistribution, whose step rewards are Gaussian numbers.

Xiao and Yu, AAAI 2026 (arXiv 2503.17409). A step's reward has a mean mu, a network of the step.
The score R of a segment makes a target of each of its steps, R less the means of all others, and
the likelihood of these targets under the Gaussian is maximised:

    rtilde_t = R - sum_{j != t} mu_j        loss: -log N(rtilde; mu, K)

`lrr.correlation` chooses K between the two versions of the paper:

    kernel    a Gaussian process over the steps: k(x_t, x_j), and noise on the diagonal (GP-LRR,
              the published version, and its code)
    none      independent steps, whose deviations are a second output of the network (the first
              version, Xiao and Jiao 2025)

A segment's residuals rtilde_t - mu_t are all the same number e = R - sum_t mu_t, so that the loss
is e^2 1'K^-1 1 / 2 + log |K| / 2 + a constant: the error of the sum, with a weight for each
segment. K thus decides how much a segment counts, and never which of its steps does. Nor do the
scores say much about K: once the signal is as large as e, longer length scales and less noise are
always likelier, since the residual lies in the direction of 1, and only the floor of the variance
ends that.

The targets move with the means, as in the published code. The gradient that the paper derives (its
Proposition 2) holds them still, so that step t is pulled by e (K^-1 1)_t. It is the gradient of no
loss. With it training diverged under every kernel, on linear rewards that are found otherwise.

What was at hand: the second version's abstract and its published code, a reader's summary of it,
and the first version's abstract. That the first version's targets are made of means too, not of
draws, is inferred from its special case, the squared error of the sum.

Differences from the published code:

* Its batch is 4 whole episodes. Here segments take the place of episodes, 64 of them, as for
  CoDeTr.
* Ten gradient steps follow each episode there; here ten follow each phase, and 100 the warm-up.
* Its function for the kernel computes the rational quadratic, and the paper's default is the
  Gaussian one (rbf), which is ours. Its distances are those of raw states and actions; here
  observations are standardised and cut off at 10 deviations.
* R is in units of the target scale c; there it is not scaled.
* Where the covariance has no Cholesky factor, that code adds a constant to the loss. Here the
  kernel is computed in float64, and the gradient step is refused.
* Xavier weights, as for all perceptrons here; there those of torch.

The formula beside its symbols: docs/methods.md#lrr.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor, nn

from codetr_ros.config import LrrSettings, Settings
from codetr_ros.memory.batches import SegmentBatch
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.rewards.base import segment_steps
from codetr_ros.rewards.learned import CLIP, Learned
from codetr_ros.rewards.mlp import perceptron

FLOOR = 1e-4
"""The variance that each step has in addition: the published code's, for its Cholesky factors."""
ENTRIES = 1 << 20
"""The most entries of covariances that are in memory at once (8 MB), if one segment has fewer."""

Kernel = Callable[[Tensor, Tensor], Tensor]
"""Correlations of distances in units of the length scale, and of the parameter alpha."""

KERNELS: dict[str, Kernel] = {
    'rbf': lambda distance, _: torch.exp(-(distance**2) / 2),
    'matern': lambda distance, _: (
        (1 + math.sqrt(3) * distance) * torch.exp(-math.sqrt(3) * distance)
    ),
    'rational_quadratic': lambda distance, alpha: (1 + distance**2 / (2 * alpha)) ** -alpha,
}
"""Kernels of variance 1 by their name in `lrr.kernel`; matern is that of smoothness 3/2."""


class Lrr(Learned):
    """Learns the means mu(s_t, a_t) by the likelihood of R less the other means; labels with mu.

    Its `reward_loss` is the negative logarithm of a density: it may be negative.

    Args:
        settings: the run's settings; the initial weights depend on its seed.
        observation_size: O.
        action_size: A.
    """

    name: ClassVar[str] = 'lrr'
    group: ClassVar[str] = 'lrr'
    clip: ClassVar[float] = CLIP
    network: 'GaussianRewards'

    def __init__(self, settings: Settings, observation_size: int, action_size: int) -> None:
        self._lrr = settings.lrr
        super().__init__(settings, observation_size, action_size)
        self.gradient_norm = self._lrr.gradient_norm

    def _make_network(self, observation_size: int, action_size: int) -> 'GaussianRewards':
        return GaussianRewards(observation_size + action_size, self._lrr)

    def _terms(
        self, memory: Trajectories, rng: np.random.Generator
    ) -> Iterator[dict[str, Tensor]]:
        batch = memory.segments.sample(rng, self._lrr.batch)
        for part in self._parts(batch):
            yield {'reward_loss': self._losses(part).sum() / len(batch.values)}

    def _losses(self, batch: SegmentBatch) -> Tensor:
        """The negative log likelihood (B,) of each segment's targets, in float64."""
        inside = self._put(segment_steps(batch))  # (B, L)
        inputs = self._step_inputs(batch)  # (B, L, D)
        outputs = self.network(inputs).double()  # (B, L, 1 or 2)
        returns = self._scaled(batch.values).double()
        residual = residuals(outputs[..., 0], returns, inside)
        if self._lrr.correlation == 'none':
            variance = torch.exp(2 * outputs[..., 1]) + FLOOR
            return independent_loss(residual, variance, inside)
        return correlated_loss(residual, self.network.covariance(inputs), inside)

    def _step_rewards(self, batch: SegmentBatch) -> Tensor:
        means: Tensor = self.network(self._step_inputs(batch))[..., 0]  # (B, L)
        return means

    def _parts(self, batch: SegmentBatch) -> Sequence[SegmentBatch]:
        """The batch in parts with at most `ENTRIES` pairs of steps, one segment at the least."""
        windows, steps = batch.actions.shape[:2]
        size = max(1, ENTRIES // steps**2)
        return [batch.part(slice(i, i + size)) for i in range(0, windows, size)]


class GaussianRewards(nn.Module):
    """Means of step rewards, and what their covariance is made of.

    Args:
        inputs: D, numbers that describe a step.
        settings: kernel and widths.
    """

    def __init__(self, inputs: int, settings: LrrSettings) -> None:
        super().__init__()
        if settings.correlation == 'kernel':
            self._kernel = KERNELS[settings.kernel]
            self.log_signal = nn.Parameter(torch.tensor(math.log(settings.signal)))
            self.log_length = nn.Parameter(torch.tensor(math.log(settings.length_scale)))
            self.log_noise = nn.Parameter(torch.tensor(math.log(settings.noise)))
            self.log_alpha = nn.Parameter(torch.tensor(0.0))  # moves with rational_quadratic only
        self.outputs = perceptron(inputs, settings.hidden, 2 - (settings.correlation == 'kernel'))

    def forward(self, inputs: Tensor) -> Tensor:
        """Means and, for independent steps, logarithms of deviations: (B, L, 1 or 2)."""
        outputs: Tensor = self.outputs(inputs)
        return outputs

    def covariance(self, inputs: Tensor) -> Tensor:
        """K (B, L, L) of the steps (B, L, D), noise and floor included, in float64."""
        signal, length, noise, alpha = (
            log.double().exp()
            for log in (self.log_signal, self.log_length, self.log_noise, self.log_alpha)
        )
        inputs = inputs.double()
        correlation = self._kernel(torch.cdist(inputs, inputs) / length, alpha)
        diagonal = (noise**2 + FLOOR) * torch.eye(
            inputs.shape[1], dtype=torch.float64, device=inputs.device
        )
        return signal**2 * correlation + diagonal


def residuals(means: Tensor, returns: Tensor, inside: Tensor) -> Tensor:
    """What a target differs from the mean by: (B, L), 0 outside of the segments.

    Args:
        means: mu (B, L).
        returns: R (B,).
        inside: which steps (B, L) are the segments' own.
    """
    others = (means * inside).sum(1, keepdim=True) - means
    targets = returns[:, None] - others
    return (targets - means) * inside


def correlated_loss(residual: Tensor, covariance: Tensor, inside: Tensor) -> Tensor:
    """-log N(residual; 0, K) (B,) over the steps inside; NaN where K has no Cholesky factor."""
    outside = torch.diag_embed((~inside).to(covariance.dtype))
    covariance = covariance * (inside[:, :, None] & inside[:, None, :]) + outside
    factor, failed = torch.linalg.cholesky_ex(covariance)
    whitened = torch.linalg.solve_triangular(factor, residual[..., None], upper=False)[..., 0]
    fit = (whitened**2).sum(1) / 2
    volume = factor.diagonal(dim1=1, dim2=2).log().sum(1)
    loss = fit + volume + inside.sum(1) * math.log(2 * math.pi) / 2
    return torch.where(failed > 0, math.nan, loss)


def independent_loss(residual: Tensor, variance: Tensor, inside: Tensor) -> Tensor:
    """The same (B,) of steps (B, L) that are independent."""
    each = residual**2 / variance + variance.log() + math.log(2 * math.pi)
    return (each * inside).sum(1) / 2
