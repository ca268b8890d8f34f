"""Judge a reward method on data in a memory by its predictions, labels and attention."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from codetr_ros.offline.fitting import BATCH, predictions
from codetr_ros.offline.loading import Loaded
from codetr_ros.records import F32, F64, I64
from codetr_ros.rewards.base import Predictor, RewardMethod
from codetr_ros.runs.recovery_metrics import r_squared, step_recovery
from codetr_ros.runs.segments import Segment, spread_evenly

MEASURES = (
    *('segments', 'composite_r2', 'segments_with_true_rewards'),
    *('pearson', 'spearman', 'within_pearson', 'within_spearman'),
)
"""The names of the metrics of a judgement."""


@dataclass(kw_only=True)
class Judgement:
    """The metrics of a method on the segments of a memory, with the values behind them."""

    metrics: dict[str, float | None]
    values: F64  # (S,) composite rewards
    predicted: F64 | None  # (S,) as predicted by the model; None for rules
    labels: F64  # steps whose true rewards are known, one after the other
    true: F32
    shown: list[Segment]


def judge(method: RewardMethod, loaded: Loaded) -> Judgement:
    """Label all segments of a memory, and compare labels and predictions with the truth.

    Args:
        method: the method, prepared.
        loaded: the memory.

    Returns:
        The judgement. Metrics that cannot be computed are None: there is no variance, or no true
        reward is known.
    """
    memory = loaded.memory
    ids = memory.segments.ids()
    values = memory.segments.scores(ids)
    labels = labels_of(method, loaded, ids) * np.float64(method.unit)
    true = true_rewards_of(loaded, ids)
    inside = ~np.isnan(labels)
    known = np.asarray((np.isfinite(true) | ~inside).all(1))
    predicted = predictions(method, loaded) if isinstance(method, Predictor) else None
    metrics = {
        'segments': float(len(ids)),
        'composite_r2': r_squared(predicted, values) if predicted is not None else float('nan'),
        'segments_with_true_rewards': float(known.sum()),
        **step_recovery(labels[known], true[known], inside[known]),
    }
    return Judgement(
        metrics={name: None if np.isnan(value) else value for name, value in metrics.items()},
        values=values,
        predicted=predicted,
        labels=labels[known][inside[known]],
        true=true[known][inside[known]],
        shown=_shown(method, loaded, ids, labels, true, known, predicted),
    )


def labels_of(method: RewardMethod, loaded: Loaded, ids: I64) -> F32:
    """Step rewards (S, L) of segments, NaN beyond their ends."""
    lengths = loaded.memory.segments.lengths(ids)
    labels = np.full((len(ids), int(lengths.max())), np.nan, np.float32)
    for i in range(0, len(ids), method.label_batch):
        some = ids[i : i + method.label_batch]
        joined = np.concatenate(list(method.label_passes(loaded.memory, some)))
        mine = np.arange(labels.shape[1]) < lengths[i : i + method.label_batch, None]
        rows = labels[i : i + method.label_batch]
        rows[mine] = joined
    return labels


def true_rewards_of(loaded: Loaded, ids: I64) -> F32:
    """The environment's own rewards (S, L) of segments, NaN where they are not known."""
    lengths = loaded.memory.segments.lengths(ids)
    rewards = np.full((len(ids), int(lengths.max())), np.nan, np.float32)
    for i in range(0, len(ids), BATCH):
        batch = loaded.memory.segments.batch(ids[i : i + BATCH])
        if batch.true_rewards is not None:
            rewards[i : i + BATCH, : batch.true_rewards.shape[1]] = batch.true_rewards
    return rewards


def _shown(
    method: RewardMethod,
    loaded: Loaded,
    ids: I64,
    labels: F64,
    true: F32,
    known: np.ndarray[Any, Any],
    predicted: F64 | None,
) -> list[Segment]:
    """Segments for pictures, spread evenly from the lowest to the highest score."""
    memory = loaded.memory
    _, episodes, firsts, lengths = memory.segments.spans(ids)[0]
    shown = []
    for i in spread_evenly(memory.segments.scores(ids)):
        stretch, length = loaded.stretches[int(episodes[i])], int(lengths[i])
        batch = memory.segments.batch(ids[i : i + 1], method.context)
        weights, deviations = method.step_weights(batch), method.step_deviations(batch)
        shown.append(
            Segment(
                source=stretch.key.source,
                episode=stretch.episode,
                first=stretch.first + int(firsts[i]),
                value=float(batch.values[0]),
                predicted=float(predicted[i]) if predicted is not None else None,
                labels=labels[i, :length],
                true=true[i, :length] if known[i] else None,
                weights=None if weights is None else weights[0, batch.context[0] :],
                deviations=None
                if deviations is None
                else deviations[0, batch.context[0] :][:length] * method.unit,
            )
        )
    return shown
