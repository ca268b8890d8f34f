"""The scales on which simulated people score segments.

All of them agree on which segment is better; each puts it into numbers of its own. The scales span
what there is between a poor segment (the median of those of the random policy) and a perfect one.

The formulas: docs/people.md#simulated-people.
"""

from dataclasses import dataclass

import numpy as np

from codetr_ros.config import Settings, SettingsError
from codetr_ros.simulation.composite import composite
from codetr_ros.simulation.scorer import random_scores
from codetr_ros.simulation.tasks import find, r_max

NOTICEABLE = 0.05
"""Share of the span below which two segments are as good to a person."""


@dataclass(frozen=True)
class Scale:
    """How one person puts the worth of a segment into a number."""

    poor: float
    """Score of a segment that gets the lowest point."""
    best: float
    """Score of a segment that gets the highest one."""
    points: int
    """Number of points; 0: any number."""
    lowest: float
    """The lowest point; where any number is given, that of a poor segment."""
    span: float
    """From the lowest to the highest point."""

    def score(self, worth: float) -> float:
        """The number that is given for a segment of this score."""
        share = (worth - self.poor) / (self.best - self.poor)
        if not self.points:
            return self.lowest + self.span * share
        step = np.clip(np.floor(share * self.points), 0, self.points - 1)
        return self.lowest + float(step) * self.span / (self.points - 1)

    def any(self, rng: np.random.Generator) -> float:
        """A number that has nothing to do with the segment."""
        if not self.points:
            return self.lowest + self.span * float(rng.random())
        step = int(rng.integers(self.points))
        return self.lowest + step * self.span / (self.points - 1)

    @property
    def just_noticeable(self) -> float:
        """Difference of scores below which two segments are as good."""
        return NOTICEABLE * abs(self.best - self.poor)


def scales(settings: Settings) -> list[Scale]:
    """One for each of the simulated people.

    Raises:
        TaskError: the task is unknown or cannot be used.
        SettingsError: a perfect segment is no better than those of the random policy.
    """
    people = settings.people
    poor = float(np.median(random_scores(settings)))
    best = people.best
    if best is None:
        task = find(settings.task)
        n = settings.within(task.horizon).longest
        perfect = np.full(n, r_max(settings, task), np.float64)
        best = composite(settings.composite, perfect, settings.beta, n)
    if best <= poor:
        raise SettingsError(
            f'people.best = {best:g}: the median segment of the random policy has {poor:g}, so '
            'that the scale of people has no length; set people.best to the score of a perfect '
            'segment'
        )
    made = []
    for i in range(people.count):
        if people.points:
            points = people.points + i
            made.append(Scale(poor, best, points, 1.0 - i, points - 1.0))
        else:
            made.append(Scale(poor, best, 0, 10.0 * i, 1.0 + 2.0 * i))
    return made
