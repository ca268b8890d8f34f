"""How far inferred step rewards may be off: the posterior's own deviations.

The formulas: docs/methods.md#evidence.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from codetr_ros.records import F32, F64, I64
from codetr_ros.rewards.evidence.model import Model, of_steps


@dataclass(frozen=True, eq=False, slots=True)
class Uncertainty:
    """How far step rewards may be off, one standard deviation, in the unit of labels.

    Of f and of what a reward has beyond f; that a label also explains its segment's own score is
    not taken off.
    """

    steps: F32  # (B, L) of each step's reward, 0 outside of the segments
    segments: F64  # (B,) of the level of each segment's score, predicted from its steps alone


@dataclass(frozen=True, eq=False, slots=True)
class Deviations:
    """Standard deviations in units of the level scale."""

    steps: F64  # (N,) of each step's reward: of f, and of what a reward has beyond f
    segments: F64  # (S,) of the level of each segment's score, predicted from its steps alone


def step_deviations(model: Model, features: Iterable[Tensor]) -> F64:
    """Standard deviations (N,) of rewards of single steps.

    Args:
        model: a fitted regression.
        features: (N, D) of the steps, in pieces.
    """
    parts = [model.posterior.variances(piece.double()).numpy() for piece in features]
    found: F64 = np.sqrt(np.concatenate(parts) + np.exp(model.theta[-2]))
    return found


def deviations(model: Model, features: list[Tensor], m: I64) -> Deviations:
    """Standard deviations of steps and segments, F linearised at the present f.

    Args:
        model: a fitted regression.
        features: (N, D) of the segments' steps, in pieces.
        m: (S,) the segments' steps.
    """
    step_noise, score_noise = np.exp(model.theta[-2:])
    rows, slopes = _level_rows(model, features, m)
    spread = np.add.reduceat(slopes * slopes, np.cumsum(m) - m)
    levels = model.posterior.variances(rows).numpy() + step_noise * spread + score_noise
    return Deviations(step_deviations(model, features), np.sqrt(levels))


def level_covariance(model: Model, features: list[Tensor], m: I64) -> F64:
    """Covariance (S, S) of segments' levels under the posterior of the weights alone.

    Args:
        model: a fitted regression.
        features: (N, D) of the segments' steps, in pieces.
        m: (S,) the segments' steps.
    """
    rows, _ = _level_rows(model, features, m)
    covariance: F64 = (rows @ model.posterior.covariance @ rows.T).numpy()
    return covariance


def _level_rows(model: Model, features: list[Tensor], m: I64) -> tuple[Tensor, F64]:
    """What weights are multiplied by for a level (S, D), F linearised, and its slopes (N,)."""
    f = np.concatenate([of_steps(piece, model.posterior.mean) for piece in features])
    slopes = model.link.forward(f, np.cumsum(m) - m, m)[1]
    weights, parts = (
        torch.split(each, m.tolist()) for each in (torch.tensor(slopes), torch.cat(features))
    )
    rows = [w @ part.double() for w, part in zip(weights, parts, strict=True)]
    return torch.stack(rows), slopes
