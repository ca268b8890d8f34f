"""Scores of several scorers in a bag, each on a scale of its own, brought to one.

For bags of runs whose scores came from others than the simulator. A later score of the same scorer
for the same segment has replaced the former; what is left is calibrated as in a run before there
is a model, by the segments that scorers share and by the spread of what they gave.
"""

from array import array
from collections.abc import Iterable
from typing import Protocol

import numpy as np

from codetr_ros.memory.calibration import calibrate


class Scored(Protocol):
    """An episode with scores: of each its first step, steps, value and scorer."""

    firsts: 'array[int]'
    lengths: 'array[int]'
    values: 'array[float]'
    scorers: list[str]


def settle(episodes: Iterable[Scored]) -> None:
    """Give each segment one score, from those of all its scorers.

    Args:
        episodes: of one run, in the order in which they were first scored; changed in place.
    """
    scored = list(episodes)
    rows = [
        (number, first, length, name, value)
        for number, episode in enumerate(scored)
        for first, length, value, name in zip(
            episode.firsts, episode.lengths, episode.values, episode.scorers, strict=True
        )
    ]
    known = [row for row in rows if not np.isnan(row[4])]
    names = list(dict.fromkeys(row[3] for row in known))  # the first one is the reference
    worth = {row[:3]: row[4] for row in known}
    if len(names) > 1:
        places = list(worth)
        index = {place: i for i, place in enumerate(places)}
        scales = calibrate(
            np.array([names.index(row[3]) for row in known]),
            np.array([index[row[:3]] for row in known]),
            np.array([row[4] for row in known]),
            reference=0,
        )
        worth = dict(zip(places, scales.worths.tolist(), strict=True))
    segments = list(dict.fromkeys(row[:3] for row in rows))
    for number, episode in enumerate(scored):
        mine = [place for place in segments if place[0] == number]
        episode.firsts = array('q', [place[1] for place in mine])
        episode.lengths = array('q', [place[2] for place in mine])
        episode.values = array('d', [worth.get(place, np.nan) for place in mine])
        episode.scorers = [''] * len(mine)
