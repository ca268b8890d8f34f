"""Which kind of score it is, where nobody states it: the one that makes the scores likeliest.

The formulas: docs/methods.md#evidence.

From the trial: the evidence of each link as a probability density of the scores themselves, the
two temperatures from which the soft maximum's is learnt. Decided here: the minimum and, where
lengths differ, the mean are candidates too; how sure a choice is.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from codetr_ros.records import I64
from codetr_ros.rewards.evidence.link import Link, Mean, SquareSum, Sum, SumSquare
from codetr_ros.rewards.evidence.maxima import Minimum, SoftMax
from codetr_ros.rewards.evidence.model import Model
from codetr_ros.rewards.evidence.sample import Sample

BETAS = (0.7, 4.0)
"""Inverse temperatures from which that of a soft maximum is learnt, in units of one by the level
scale.
"""


@dataclass(frozen=True)
class Choice:
    """The links that were tried."""

    models: dict[str, Model]  # the best of each name
    probabilities: dict[str, float]  # of each name, all names alike beforehand

    @property
    def order(self) -> list[str]:
        """The names, the likeliest first."""
        return sorted(self.models, key=lambda name: -self.models[name].evidence)

    @property
    def margin(self) -> float:
        """By how much its log evidence exceeds that of the next one [nats]."""
        *_, second, first = sorted(model.evidence for model in self.models.values())
        return first - second


def candidates(m: I64) -> list[Link]:
    """What is tried on segments of m (S,) steps: sum and mean differ where lengths do."""
    made: list[Link] = [Sum(), SquareSum(), SumSquare()]
    if (m != m[0]).mean() > 0.1:
        made.append(Mean())
    for beta in BETAS:
        made += [SoftMax(beta, learnt=True), Minimum(beta, learnt=True)]
    return made


def choose(sample: Sample, some: I64, blocks: Sequence[slice], ordinal: bool = False) -> Choice:
    """Fit each candidate to the same scores.

    Args:
        sample: segments, with the features of their steps.
        some: places of those from which the scales are learnt and the evidence is.
        blocks: of the features.
        ordinal: only the order of scores means anything.
    """
    models: dict[str, Model] = {}
    for link in candidates(sample.m):
        model = Model(link, blocks)
        model.fit(sample, some, ordinal)
        if link.name not in models or model.evidence > models[link.name].evidence:
            models[link.name] = model
    most = max(model.evidence for model in models.values())
    odds = {name: math.exp(model.evidence - most) for name, model in models.items()}
    total = float(np.sum(list(odds.values())))
    return Choice(models, {name: odd / total for name, odd in odds.items()})
