"""How a segment's score arises from its step rewards: what a regression on scores must know.

The formulas: docs/methods.md#evidence.

A link states two things of a kind of score: the `level` of a score, which is the constant step
reward that would explain it, and F, the level of any step rewards. From the trial: sum,
square_sum, sum_square and the soft maximum with their levels, F and J = dF/dr, the floor of
sum_square's F. Decided here: mean, minimum (the soft maximum of what is negated), the other maxima
by the soft one (the hard one as a soft one whose beta is learnt from a large one, log-sum-exp with
its own level), and labels of sum_square by bisection.

Levels and step rewards are in units of the level scale throughout, except where a score is one.
Steps lie one after the other, segment by segment; `starts` has where each of S segments begins, m
(S,) how many steps it has.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import ClassVar

import numpy as np

from codetr_ros.records import F64, I64

FLOOR = 0.05
"""Least level by which sum_square's slopes are divided: F is not smooth at 0."""
HALVINGS = 60
"""Bisections by which the labels of sum_square are found: to the last bits of float64."""
FARTHEST = 3.0
"""Bound of log(beta / beta_0), whose prior is N(0, 1)."""


def signed_power(x: F64, exponent: float) -> F64:
    """sign(x) |x|^exponent."""
    return np.sign(x) * np.abs(x) ** exponent


class Link(ABC):
    """A kind of score."""

    name: ClassVar[str]
    linear: ClassVar[bool] = False
    """Whether F is linear in the step rewards."""

    @abstractmethod
    def level(self, scores: F64, m: I64) -> F64:
        """The constant step reward (S,) that would explain each score."""

    @abstractmethod
    def score(self, level: F64, m: I64) -> F64:
        """The score (S,) of segments of such levels: the inverse of `level`."""

    @abstractmethod
    def log_slope(self, scores: F64, m: I64) -> F64:
        """The log |d level / d score| (S,), by which evidences of different links compare."""

    @abstractmethod
    def forward(self, f: F64, starts: I64, m: I64) -> tuple[F64, F64]:
        """Levels F (S,) of step rewards f (N,), and J = dF/df (N,)."""

    def measure(self, scale: float) -> None:
        """Take the level scale in, once it is known: temperatures are in units of it from here
        on.
        """
        return

    def shift(self, f: F64, level: F64, starts: I64, m: I64) -> F64:
        """What is added (S,) to all steps of a segment so that they explain its level."""
        shift: F64 = level - self.forward(f, starts, m)[0]
        return shift


class Mean(Link):
    """The mean step reward."""

    name = 'mean'
    linear = True

    def level(self, scores: F64, m: I64) -> F64:
        """R."""
        return scores

    def score(self, level: F64, m: I64) -> F64:
        """The level."""
        return level

    def log_slope(self, scores: F64, m: I64) -> F64:
        """0."""
        return np.zeros(len(scores))

    def forward(self, f: F64, starts: I64, m: I64) -> tuple[F64, F64]:
        """The mean, and 1/m."""
        return np.add.reduceat(f, starts) / m, np.repeat(1 / m, m)


class Sum(Mean):
    """The sum S."""

    name = 'sum'

    def level(self, scores: F64, m: I64) -> F64:
        """R / m."""
        return scores / m

    def score(self, level: F64, m: I64) -> F64:
        """The level times m."""
        return level * m

    def log_slope(self, scores: F64, m: I64) -> F64:
        """-log m."""
        return -np.log(m)


class SquareSum(Mean):
    """|S| S: its signed root is a sum again."""

    name = 'square_sum'

    def level(self, scores: F64, m: I64) -> F64:
        """sign(R) sqrt(|R|) / m."""
        return signed_power(scores, 0.5) / m

    def score(self, level: F64, m: I64) -> F64:
        """|S| S of the sum S."""
        return signed_power(level * m, 2)

    def log_slope(self, scores: F64, m: I64) -> F64:
        """-log(2 m sqrt |R|)."""
        return -np.log(2 * m * np.sqrt(_floored(scores)))


class SumSquare(Link):
    """The sum of |r| r: its level is a signed root mean square."""

    name = 'sum_square'

    def level(self, scores: F64, m: I64) -> F64:
        """sign(R) sqrt(|R| / m)."""
        return signed_power(scores / m, 0.5)

    def score(self, level: F64, m: I64) -> F64:
        """The signed square times m."""
        return m * signed_power(level, 2)

    def log_slope(self, scores: F64, m: I64) -> F64:
        """-log(2 sqrt(m |R|))."""
        slopes: F64 = -np.log(2 * np.sqrt(m * _floored(scores)))
        return slopes

    def forward(self, f: F64, starts: I64, m: I64) -> tuple[F64, F64]:
        """The signed root of the mean of |f| f, and |f| / (m max(|F|, 0.05))."""
        level = signed_power(np.add.reduceat(np.abs(f) * f, starts) / m, 0.5)
        return level, np.abs(f) / np.repeat(m * np.maximum(np.abs(level), FLOOR), m)

    def shift(self, f: F64, level: F64, starts: I64, m: I64) -> F64:
        """The root of a function that only rises: between what lifts the largest and what lifts
        the smallest step to the level.
        """
        low = level - np.maximum.reduceat(f, starts)
        high = level - np.minimum.reduceat(f, starts)
        due = signed_power(level, 2)
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            shifted = f + np.repeat(middle, m)
            below = np.add.reduceat(np.abs(shifted) * shifted, starts) / m < due
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return (low + high) / 2


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
        return scores - np.log(m) / self._raw_beta

    def score(self, level: F64, m: I64) -> F64:
        """The level and log(m) / beta."""
        return level + np.log(m) / self._raw_beta

    def forward(self, f: F64, starts: I64, m: I64) -> tuple[F64, F64]:
        """log(mean of exp(beta f)) / beta, and softmax(beta f)."""
        largest = np.maximum.reduceat(f, starts)
        raised = np.exp(self.beta * (f - np.repeat(largest, m)))
        total = np.add.reduceat(raised, starts)
        return largest + np.log(total / m) / self.beta, raised / np.repeat(total, m)


HARD = 10.0
"""Inverse temperature from which that of a hard maximum is learnt."""
_MAKE: dict[str, Callable[[float, int], Link]] = {
    'sum': lambda beta, delay: Sum(),
    'mean': lambda beta, delay: Mean(),
    'square_sum': lambda beta, delay: SquareSum(),
    'sum_square': lambda beta, delay: SumSquare(),
    'max': lambda beta, delay: SoftMax(beta),
    'minimum': lambda beta, delay: Minimum(beta),
    'max_times_n': MaxTimesN,
    'max_log_sum_exp': lambda beta, delay: MaxLogSumExp(beta),
    'max_hard': lambda beta, delay: MaxHard(HARD, learnt=True),
}
NAMES = tuple(_MAKE)
"""Links by name: those of the composite rewards, the mean and the minimum."""


def make(name: str, beta: float, delay: int) -> Link:
    """A link by its name.

    Args:
        name: one of `NAMES`.
        beta: the inverse temperature that scores are made with, in the task's unit.
        delay: n, the steps of a whole segment.
    """
    return _MAKE[name](beta, delay)


def level_scale(levels: F64) -> float:
    """Root mean square of levels; 1 where that is 0."""
    scale = math.sqrt(float(np.mean(levels * levels)))
    return scale if scale > 0 else 1.0


def _floored(scores: F64) -> F64:
    return np.maximum(np.abs(scores), 1e-3 * math.sqrt(float(np.mean(scores * scores))) + 1e-12)
