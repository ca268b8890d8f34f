"""The posterior of the weights w of f(x) = sum_b phi_b(x) . w_b, given scores and scales.

The formulas: docs/methods.md#evidence.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from codetr_ros.records import F64
from codetr_ros.rewards.evidence.scales import JITTER, Linear, cholesky


@dataclass(frozen=True)
class Posterior:
    """Normal distribution of the weights, in units of the level scale."""

    mean: Tensor  # (D,)
    covariance: Tensor  # (D, D)

    def variances(self, rows: Tensor) -> Tensor:
        """Of rows . w, for rows (N, D) of float64."""
        return ((rows @ self.covariance) * rows).sum(1).clamp_min_(0)


def prior_variances(theta: F64, blocks: Sequence[slice]) -> Tensor:
    """Of each weight (D,)."""
    sizes = [b.stop - b.start for b in blocks]
    return torch.tensor(np.repeat(np.exp(theta[:-2]), sizes))


def noise(theta: F64, data: Linear) -> Tensor:
    """Variance (S,) of each score's level given the weights: v_r sum J_t^2 + v_0 + 1e-8, and what
    the score has besides.
    """
    own = float(np.exp(theta[-2])) * data.spread + float(np.exp(theta[-1])) + JITTER
    return own + data.noise


def posterior(data: Linear, theta: F64, blocks: Sequence[slice], spread: bool = True) -> Posterior:
    """Bayesian linear regression, in the space of scores or of weights, whichever is smaller.

    A weight of `data.known`, if there is one, is the last of D + 1. Without `spread` the
    covariance is left at 0, which takes half of the time.

        scores:  K = P Lam P' + N,  mean = Lam P' K^-1 z,  covariance = Lam - Lam P' K^-1 P Lam
        weights: A = I + B' B, B = N^-1/2 P Lam^1/2,  covariance = Lam^1/2 A^-1 Lam^1/2
    """
    rows, variances = data.rows, prior_variances(theta, blocks)
    if data.known is not None:
        rows = torch.cat([rows, data.known[:, None]], 1)
        variances = torch.cat([variances, torch.ones(1, dtype=torch.float64)])
    noises = noise(theta, data)
    root = variances.sqrt()
    half = rows * root  # P Lam^1/2
    if len(rows) <= rows.shape[1]:
        kernel = half @ half.T
        kernel.diagonal().add_(noises)
        factor = cholesky(kernel)
        solved = torch.cholesky_solve(data.targets[:, None], factor)[:, 0]
        mean = root * (half.T @ solved)
        if not spread:
            return Posterior(mean, torch.zeros(len(root), len(root), dtype=torch.float64))
        part = torch.linalg.solve_triangular(factor, half, upper=False)  # L^-1 P Lam^1/2
        inner = -(part.T @ part)
        inner.diagonal().add_(1)
    else:
        weighted = half / noises.sqrt()[:, None]
        inner = weighted.T @ weighted
        inner.diagonal().add_(1)
        factor = cholesky(inner)
        targets = weighted.T @ (data.targets / noises.sqrt())
        mean = root * torch.cholesky_solve(targets[:, None], factor)[:, 0]
        if not spread:
            return Posterior(mean, torch.zeros(len(root), len(root), dtype=torch.float64))
        inner = torch.cholesky_inverse(factor)
    return Posterior(mean, root[:, None] * inner * root)


def from_others(data: Linear, theta: F64, fitted: Posterior, least: float) -> tuple[F64, F64]:
    """Mean and variance (S,) of each target, as predicted from all others, without its own noise.

    Args:
        data: the regression.
        theta: its scales.
        fitted: its posterior.
        least: bound of 1 - leverage.
    """
    noises = noise(theta, data)
    variances = fitted.variances(data.rows)
    left = (1 - variances / noises).clamp_min_(least)
    off = data.targets - data.rows @ fitted.mean
    mean: F64 = (data.targets - off / left).numpy()
    return mean, (variances / left + noises - data.noise).numpy()
