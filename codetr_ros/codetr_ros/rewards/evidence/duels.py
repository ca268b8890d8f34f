"""Preferences between two segments, as the regression learns from them where F is linear.

The formulas: docs/methods.md#preferences.

A preference is a verdict on the difference of two levels: that it is positive, negative, or about
0. So it stands for a row in the regression, the difference of two segments' mean features, with a
level and a variance of it (sites as in `verdicts`). The width of what is about 0, and the noise of
comparisons, are fixed shares of the deviation of levels (decided here): nothing about them has to
be saved.
"""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from codetr_ros.records import EQUAL, F64, FIRST, I64, SECOND
from codetr_ros.rewards.evidence.link import Link
from codetr_ros.rewards.evidence.sample import Sample
from codetr_ros.rewards.evidence.verdicts import Verdicts

NOISE, WIDTH = 0.3, 0.1
"""Of comparisons, and up to which difference both are as good: in deviations of levels."""
TURNS = 5
"""Of working out what preferences stand for, each from all others."""
SUREST = 0.05
"""The least deviation of what a preference stands for, in deviations of levels."""


@dataclass(frozen=True, eq=False)
class Duels:
    """Preferences, P of them, in units of the level scale."""

    rows: Tensor  # (P, D) the first one's mean features less the second one's
    spread: Tensor  # (P,)
    outcomes: F64  # (P,)

    @classmethod
    def of(cls, sample: Sample, link: Link, first: I64, second: I64, outcomes: F64) -> 'Duels':
        """Between segments of a sample.

        Args:
            sample: holds them.
            link: by what segments of different lengths are compared.
            first: (P,) the place of the first one.
            second: (P,) the place of the second one.
            outcomes: (P,) 1: the first is better, 0: the second, 0.5: both are as good.
        """
        shares = link.shares(sample.m)
        means = sample.means() * torch.tensor(shares)[:, None]
        rows = means[torch.tensor(first)] - means[torch.tensor(second)]
        spread = shares**2 / sample.m
        return cls(rows, torch.tensor(spread[first] + spread[second]), outcomes)

    def before(self, deviation: float) -> tuple[F64, F64]:
        """Mean and variance (P,) of the differences while nothing is known of the segments.

        Args:
            deviation: of levels.
        """
        count = len(self.outcomes)
        return np.zeros(count), np.full(count, 2 * deviation**2)

    def sites(self, mean: F64, variance: F64, deviation: float) -> tuple[F64, F64]:
        """The differences (P,) and their variances (P,) that stand for the preferences.

        Args:
            mean: (P,) of the differences, each predicted from all others.
            variance: (P,) of the same.
            deviation: of levels.
        """
        width = WIDTH * deviation
        values, thresholds = np.array([SECOND, EQUAL, FIRST]), np.array([-width, width])
        scale = Verdicts(values, thresholds, NOISE * deviation, deviation**2)
        levels, left = scale.sites(self.outcomes, mean, np.maximum(variance, 1e-9))
        far = 4 * deviation
        return np.clip(levels, -far, far), np.maximum(left, (SUREST * deviation) ** 2)
