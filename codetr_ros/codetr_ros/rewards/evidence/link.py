"""How a segment's score arises from its step rewards: what a regression on scores must know.

The formulas: docs/methods.md#evidence.

A link states two things of a kind of score: the `level` of a score, which is the constant step
reward that would explain it, and F, the level of any step rewards. Levels and step rewards are in
units of the level scale throughout, except where a score is one. Steps lie one after the other,
segment by segment; `starts` has where each of S segments begins, m (S,) how many steps it has.

Where only the order of scores means anything, a short segment is judged as it is: the one of a
robot that fell at once is poor, however good its few steps were on average. A sum is then
compared with that of a whole segment, and its level is the sum divided by n, not by m. Where all
segments are whole, that is the same.

From the trial: levels, F and J = dF/dr of sum, square_sum and sum_square, and the floor of the
last one's F. Decided here: the mean, labels of sum_square by bisection, and levels of verdicts.
"""

import math
from abc import ABC, abstractmethod
from typing import ClassVar

import numpy as np

from codetr_ros.records import F64, I64

FLOOR = 0.05
"""Least level by which sum_square's slopes are divided: F is not smooth at 0."""
HALVINGS = 60
"""Bisections by which the labels of sum_square are found: to the last bits of float64."""


def signed_power(x: F64, exponent: float) -> F64:
    """sign(x) |x|^exponent."""
    return np.sign(x) * np.abs(x) ** exponent


class Link(ABC):
    """A kind of score."""

    name: ClassVar[str]
    linear: ClassVar[bool] = False
    """Whether F is linear in the step rewards."""
    whole: int = 1
    """n, the steps of a whole segment."""
    ordinal: bool = False
    """Only the order of scores means anything."""

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

    def shares(self, m: I64) -> F64:
        """How much (S,) of the mean step reward is in what segments are compared by."""
        return np.ones(len(m))

    def _steps(self, m: I64) -> I64:
        """The steps (S,) by which segments are compared: m, or n where only their order counts."""
        return np.full_like(m, self.whole) if self.ordinal else m

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


class Total(Mean):
    """A score that grows with the steps. In the docstrings of its kinds, m stands for `_steps`."""

    def shares(self, m: I64) -> F64:
        """The share m / n."""
        shares: F64 = m / self.whole
        return shares

    def forward(self, f: F64, starts: I64, m: I64) -> tuple[F64, F64]:
        """The sum / m, and 1/m."""
        steps = self._steps(m)
        return np.add.reduceat(f, starts) / steps, np.repeat(1 / steps, m)

    def shift(self, f: F64, level: F64, starts: I64, m: I64) -> F64:
        """What is added (S,) to all steps of a segment so that they explain its level."""
        shift: F64 = super().shift(f, level, starts, m) * (self._steps(m) / m)
        return shift


class Sum(Total):
    """The sum S."""

    name = 'sum'

    def level(self, scores: F64, m: I64) -> F64:
        """R / m."""
        return scores / self._steps(m)

    def score(self, level: F64, m: I64) -> F64:
        """The level times m."""
        return level * self._steps(m)

    def log_slope(self, scores: F64, m: I64) -> F64:
        """-log m."""
        return -np.log(self._steps(m))


class SquareSum(Total):
    """|S| S: its signed root is a sum again."""

    name = 'square_sum'

    def level(self, scores: F64, m: I64) -> F64:
        """sign(R) sqrt(|R|) / m."""
        return signed_power(scores, 0.5) / self._steps(m)

    def score(self, level: F64, m: I64) -> F64:
        """|S| S of the sum S."""
        return signed_power(level * self._steps(m), 2)

    def log_slope(self, scores: F64, m: I64) -> F64:
        """-log(2 m sqrt |R|)."""
        return -np.log(2 * self._steps(m) * np.sqrt(_floored(scores)))


class SumSquare(Total):
    """The sum of |r| r: its level is a signed root mean square."""

    name = 'sum_square'
    linear = False

    def level(self, scores: F64, m: I64) -> F64:
        """sign(R) sqrt(|R| / m)."""
        return signed_power(scores / self._steps(m), 0.5)

    def score(self, level: F64, m: I64) -> F64:
        """The signed square times m."""
        return self._steps(m) * signed_power(level, 2)

    def log_slope(self, scores: F64, m: I64) -> F64:
        """-log(2 sqrt(m |R|))."""
        slopes: F64 = -np.log(2 * np.sqrt(self._steps(m) * _floored(scores)))
        return slopes

    def forward(self, f: F64, starts: I64, m: I64) -> tuple[F64, F64]:
        """The signed root of the mean of |f| f, and |f| / (m max(|F|, 0.05))."""
        steps = self._steps(m)
        level = signed_power(np.add.reduceat(np.abs(f) * f, starts) / steps, 0.5)
        return level, np.abs(f) / np.repeat(steps * np.maximum(np.abs(level), FLOOR), m)

    def shift(self, f: F64, level: F64, starts: I64, m: I64) -> F64:
        """The root of a function that only rises: between what lifts the largest and what lifts
        the smallest step to the level.
        """
        level = level * np.sqrt(self._steps(m) / m)  # of the steps that there are
        low = level - np.maximum.reduceat(f, starts)
        high = level - np.minimum.reduceat(f, starts)
        due = signed_power(level, 2)
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            shifted = f + np.repeat(middle, m)
            below = np.add.reduceat(np.abs(shifted) * shifted, starts) / m < due
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        return (low + high) / 2


def level_scale(levels: F64) -> float:
    """Root mean square of levels; 1 where that is 0."""
    scale = math.sqrt(float(np.mean(levels * levels)))
    return scale if scale > 0 else 1.0


def _floored(scores: F64) -> F64:
    return np.maximum(np.abs(scores), 1e-3 * math.sqrt(float(np.mean(scores * scores))) + 1e-12)
