"""Links of scores that single steps decide: maxima, and the minimum.

The formulas: docs/methods.md#evidence. From the trial: the soft maximum and how its beta is
learnt. Decided here: the others as the soft one. The hard maximum is learnt as a soft one of large
beta and explained to the letter, log-sum-exp has its own level and F, the minimum is the maximum
of what is negated, and the peak of peak and end is treated as the hard maximum.
"""

import math
from typing import ClassVar

import numpy as np

from codetr_ros.records import F64, I64
from codetr_ros.rewards.evidence.link import Link

FARTHEST = 3.0
"""Bound of log(beta / beta_0), whose prior is N(0, 1)."""


class SoftMax(Link):
    """sum_t w_t r_t with weights w = softmax(beta r): between mean and maximum.

    Args:
        beta: the inverse temperature: in the task's unit where it is known, in units of one by
            the level scale where it is learnt.
        learnt: log(beta / `beta`) is a weight of the regression, of prior N(0, 1).
    """

    name = 'max'
    sign: ClassVar[float] = 1.0
    """-1 for a minimum: the negated maximum of the negated step rewards."""

    def __init__(self, beta: float, learnt: bool = False) -> None:
        self.first = beta
        self.learnt = learnt
        self.log_ratio = 0.0
        """log(beta / first), as learnt so far."""
        self.heat = 1.0
        """Below 1 while a first fit is annealed."""

    def measure(self, scale: float) -> None:
        """A beta that is known is in units of one by the level scale from here on."""
        if not self.learnt:
            self.first *= scale

    @property
    def beta(self) -> float:
        """The inverse temperature."""
        return self.first * math.exp(self.log_ratio) * self.heat

    def move(self, log_ratio: float) -> None:
        """Set log(beta / first), within bounds."""
        self.log_ratio = min(max(log_ratio, -FARTHEST), FARTHEST)

    def level(self, scores: F64, m: I64) -> F64:
        """R."""
        return scores

    def score(self, level: F64, m: I64) -> F64:
        """The level."""
        return level

    def log_slope(self, scores: F64, m: I64) -> F64:
        """0."""
        return np.zeros(len(scores))

    def _weights(self, f: F64, starts: I64, m: I64) -> F64:
        up = self.sign * f
        raised = np.exp(self.beta * (up - np.repeat(np.maximum.reduceat(up, starts), m)))
        weights: F64 = raised / np.repeat(np.add.reduceat(raised, starts), m)
        return weights

    def forward(self, f: F64, starts: I64, m: I64) -> tuple[F64, F64]:
        """The sum of w f, and w (1 + beta (f - F)), which sums to 1 over a segment."""
        weights = self._weights(f, starts, m)
        level = np.add.reduceat(weights * f, starts)
        return level, weights * (1 + self.sign * self.beta * (f - np.repeat(level, m)))

    def beta_slope(self, f: F64, starts: I64, m: I64) -> F64:
        """The slopes dF / d log beta (S,): beta times the variance of f under the weights."""
        weights = self._weights(f, starts, m)
        off = f - np.repeat(np.add.reduceat(weights * f, starts), m)
        return self.sign * self.beta * np.add.reduceat(weights * off**2, starts)


class Minimum(SoftMax):
    """The soft minimum: of the steps, the worst counts most."""

    name = 'minimum'
    sign = -1.0


class MaxTimesN(SoftMax):
    """The soft maximum times the n steps of a whole segment.

    Args:
        beta: as for `SoftMax`.
        delay: n.
        learnt: as for `SoftMax`.
    """

    name = 'max_times_n'

    def __init__(self, beta: float, delay: int, learnt: bool = False) -> None:
        super().__init__(beta, learnt)
        self._delay = delay

    def level(self, scores: F64, m: I64) -> F64:
        """R / n."""
        return scores / self._delay

    def score(self, level: F64, m: I64) -> F64:
        """The level times n."""
        return level * self._delay

    def log_slope(self, scores: F64, m: I64) -> F64:
        """-log n."""
        return np.full(len(scores), -math.log(self._delay))


class MaxHard(SoftMax):
    """The largest step reward: learnt as a soft maximum, explained to the letter."""

    name = 'max_hard'

    def shift(self, f: F64, level: F64, starts: I64, m: I64) -> F64:
        """What lifts the largest step to the level."""
        return level - np.maximum.reduceat(f, starts)


class PeakEnd(SoftMax):
    """The mean of the largest and the last step reward: the largest is learnt as a soft maximum,
    explained to the letter.
    """

    name = 'peak_end'

    def forward(self, f: F64, starts: I64, m: I64) -> tuple[F64, F64]:
        """The mean of the soft maximum and of the last f, and half of either's slopes."""
        level, slopes = super().forward(f, starts, m)
        ends = starts + m - 1
        slopes[ends] += 1
        return (level + f[ends]) / 2, slopes / 2

    def beta_slope(self, f: F64, starts: I64, m: I64) -> F64:
        """Half of that of the soft maximum."""
        return super().beta_slope(f, starts, m) / 2

    def shift(self, f: F64, level: F64, starts: I64, m: I64) -> F64:
        """What lifts the mean of the largest and the last step to the level."""
        found: F64 = level - (np.maximum.reduceat(f, starts) + f[starts + m - 1]) / 2
        return found


class MaxLogSumExp(SoftMax):
    """log(sum of exp(beta r)) / beta, whose level is less by log(m) / beta.

    Args:
        beta: the inverse temperature in the task's unit.
    """

    name = 'max_log_sum_exp'

    def __init__(self, beta: float) -> None:
        super().__init__(beta)
        self._raw_beta = beta

    def level(self, scores: F64, m: I64) -> F64:
        """R - log(m) / beta."""
        return scores - np.log(self._steps(m)) / self._raw_beta

    def score(self, level: F64, m: I64) -> F64:
        """The level and log(m) / beta."""
        return level + np.log(self._steps(m)) / self._raw_beta

    def forward(self, f: F64, starts: I64, m: I64) -> tuple[F64, F64]:
        """log(mean of exp(beta f)) / beta, and softmax(beta f)."""
        largest = np.maximum.reduceat(f, starts)
        raised = np.exp(self.beta * (f - np.repeat(largest, m)))
        total = np.add.reduceat(raised, starts)
        return largest + np.log(total / self._steps(m)) / self.beta, raised / np.repeat(total, m)
