"""How well inferred step rewards agree with the true ones, and predictions with scores.

A correlation or R^2 is NaN if one side does not vary: there is nothing to explain then.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats


def r_squared(predicted: ArrayLike, true: ArrayLike) -> float:
    """The part of the variance of `true` that `predicted` explains: 1 - residual / total.

    NaN where `true` has no variance but that of rounding.
    """
    expected = np.asarray(true, np.float64)
    residual = np.asarray(predicted, np.float64) - expected
    if not len(expected):
        return float('nan')
    centred = expected - expected.mean()
    spread = float(np.abs(centred).max())
    if spread <= 4 * np.finfo(np.float64).eps * float(np.abs(expected).max()):
        return float('nan')
    total = float((centred**2).sum())
    if not total > np.finfo(np.float64).tiny:  # the squares are too small: use larger units
        residual, total = residual / spread, float(((centred / spread) ** 2).sum())
    return 1 - float((residual**2).sum()) / total


def step_recovery(
    labels: ArrayLike, true: ArrayLike, inside: NDArray[np.bool_]
) -> dict[str, float]:
    """Correlations of inferred and true step rewards, pooled over segments.

    Args:
        labels: inferred step rewards (B, L).
        true: the environment's own (B, L).
        inside: whether each step (B, L) is part of its segment: neither context nor padding.

    Returns:
        `pearson` and `spearman` over all steps; `within_pearson` and `within_spearman` after
        subtracting each segment's mean from both: is credit right inside the segment?
    """
    segments = np.broadcast_to(np.arange(len(inside))[:, None], inside.shape)
    return flat_recovery(np.asarray(labels)[inside], np.asarray(true)[inside], segments[inside])


def flat_recovery(
    labels: ArrayLike, true: ArrayLike, segments: NDArray[np.int64]
) -> dict[str, float]:
    """The same for steps in a row (T,); `segments` (T,) numbers the segment of each."""
    pair = [np.asarray(x, np.float64) for x in (labels, true)]
    _, which = np.unique(segments, return_inverse=True)
    n = np.bincount(which)
    centred = [x - (np.bincount(which, x) / n)[which] for x in pair]
    # the rounding error of a constant less its mean is no variation
    least = [1e-9 * float(np.abs(x).max(initial=0)) for x in pair]
    correlations = {}
    for prefix, (a, b) in (('', pair), ('within_', centred)):
        varies = len(a) > 1 and np.ptp(a) > least[0] and np.ptp(b) > least[1]
        for name, measure in (('pearson', stats.pearsonr), ('spearman', stats.spearmanr)):
            value = float(measure(a, b).statistic) if varies else float('nan')
            correlations[prefix + name] = value
    return correlations
