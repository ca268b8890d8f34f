"""The labels of the memory that are due, and the ages of those that it holds.

The age of a label is in versions of the model: in gradient steps, for a method that takes them.
"""

import numpy as np

from codetr_ros.config import Settings
from codetr_ros.memory import draws
from codetr_ros.memory.trajectories import Trajectories
from codetr_ros.records import I64


def segments_due(memory: Trajectories, version: int, settings: Settings) -> I64:
    """Segments to be labelled whole by a version of the model, in the order of their ids.

    Segments without a label are always due. With `relabel` 'all', those with a label of another
    version are due too: all of them if `relabel_steps` is 0, else whole ones of at most so many
    steps together, and one at least. The oldest labels come first, among equals the lowest ids.
    """
    ids = memory.segments.all_ids()
    versions = memory.segments.versions(ids)
    new = versions < 0
    if settings.relabel == 'drawn':
        return ids[new]
    stale = ~new & (versions != version)
    if settings.relabel_steps:
        places = np.flatnonzero(stale)
        places = places[np.argsort(versions[places], kind='stable')]
        steps = np.cumsum(memory.segments.lengths(ids[places]))
        enough = np.searchsorted(steps, settings.relabel_steps, side='right')
        stale[places[max(1, int(enough)) :]] = False
    due: I64 = ids[new | stale]
    return due


def steps_due(
    memory: Trajectories, version: int, settings: Settings, phase: int
) -> tuple[I64, I64]:
    """Steps with a label of another version that the updates of a phase will draw.

    Returns:
        The id of each one's segment, and its number within the segment, ordered by both.
    """
    drawn = draws.drawn(settings, phase, memory)
    return memory.labelled.located(drawn[memory.labelled.versions()[drawn] != version])


def metrics(memory: Trajectories, version: int) -> dict[str, float]:
    """How old labels are: the mean over all labelled steps, and the oldest."""
    ages = version - memory.labelled.versions()
    if not len(ages):
        return {}
    return {'label_age_mean': float(ages.sum() / len(ages)), 'label_age_max': float(ages.max())}
