"""The few statistics of a table: spread, paired t-test and its correction, interquartile mean and
its interval.
"""

from collections.abc import Sequence

import numpy as np

SIGNIFICANCE = 0.05
"""Level of the paired t-test (the supplement's Table 2)."""
REPLICATES = 2000
"""Bootstrap samples of an interval."""
CONFIDENCE = 0.95


def spread(values: Sequence[float]) -> float | None:
    """Sample standard deviation; None for fewer than two values."""
    return float(np.std(values, ddof=1)) if len(values) > 1 else None


def paired_p(a: Sequence[float], b: Sequence[float]) -> float | None:
    """Two-sided p-value of a paired t-test; None for fewer than two pairs.

    If all differences are the same, it is 1 if they are 0, else 0.
    """
    if len(a) < 2:
        return None
    differences = np.asarray(a, np.float64) - np.asarray(b, np.float64)
    if np.ptp(differences) == 0:
        return 1.0 if differences[0] == 0 else 0.0
    from scipy import stats

    return float(stats.ttest_rel(a, b).pvalue)


def holm(p: Sequence[float]) -> list[float]:
    """p-values of several tests, corrected so that any false one among them is as rare as the
    level says (Holm 1979, "A simple sequentially rejective multiple test procedure").

    Args:
        p: of each test.

    Returns:
        The corrected ones in the same order, at most 1.
    """
    corrected = [0.0] * len(p)
    highest = 0.0
    for rank, i in enumerate(sorted(range(len(p)), key=lambda i: p[i])):
        highest = max(highest, min(1.0, (len(p) - rank) * p[i]))
        corrected[i] = highest
    return corrected


def interquartile_mean(values: Sequence[float]) -> float:
    """Mean of the middle half: a quarter of the values, rounded down, is cut off at each end."""
    from scipy import stats

    return float(stats.trim_mean(np.asarray(values, np.float64), 0.25))


def interquartile_interval(
    strata: Sequence[Sequence[float]], seed: int = 0
) -> tuple[float, float]:
    """95 % interval of the interquartile mean of all values, by stratified bootstrap.

    Values are drawn with replacement within each stratum (a composite reward and delay, whose
    values are its seeds), after Agarwal et al. (2021, "Deep RL at the edge of the statistical
    precipice"). The interval is between percentiles.

    Args:
        strata: values of each stratum; none is empty.
        seed: of the draws: the same values give the same interval.
    """
    from scipy import stats

    rng = np.random.default_rng(seed)
    drawn = [
        np.asarray(values, np.float64)[rng.integers(len(values), size=(REPLICATES, len(values)))]
        for values in strata
    ]
    means = stats.trim_mean(np.concatenate(drawn, axis=1), 0.25, axis=1)
    tail = 100 * (1 - CONFIDENCE) / 2
    low, high = np.percentile(means, [tail, 100 - tail])
    return float(low), float(high)
