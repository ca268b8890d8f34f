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
    found = levels(model, features, m)
    return Deviations(step_deviations(model, features), np.sqrt(found.variance))


@dataclass(frozen=True, eq=False, slots=True)
class Levels:
    """What a regression expects of levels of segments' scores, in units of the level scale."""

    mean: F64  # (S,)
    variance: F64  # (S,) predicted from their steps alone
    rows: Tensor  # (S, D) what weights are multiplied by for a level
    of_weights: Tensor  # (D, D) covariance of the weights

    @property
    def covariance(self) -> F64:
        """Covariance (S, S) under the posterior of the weights alone."""
        covariance: F64 = (self.rows @ self.of_weights @ self.rows.T).numpy()
        return covariance


def levels(model: Model, features: list[Tensor], m: I64) -> Levels:
    """Mean and variances of levels, F linearised at the present f.

    Args:
        model: a fitted regression.
        features: (N, D) of the segments' steps, in pieces.
        m: (S,) the segments' steps.
    """
    starts, known = np.cumsum(m) - m, model.posterior
    f = np.concatenate([of_steps(piece, known.mean) for piece in features])
    mean, slopes = model.link.forward(f, starts, m)
    weights, parts = (
        torch.split(each, m.tolist()) for each in (torch.tensor(slopes), torch.cat(features))
    )
    rows = torch.stack([w @ part.double() for w, part in zip(weights, parts, strict=True)])
    step_noise, score_noise = np.exp(model.theta[-2:])
    own = step_noise * np.add.reduceat(slopes * slopes, starts) + score_noise
    return Levels(mean, known.variances(rows).numpy() + own, rows, known.covariance)
