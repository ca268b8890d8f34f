"""Composite delayed rewards: one number for the m <= n steps of a segment (the paper's R_co).

The delay n cuts every episode, from its start, into segments of n steps, or of at most n where
their lengths are drawn. The last may be shorter and is scored by the same formula. All numbers are
float64. How certain each formula is: the supplement states the types and beta, not all of the
formulas. Signed squares follow from the negative scores in its Table 2, and the softmax reading of
Max from its word "scaling parameter". The other maxima are variants by name. `minimum` and
`peak_end` are not the paper's: they are kinds of score that no method was made for.

All formulas in a table: docs/methods.md#composite-rewards.
"""

# ruff: noqa: ARG001  (every formula takes the same arguments, so that they are interchangeable)

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]


class CompositeError(ValueError):
    """A composite reward that does not exist: names its type and the fault."""


def _sum(rewards: F64, beta: float, delay: int) -> float:
    """S = r_1 + ... + r_m."""
    return float(rewards.sum())


def _sum_square(rewards: F64, beta: float, delay: int) -> float:
    """Sum of |r| r: squares that keep their sign."""
    return float((np.abs(rewards) * rewards).sum())


def _square_sum(rewards: F64, beta: float, delay: int) -> float:
    """|S| S, with S = r_1 + ... + r_m."""
    total = float(rewards.sum())
    return abs(total) * total


def _max(rewards: F64, beta: float, delay: int) -> float:
    """Sum of softmax(beta r)_t r_t: between mean (beta -> 0) and maximum (beta -> infinity)."""
    # at most 1, and 1 for the largest: nothing overflows
    weights = np.exp(beta * (rewards - rewards.max()))
    return float(weights @ rewards / weights.sum())


def _max_hard(rewards: F64, beta: float, delay: int) -> float:
    """The largest reward."""
    return float(rewards.max())


def _max_log_sum_exp(rewards: F64, beta: float, delay: int) -> float:
    """log(sum of exp(beta r)) / beta: the maximum plus at most log(m) / beta."""
    largest = float(rewards.max())
    return largest + float(np.log(np.exp(beta * (rewards - largest)).sum())) / beta


def _max_times_n(rewards: F64, beta: float, delay: int) -> float:
    """Soft maximum, times n: the scale of Sum, and the same score as Max."""
    return delay * _max(rewards, beta, delay)


def _minimum(rewards: F64, beta: float, delay: int) -> float:
    """Sum of softmax(-beta r)_t r_t: the soft maximum of -r, negated."""
    return -_max(-rewards, beta, delay)


def _peak_end(rewards: F64, beta: float, delay: int) -> float:
    """The mean of the best and the last step: how people remember an experience.

    The peak-end rule (Kahneman, Fredrickson, Schreiber and Redelmeier, 1993, recalled) takes the
    most intense moment for the peak, good or bad. Here it is the largest reward (decided here), so
    that no step can lower a score by being better.
    """
    return (float(rewards.max()) + float(rewards[-1])) / 2


COMPOSITES: dict[str, Callable[[F64, float, int], float]] = {
    'sum': _sum,
    'sum_square': _sum_square,
    'square_sum': _square_sum,
    'max': _max,
    'max_hard': _max_hard,
    'max_log_sum_exp': _max_log_sum_exp,
    'max_times_n': _max_times_n,
    'minimum': _minimum,
    'peak_end': _peak_end,
}
"""The types by name: functions of rewards (m,), beta and delay n."""


def composite(name: str, rewards: F64, beta: float, delay: int) -> float:
    """The composite reward of one segment.

    Args:
        name: one of `COMPOSITES`.
        rewards: (m,) the rewards of the segment's steps, 1 <= m <= delay.
        beta: inverse temperature of the soft maxima, positive; 3 in the paper (A.1).
        delay: n, the steps of a full segment.

    Raises:
        CompositeError: no such type, no steps or too many, or a value that float64 cannot hold.
    """
    try:
        formula = COMPOSITES[name]
    except KeyError:
        raise CompositeError(
            f'there is no composite reward {name!r}: choose one of {", ".join(COMPOSITES)}'
        ) from None
    if rewards.ndim != 1 or not 1 <= len(rewards) <= delay:
        raise CompositeError(
            f'composite={name}: rewards have shape {rewards.shape}, a segment has 1 to '
            f'delay={delay} steps'
        )
    with np.errstate(over='ignore', invalid='ignore'):
        value = formula(np.asarray(rewards, np.float64), beta, delay)
    if not math.isfinite(value):
        raise CompositeError(
            f'composite={name} of rewards between {rewards.min()} and {rewards.max()} is '
            f'{value}: it must be finite; scale the rewards of the task down'
        )
    return value


def perfect_score(
    name: str, beta: float, delay: int, horizon: int, r_max: float, shortest: int | None = None
) -> float:
    """What an agent that earns r_max at every step collects in an episode: the unit of scores
    (A.3; docs/methods.md#score).

    It is the composite reward of a full segment, horizon / delay times. That number of segments is
    not rounded where the delay does not divide the horizon, although the episode's shorter last
    segment is scored: a maximum can then exceed a score of 1. Where lengths are drawn, it is the
    mean composite reward over all lengths, horizon / mean length times.

    Args:
        name: one of `COMPOSITES`.
        beta: inverse temperature of the soft maxima.
        delay: n, the steps of a full segment.
        horizon: T, the steps of a full episode.
        r_max: the largest reward of one step, positive.
        shortest: the least steps of a full segment, if they are drawn from there to `delay`.
    """
    lengths = range(shortest or delay, delay + 1)
    whole = [composite(name, np.full(m, r_max, np.float64), beta, delay) for m in lengths]
    return horizon / (sum(lengths) / len(lengths)) * (sum(whole) / len(whole))
