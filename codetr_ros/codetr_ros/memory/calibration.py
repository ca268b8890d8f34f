"""The scales of several scorers, learnt from what they score: offset, slope and noise of each.

    y_ks = a_k + b_k (z_s + noise_k),   z_s ~ N(mu_s, v)

z_s is the worth of segment s on the scale of the reference, the scorer whose a is 0 and b is 1.
mu_s is what the reward model expects of the segment, or one number for all where it knows nothing
yet: then scorers are brought to one scale by the segments that they share and, as far as they
share none, by the spread of what they gave. The priors of all a_k and b_k have widths of their
own, which are learnt too: empirical Bayes (Robbins, 1956; Dempster, Laird and Rubin, 1977, for
the rounds). Decided here: the priors, and that a slope stays positive.

The formulas: docs/people.md#several-scorers.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from codetr_ros.records import F64, I64

ROUNDS = 60
"""Of expectation and maximisation."""
NOISE = 0.3
"""Where the variance of a scorer's noise is centred, in units of the variance of what it gave."""
WIDTH = 0.25
"""Where the variances of offsets and slopes are centred, in the same units."""
LEAST_SLOPE = 0.1
"""Of a scorer, in units of the spread of what it gave: who seems to score backwards is noise."""
FEWEST = 3
"""Segments that two sides must share for a correlation of what they gave."""


@dataclass(frozen=True, eq=False)
class Scales:
    """How K scorers score: a score is offset + slope * worth, on the scale of the reference."""

    offsets: F64  # (K,)
    slopes: F64  # (K,) positive
    noises: F64  # (K,) standard deviation, on the scale of the reference
    worths: F64  # (S,) of each segment: the mean of its scores, brought to that scale and weighted
    agreement: F64  # (K,) correlation with the mean of the others' on shared segments; NaN: few


def calibrate(
    who: I64, segments: I64, scores: F64, reference: int, expected: F64 | None = None
) -> Scales:
    """Learn the scales of several scorers.

    Args:
        who: (N,) the scorer of each score, 0 to K-1; each has one at least.
        segments: (N,) its segment, 0 to S-1; each has one at least.
        scores: (N,) finite.
        reference: the scorer on whose scale worths are.
        expected: (S,) what the reward model expects of each segment, in any unit and at any
            level; None: it knows nothing yet.
    """
    means, deviations = _spreads(who, scores, reference)
    t = (scores - means[who]) / deviations[who]
    fit = _Rounds(who, segments, t, reference, expected)
    for _ in range(ROUNDS):
        fit.round()
    mean, deviation = means[reference], deviations[reference]
    slopes = deviations * fit.slopes / deviation
    weights = (fit.slopes**2 / fit.noises)[who]
    worth = (t - fit.offsets[who]) / fit.slopes[who]
    totals = np.bincount(segments, weights)
    worths = np.bincount(segments, weights * worth) / totals
    return Scales(
        offsets=means + deviations * fit.offsets - slopes * mean,
        slopes=slopes,
        noises=np.sqrt(fit.noises) / fit.slopes * deviation,
        worths=mean + deviation * worths,
        agreement=_agreement(who, segments, worth),
    )


def _spreads(who: I64, scores: F64, reference: int) -> tuple[F64, F64]:
    """Mean and deviation (K,) of what each gave; those of few scores lean on the reference's."""
    own = scores[who == reference]
    mean, variance = float(own.mean()), float(own.var())
    if not variance:
        everybody = float(scores.var())
        variance = everybody or 1.0
    counts = np.bincount(who).astype(np.float64)
    averages = np.bincount(who, scores) / counts
    squares = np.bincount(who, (scores - averages[who]) ** 2)
    off = counts / (counts + 1) * (averages - mean) ** 2
    means = (mean + counts * averages) / (1 + counts)
    variances = (variance + squares + off) / (1 + counts)
    means[reference], variances[reference] = mean, variance
    return means, np.sqrt(variances)


