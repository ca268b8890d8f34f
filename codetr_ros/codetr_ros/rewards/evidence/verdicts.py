"""Scores on an ordinal scale, such as one to five stars: only their order means anything.

The formulas: docs/methods.md#evidence.

A verdict states between which two thresholds the level of a segment lies, with noise of its own:
P(verdict <= k) = Phi((b_k - L) / tau), the ordinal probit model; but for a share of lapses, which
are any of the K verdicts, whatever the level. Thresholds b and tau are those under which the
verdicts are likeliest, each level as predicted from all other verdicts. The share of lapses is
fixed: a learnt one explains verdicts that are rare. What a verdict then contributes to the
regression is a level and a variance of it (a site of expectation propagation; Minka, 2001; Chu and
Ghahramani, 2005): little where it is likely to be a lapse. All of this is decided here; the trial
took verdicts for numbers.
"""

from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr, ndtr, ndtri

from codetr_ros.records import F64
from codetr_ros.rewards.base import RewardModelError

LEAST_NOISE, MOST_NOISE = 0.03, 10.0
"""Bounds of tau, in units of the deviation of levels."""
PRIOR_NOISE = 0.3
"""Where the prior of tau is centred; its logarithm has variance 1."""
LAPSES = 0.1
"""Share of verdicts that have nothing to do with the level."""
MOST_VALUES = 32
"""Of an ordinal scale."""
FEW_VALUES = 10
"""Different scores up to which they are taken for verdicts where nobody says what they are."""
MOST_CHANGE = 4.0
"""Of the unit of levels in a turn, as a factor: verdicts that show nothing have no spread."""
FAR = 30.0
"""Deviations from the mean at which a normal distribution ends."""


@dataclass(frozen=True)
class Verdicts:
    """An ordinal scale of K verdicts, in units of the level scale."""

    values: F64  # (K,) the scores that were given, ascending
    thresholds: F64  # (K - 1,) ascending
    tau: float
    spread: float
    """Variance of a level about its prediction from other verdicts, on average."""

    @classmethod
    def first(cls, scores: F64, levels: F64) -> 'Verdicts':
        """As if levels were normal: thresholds by how often each verdict was given.

        Args:
            scores: (S,) verdicts.
            levels: (S,) taken for numbers, whose mean and deviation stay those of levels.
        """
        values, counts = np.unique(scores, return_counts=True)
        shares = np.cumsum(counts)[:-1] / len(scores)
        deviation = float(levels.std()) or 1.0
        thresholds = float(levels.mean()) + deviation * ndtri(shares)
        return cls(values, thresholds, PRIOR_NOISE * deviation, deviation**2)

    def of(self, scores: F64) -> tuple[F64, F64]:
        """The thresholds (S,) below and above each verdict; of a new one, by its order."""
        low = np.concatenate([[-np.inf], self.thresholds])
        high = np.concatenate([self.thresholds, [np.inf]])
        places = np.clip(np.searchsorted(self.values, scores), 0, len(self.values) - 1)
        return low[places], high[places]

    def expected(self, scores: F64, mean: F64, variance: F64 | float) -> tuple[F64, F64]:
        """Mean and variance (S,) of levels given their verdicts.

        Args:
            scores: (S,) verdicts.
            mean: (S,) of the levels before their verdicts are known.
            variance: (S,) of the same, or one for all.
        """
        low, high = self.of(scores)
        total = np.sqrt(variance + self.tau**2)
        below, above = ((b - mean) / total for b in (low, high))
        mass = _log_mass(below, above)
        up, down = (np.exp(_log_density(z) - mass) for z in (below, above))
        slope = (up - down) / total
        finite = [np.where(np.isfinite(z), z, 0.0) for z in (below, above)]
        bend = slope**2 - (finite[0] * up - finite[1] * down) / total**2
        bend = np.clip(bend, 1e-9 / total**2, 1 / total**2)
        meant = np.exp(np.log1p(-LAPSES) + mass - self._with_lapses(mass))  # so likely no lapse
        bend = meant * (bend - (1 - meant) * slope**2)
        slope = meant * slope
        return mean + variance * slope, np.maximum(variance - variance**2 * bend, 1e-12)

    def _with_lapses(self, mass: F64) -> F64:
        """Logarithm of how likely verdicts are.

        Args:
            mass: (S,) logarithm of how likely they are where they are no lapses.
        """
        likely: F64 = np.logaddexp(np.log1p(-LAPSES) + mass, np.log(LAPSES / len(self.values)))
        return likely

    def revealed(self, mean: F64, variance: F64) -> F64:
        """Share (S,) of the variance of levels that their verdicts are expected to remove.

        Args:
            mean: (S,) of the levels before their verdicts are known.
            variance: (S,) of the same.
        """
        total = np.sqrt(variance + self.tau**2)
        left = np.zeros(len(mean))
        for value in self.values:
            scores = np.full(len(mean), value)
            below, above = ((b - mean) / total for b in self.of(scores))
            likely = np.exp(self._with_lapses(_log_mass(below, above)))
            left += likely * self.expected(scores, mean, variance)[1]
        share: F64 = np.clip(1 - left / variance, 0, 1)
        return share

    def sites(self, scores: F64, mean: F64, variance: F64) -> tuple[F64, F64]:
        """The levels (S,) and their variances (S,) that stand for the verdicts in a regression.

        Args:
            scores: (S,) verdicts.
            mean: (S,) of the levels, each predicted from all other verdicts.
            variance: (S,) of the same.
        """
        after, left = self.expected(scores, mean, variance)
        precision = np.maximum(1 / left - 1 / variance, 1e-6 / variance)
        return (after / left - mean / variance) / precision, 1 / precision

    def learnt(self, scores: F64, mean: F64, variance: F64) -> 'Verdicts':
        """The scale under which verdicts are likeliest.

        Args:
            scores: (S,) verdicts; of each value there is one at least.
            mean: (S,) of the levels, each predicted from all other verdicts.
            variance: (S,) of the same.
        """
        from scipy.optimize import minimize  # takes a second to import

        unit = np.sqrt(self.spread) or 1.0
        places = np.searchsorted(self.values, scores)

        def scale(x: F64) -> tuple[F64, float]:
            steps = np.exp(np.clip(x[1:-1], -12, 4)) * unit
            thresholds = x[0] * unit + np.concatenate([[0.0], np.cumsum(steps)])
            return thresholds, float(np.clip(np.exp(x[-1]), LEAST_NOISE, MOST_NOISE) * unit)

        def loss(x: F64) -> float:
            thresholds, tau = scale(x)
            low = np.concatenate([[-np.inf], thresholds])[places]
            high = np.concatenate([thresholds, [np.inf]])[places]
            total = np.sqrt(variance + tau**2)
            mass = _log_mass((low - mean) / total, (high - mean) / total)
            away = float(x[-1] - np.log(PRIOR_NOISE))
            return -float(self._with_lapses(mass).sum()) + 0.5 * away**2

        steps = np.log(np.maximum(np.diff(self.thresholds), 1e-4 * unit) / unit)
        begin = np.concatenate([[self.thresholds[0] / unit], steps, [np.log(self.tau / unit)]])
        best = minimize(loss, begin, method='L-BFGS-B', options={'maxiter': 30})
        thresholds, tau = scale(np.asarray(best.x, np.float64))
        return Verdicts(self.values, thresholds, tau, float(variance.mean()))

    def followed(
        self, scores: F64, levels: F64, mean: F64, variance: F64
    ) -> tuple['Verdicts', float, float]:
        """The scale under which verdicts are likeliest, in the unit that they have as numbers.

        Levels keep the mean and the deviation that they have with verdicts taken for numbers: else
        any other unit would do as well.

        Args:
            scores: (S,) verdicts; of each value there is one at least.
            levels: (S,) taken for numbers.
            mean: (S,) of the levels, each predicted from all other verdicts.
            variance: (S,) of the same.

        Returns:
            The scale, and by which factor and shift a level goes over into its unit.
        """
        learnt = self.learnt(scores, mean, variance)
        expected = learnt.expected(scores, mean, variance)[0]
        several = len(learnt.values) > 1
        factor = float(levels.std() / (expected.std() or 1.0)) if several else 1.0
        factor = min(max(factor, 1 / MOST_CHANGE), MOST_CHANGE)
        shift = float(levels.mean() - factor * expected.mean())
        return learnt.moved(factor, shift), factor, shift

    def log_likelihood(self, scores: F64, mean: F64, variance: F64) -> float:
        """Of verdicts (S,), their levels distributed as stated."""
        total = np.sqrt(variance + self.tau**2)
        below, above = ((b - mean) / total for b in self.of(scores))
        return float(self._with_lapses(_log_mass(below, above)).sum())

    def mean_value(self, level: F64) -> F64:
        """The mean verdict (S,), as a number, on segments of predicted levels (S,)."""
        total = np.sqrt(self.spread + self.tau**2)
        below = ndtr((self.thresholds - level[:, None]) / total)  # (S, K - 1)
        ends = np.concatenate([np.zeros((len(level), 1)), below, np.ones((len(level), 1))], 1)
        mean: F64 = np.diff(ends) @ self.values
        return (1 - LAPSES) * mean + LAPSES * float(self.values.mean())

    def moved(self, factor: float, shift: float) -> 'Verdicts':
        """The same scale in other units: each level times `factor`, plus `shift`."""
        return Verdicts(
            self.values,
            self.thresholds * factor + shift,
            self.tau * factor,
            self.spread * factor**2,
        )


