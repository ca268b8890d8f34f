"""How much each block of features is worth, and how much noise there is: by the evidence.

The formulas: docs/methods.md#evidence.

The evidence is the marginal likelihood of the scores' levels, the weights integrated out. Its
maximum under a wide prior gives the scales (MacKay, 1992). From the trial: the prior's width and
noise, bounds, numbers of iterations and of scores. Decided here: where the blocks' prior is.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from codetr_ros.records import F64

JITTER = 1e-8
"""Variance added to that of each score, in units of the squared level scale."""
TRIES = 6
"""Times that a matrix is lifted by ten times more until it has a Cholesky factor."""
BOUNDS = (-16.0, 12.0)
"""Of the logarithms of all scales."""
NOISE = (math.log(0.1), math.log(1e-3))
"""Where the prior of log v_r and log v_0 is centred."""
BLOCK = -3.0
"""Where the prior of log lam_b is centred, but for the constant's, which is at 0.

In the trial all were at 0. Blocks that scores hardly bear upon then stay as wide as that: on 64
scores that had nothing to do with the steps, labels were off the even spread by .82 of its own
size, and with -3 by .15, at no loss elsewhere.
"""
PRIOR_VARIANCE = 9.0
"""Of each logarithm."""


def centre(blocks: int) -> F64:
    """The prior's mean of all logarithms of scales: of the blocks, of v_r and of v_0."""
    return np.concatenate([[0.0], np.full(blocks - 1, BLOCK), NOISE])


def first(blocks: int) -> F64:
    """Where the search begins: the constant's scale a little larger than the others."""
    theta = centre(blocks)
    theta[0] = 1.0
    return theta


def cholesky(matrix: Tensor) -> Tensor:
    """The lower Cholesky factor of a symmetric, positive matrix.

    Where rounding has made it indefinite, its diagonal is lifted by 1e-12 of its mean, then by
    ten times more, `TRIES` times at the most.

    Raises:
        FloatingPointError: that was not enough, or a value is not finite.
    """
    factor, info = torch.linalg.cholesky_ex(matrix)
    lift = 1e-12 * float(matrix.diagonal().mean())
    for _ in range(TRIES):
        if not int(info):
            break
        lifted = matrix.clone()
        lifted.diagonal().add_(lift)
        factor, info = torch.linalg.cholesky_ex(lifted)
        lift *= 10
    if int(info) or not bool(torch.isfinite(factor.diagonal()).all()):
        raise FloatingPointError(
            f'a matrix of {len(matrix)} rows, diagonal {float(matrix.diagonal().min()):g} to '
            f'{float(matrix.diagonal().max()):g}, has no Cholesky factor'
        )
    lower: Tensor = factor
    return lower


@dataclass(frozen=True)
class Linear:
    """Scores that depend linearly on weights: z = P w + noise; S of them, D weights."""

    rows: Tensor  # (S, D) float64: P
    spread: Tensor  # (S,) sum of J_t^2: by it the noise of steps enters
    targets: Tensor  # (S,) z, in units of the level scale
    known: Tensor | None = None  # (S,) a further row entry, whose weight has prior variance 1
    noise: Tensor | float = 0.0  # (S,) variance that each score has besides

    def part(self, places: Tensor) -> 'Linear':
        """Some of the scores."""
        known = None if self.known is None else self.known[places]
        noise = self.noise[places] if isinstance(self.noise, Tensor) else self.noise
        return Linear(self.rows[places], self.spread[places], self.targets[places], known, noise)


class Evidence:
    """The negative logarithm of evidence and prior of scales theta, and its gradient.

        K = sum_b lam_b P_b P_b' + diag(v_r sum J_t^2 + v_0 + 1e-8)
        0.5 z' K^-1 z + 0.5 log |K| + sum (theta - theta_0)^2 / 18

    The constant 0.5 S log 2 pi is left out, as it is the same for all.

    Args:
        data: the scores.
        blocks: of features.
    """

    def __init__(self, data: Linear, blocks: Sequence[slice]) -> None:
        self._spread, self._targets = data.spread, data.targets
        wide = [b for b in blocks if b.stop - b.start > 1]
        self._is_single = np.array([b.stop - b.start == 1 for b in blocks])
        self._single = data.rows[:, [b.start for b in blocks if b.stop - b.start == 1]]
        kernels = [(data.rows[:, b] @ data.rows[:, b].T).reshape(-1) for b in wide]
        self._kernels = (
            torch.stack(kernels)
            if wide
            else torch.zeros(0, len(data.rows) ** 2, dtype=torch.float64)
        )
        self._noise = data.noise + JITTER
        self._fixed = None if data.known is None else torch.outer(data.known, data.known)
        self._centre = centre(len(blocks))

    def _factor(self, theta: F64) -> Tensor:
        size = len(self._targets)
        scales = np.exp(theta)
        narrow = self._single * torch.tensor(scales[:-2][self._is_single])
        kernel = torch.tensor(scales[:-2][~self._is_single]) @ self._kernels
        kernel = kernel.view(size, size) + narrow @ self._single.T
        if self._fixed is not None:
            kernel = kernel + self._fixed
        kernel.diagonal().add_(float(scales[-2]) * self._spread + float(scales[-1]) + self._noise)
        return cholesky(kernel)

    def __call__(self, theta: F64) -> tuple[float, F64]:
        """The value, and its gradient (B + 2,) with respect to theta."""
        factor = self._factor(theta)
        inverse = torch.cholesky_inverse(factor)
        explained = inverse @ self._targets
        inner = inverse - torch.outer(explained, explained)
        scales = np.exp(theta)
        off = theta - self._centre
        value = 0.5 * float(self._targets @ explained) + float(factor.diagonal().log().sum())
        slope = np.empty(len(theta))
        slope[:-2][self._is_single] = (self._single * (inner @ self._single)).sum(0).numpy()
        slope[:-2][~self._is_single] = (self._kernels @ inner.reshape(-1)).numpy()
        slope[-2:] = float(inner.diagonal() @ self._spread), float(inner.diagonal().sum())
        gradient: F64 = 0.5 * scales * slope + off / PRIOR_VARIANCE
        return value + float(off @ off) / (2 * PRIOR_VARIANCE), gradient

    def left_out(self, theta: F64) -> Tensor:
        """Residuals (S,) of each score as predicted from all others."""
        inverse = torch.cholesky_inverse(self._factor(theta))
        return (inverse @ self._targets) / inverse.diagonal()


def learn(evidence: Evidence, theta: F64, iterations: int) -> tuple[F64, float]:
    """Scales of more evidence than those given.

    Where neither OMP_NUM_THREADS nor OPENBLAS_NUM_THREADS is set, scipy's own threads wait in a
    loop meanwhile: it takes twice the processor time, and gives the same bits.

    Args:
        evidence: to be made large.
        theta: where to begin.
        iterations: of L-BFGS-B at the most (Byrd et al., 1995).

    Returns:
        The scales' logarithms, and the logarithm of their evidence and prior.
    """
    from scipy.optimize import minimize  # takes a second to import

    best = minimize(
        evidence,
        theta,
        jac=True,
        method='L-BFGS-B',
        bounds=[BOUNDS] * len(theta),
        options={'maxiter': iterations},
    )
    return np.asarray(best.x, np.float64), -float(best.fun)
