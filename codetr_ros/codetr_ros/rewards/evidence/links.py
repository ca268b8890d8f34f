"""The links by name: those of the composite rewards, and the mean."""

from collections.abc import Callable

from codetr_ros.rewards.evidence.link import Link, Mean, SquareSum, Sum, SumSquare
from codetr_ros.rewards.evidence.maxima import (
    MaxHard,
    MaxLogSumExp,
    MaxTimesN,
    Minimum,
    PeakEnd,
    SoftMax,
)

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
    'peak_end': lambda beta, delay: PeakEnd(HARD, learnt=True),
}
NAMES = tuple(_MAKE)
"""Links by name: those of the composite rewards, and the mean. Saved models hold their places."""


VERDICTS = 4.0
"""Inverse temperature from which that of a maximum is learnt where scores are verdicts: theirs is
not known, as they have no unit.
"""


def make(name: str, beta: float, delay: int, ordinal: bool = False) -> Link:
    """A link by its name.

    Args:
        name: one of `NAMES`.
        beta: the inverse temperature that scores are made with, in the task's unit.
        delay: n, the steps of a whole segment.
        ordinal: only the order of scores means anything.
    """
    link = _MAKE[name](VERDICTS if ordinal else beta, delay)
    link.whole = delay
    if ordinal and isinstance(link, SoftMax) and not isinstance(link, MaxLogSumExp):
        link.learnt = True
    return link
