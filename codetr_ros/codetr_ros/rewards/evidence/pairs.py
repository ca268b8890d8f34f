"""Fits a regression to scores and preferences between segments of the memory D."""

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.memory.judgements import Pairs
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import I64
from codetr_ros.rewards.evidence.duels import Duels
from codetr_ros.rewards.evidence.features import Features
from codetr_ros.rewards.evidence.model import Model
from codetr_ros.rewards.evidence.sample import Sampler, chosen
from codetr_ros.seeding import generator


def fit_pairs(
    model: Model,
    features: Features,
    sampler: Sampler,
    memory: Trajectories,
    pairs: Pairs,
    settings: Settings,
    fits: int,
    ordinal: bool,
) -> I64:
    """Fit a model to scores, if there are any, and preferences.

    Args:
        model: to be fitted; its link is linear.
        features: what steps are looked at by; those of other moments are made anew.
        sampler: makes the samples.
        memory: holds the segments.
        pairs: the preferences.
        settings: the run's settings.
        fits: so many there were before.
        ordinal: only the order of scores means anything.

    Returns:
        The ids of the segments that were looked at.

    Raises:
        FloatingPointError: numbers are too large for float64.
    """
    most = settings.evidence.scores
    all_ids = memory.segments.ids()
    ids = chosen(all_ids, most, settings.seed)
    newest = slice(max(0, len(pairs) - most), None)
    first, second = pairs.first[newest], pairs.second[newest]
    seen = np.unique(np.concatenate([ids, first, second]))
    moments = sampler.moments(memory, seen)
    if not fits or features.moments.moved(moments):
        features.renew(moments)
        sampler.forget()
    everything = sampler.sample(memory, seen, steps=False)
    at = [np.searchsorted(seen, each) for each in (ids, first, second)]
    duels = Duels.of(everything, model.link, at[1], at[2], pairs.outcomes[newest])
    rng = generator(settings.seed, 'evidence', 'scales', fits)
    some = np.sort(rng.permutation(len(ids))[: settings.evidence.scale_scores])
    model.measure(memory.segments.scores(all_ids), memory.segments.lengths(all_ids), ordinal)
    model.fit(everything.part(at[0]), some, ordinal, duels)
    return seen