class _Rounds:
    """Expectation and maximisation, in units of the spread of what each scorer gave."""

    def __init__(
        self, who: I64, segments: I64, t: F64, reference: int, expected: F64 | None
    ) -> None:
        self._who, self._segments, self._t, self._reference = who, segments, t, reference
        self._counts = np.bincount(who).astype(np.float64)
        size = len(self._counts)
        self.offsets, self.slopes = np.zeros(size), np.ones(size)
        self.noises = np.full(size, NOISE)
        self._widths = np.full(2, WIDTH)  # variances of offsets and slopes
        self._spread = 1.0  # v
        self._mu = np.zeros(int(segments.max()) + 1)
        self._expected = None
        if expected is not None and expected.std() > 0:
            self._expected = (expected - expected.mean()) / expected.std()

    def round(self) -> None:
        """Work out the worths under the present scales, then the scales under these worths."""
        who, t = self._who, self._t
        weights = (self.slopes**2 / self.noises)[who]
        precision = 1 / self._spread + np.bincount(self._segments, weights)
        pulls = (self.slopes / self.noises)[who] * (t - self.offsets[who])
        z = (self._mu / self._spread + np.bincount(self._segments, pulls)) / precision
        self._expect(z, 1 / precision)
        at, square = z[self._segments], (z**2 + 1 / precision)[self._segments]
        self._learn_scales(at, square)
        off = t - self.offsets[who] - self.slopes[who] * at
        doubt = self.slopes[who] ** 2 * (square - at**2)
        squares = np.bincount(who, off**2 + doubt)
        self.noises = (NOISE + squares) / (1 + self._counts)

    def _expect(self, z: F64, doubt: F64) -> None:
        """What is expected of segments: linear in what the model expects, or one number."""
        columns = [np.ones(len(z))]
        if self._expected is not None:
            columns.append(self._expected)
        rows = np.stack(columns, 1)
        inner = rows.T @ rows + 0.1 * np.eye(len(columns))
        self._mu = rows @ np.linalg.solve(inner, rows.T @ z)
        squares = float(((z - self._mu) ** 2 + doubt).sum())
        self._spread = (1 + squares) / (1 + len(z))

    def _learn_scales(self, z: F64, square: F64) -> None:
        size = len(self._counts)
        sums = [np.bincount(self._who, x, size) for x in (z, square, self._t, self._t * z)]
        for k in range(size):
            if k == self._reference:
                continue
            n, noise = self._counts[k], self.noises[k]
            first, second, given, both = (each[k] / noise for each in sums)
            inner = np.array([[n / noise, first], [first, second]]) + np.diag(1 / self._widths)
            right = np.array([given, both + 1 / self._widths[1]])
            self.offsets[k], slope = np.linalg.solve(inner, right)
            self.slopes[k] = max(LEAST_SLOPE, float(slope))
        others = np.arange(size) != self._reference
        spread = np.array(
            [(self.offsets[others] ** 2).sum(), ((self.slopes - 1)[others] ** 2).sum()]
        )
        self._widths = (2 * WIDTH + spread) / (2 + others.sum())


def _agreement(who: I64, segments: I64, worth: F64) -> F64:
    """Correlation (K,) of each one's scores with the mean of the others' of the same segments."""
    totals, counts = np.bincount(segments, worth), np.bincount(segments)
    shared: NDArray[np.bool_] = counts[segments] > 1
    rest = (totals[segments] - worth) / np.maximum(counts[segments] - 1, 1)
    agreement = np.full(int(who.max()) + 1, np.nan)
    for k in range(len(agreement)):
        mine = shared & (who == k)
        if mine.sum() >= FEWEST and worth[mine].std() > 0 and rest[mine].std() > 0:
            agreement[k] = np.corrcoef(worth[mine], rest[mine])[0, 1]
    return agreement
