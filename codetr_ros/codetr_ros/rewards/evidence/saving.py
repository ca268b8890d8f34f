"""A fitted regression as tensors, and again as a regression."""

from collections.abc import Mapping, Sequence

import numpy as np
import torch
from torch import Tensor

from codetr_ros.rewards.evidence import links
from codetr_ros.rewards.evidence.maxima import SoftMax
from codetr_ros.rewards.evidence.model import Model
from codetr_ros.rewards.evidence.regression import Posterior
from codetr_ros.rewards.evidence.verdicts import MOST_VALUES, Verdicts


def saved(model: Model) -> dict[str, Tensor]:
    """Link, scales and posterior of a regression, in copies."""
    soft = model.link if isinstance(model.link, SoftMax) else None
    numbers = {
        'scale': model.scale,
        'evidence': model.evidence,
        'left_out_r2': model.left_out_r2,
        'beta_first': soft.first if soft else 0.0,
        'beta_log_ratio': soft.log_ratio if soft else 0.0,
        'verdict_noise': 0.0,
        'verdict_spread': 0.0,
        'zero': model.zero,
    }
    counts = {
        'link': links.NAMES.index(model.link.name),
        'beta_learnt': int(soft is not None and soft.learnt),
        'fitted': int(model.fitted),
        'verdict_values': 0,
    }
    verdicts = model.verdicts
    scale = torch.zeros(2, MOST_VALUES, dtype=torch.float64)
    if verdicts is not None:
        count = len(verdicts.values)
        counts['verdict_values'] = count
        numbers['verdict_noise'], numbers['verdict_spread'] = verdicts.tau, verdicts.spread
        scale[0, :count] = torch.tensor(verdicts.values)
        scale[1, : count - 1] = torch.tensor(verdicts.thresholds)
    return {
        'verdict_scale': scale,
        **{name: torch.tensor(n, dtype=torch.float64) for name, n in numbers.items()},
        **{name: torch.tensor(n, dtype=torch.int64) for name, n in counts.items()},
        'theta': torch.tensor(model.theta),
        'weights': model.posterior.mean.clone(),
        'covariance': model.posterior.covariance.clone(),
    }


def restored(
    state: Mapping[str, Tensor], blocks: Sequence[slice], beta: float, delay: int
) -> Model:
    """The regression that `saved` made these tensors of.

    Args:
        state: of the names and shapes of `saved`.
        blocks: of the features.
        beta: as for `links.make`.
        delay: as for `links.make`.

    Raises:
        ValueError: it names a link that there is none of, or an ordinal scale of no such size.
    """
    number = int(state['link'])
    if not 0 <= number < len(links.NAMES):
        raise ValueError(
            f'link = {number}: links have numbers 0 to {len(links.NAMES) - 1}, '
            f'{", ".join(links.NAMES)}'
        )
    link = links.make(links.NAMES[number], beta, delay)
    if isinstance(link, SoftMax):
        link.first = float(state['beta_first'])
        link.log_ratio = float(state['beta_log_ratio'])
        link.learnt = bool(state['beta_learnt'])
    model = Model(link, blocks)
    model.scale = float(state['scale'])
    model.evidence = float(state['evidence'])
    model.left_out_r2 = float(state['left_out_r2'])
    model.fitted = bool(state['fitted'])
    model.zero = float(state['zero'])
    count = int(state['verdict_values'])
    if not 0 <= count <= MOST_VALUES:
        raise ValueError(f'verdict_values = {count}: an ordinal scale has 2 to {MOST_VALUES}')
    link.ordinal = count > 0
    if count:
        values, thresholds = state['verdict_scale'].numpy()
        model.verdicts = Verdicts(
            values[:count].copy(),
            thresholds[: count - 1].copy(),
            float(state['verdict_noise']),
            float(state['verdict_spread']),
        )
    model.theta = np.array(state['theta'].numpy())
    model.posterior = Posterior(state['weights'].clone(), state['covariance'].clone())
    return model