def are_verdicts(scores: F64, stated: bool) -> bool:
    """Whether the scores that scorers have given so far can be taken for verdicts.

    Args:
        scores: (S,) of segments; of several scorers, brought to one scale.
        stated: the settings say that they are; else few different values must come often.
    """
    values = len(np.unique(scores))
    if stated:
        return 2 <= values <= MOST_VALUES
    return 2 <= values <= FEW_VALUES and len(scores) >= 2 * values


def require_few_values(scores: F64) -> None:
    """Refuse scores that cannot be those of an ordinal scale.

    Raises:
        RewardModelError: they have one value only, or too many.
    """
    values = np.unique(scores)
    if not 2 <= len(values) <= MOST_VALUES:
        shown = ', '.join(f'{value:g}' for value in values[:3])
        raise RewardModelError(
            f'evidence.score_scale = ordinal: the {len(scores)} scores have {len(values)} '
            f'different values ({shown}, ...), an ordinal scale has 2 to {MOST_VALUES}. Set '
            'evidence.score_scale to numbers'
        )


def _log_density(z: F64) -> F64:
    """Of the standard normal distribution."""
    density: F64 = -0.5 * np.clip(z, -FAR, FAR) ** 2 - 0.5 * np.log(2 * np.pi)
    return np.where(np.isfinite(z), density, -np.inf)


def _log_mass(low: F64, high: F64) -> F64:
    """log(Phi(high) - Phi(low)), exact in the tails too."""
    low, high = np.clip(low, -FAR, FAR), np.clip(high, -FAR, FAR)
    # of two tails the lower one is exact
    flip = low > 0
    low, high = np.where(flip, -high, low), np.where(flip, -low, high)
    upper = log_ndtr(high)
    ratio = np.minimum(log_ndtr(low) - upper, -1e-12)
    mass: F64 = upper + np.log1p(-np.exp(ratio))
    return mass
