"""What else came of a task: curves of other methods, recorded before, to be shown beside a run's.

A file in `recorded/` states which settings it is of, and a run that has the same ones is shown
beside it: what the scores are worth to an agent that spreads them evenly, or takes them as they
are. `benchmarks/default_task.py` makes the file of the default task.
"""

from functools import cache
from importlib import resources
from typing import Any

from pydantic import BaseModel, ConfigDict

from codetr_ros.config import Settings
from codetr_ros.system import parsing


class Curve(BaseModel):
    """Evaluations of one method: mean, lowest and highest seed at each step."""

    model_config = ConfigDict(extra='forbid', frozen=True)

    label: str
    seeds: int
    steps: list[int]
    mean: list[float]
    low: list[float]
    high: list[float]

    def at(self, step: int) -> float | None:
        """The mean true return after so many steps; None where it was not evaluated."""
        return dict(zip(self.steps, self.mean, strict=True)).get(step)


class References(BaseModel):
    """Curves of other methods with a run's own task, scores and learner."""

    model_config = ConfigDict(extra='forbid', frozen=True)

    settings: dict[str, Any]
    commit: str
    curves: list[Curve]

    def fits(self, settings: dict[str, Any]) -> bool:
        """Whether a run of these settings can be compared with the curves."""
        return all(settings.get(name) == value for name, value in self.settings.items())

    def beside(self, step: int) -> str:
        """The others after so many steps, in a few words; empty where none was evaluated."""
        there = [(curve, curve.at(step)) for curve in self.curves]
        return ', '.join(f'{c.label} {value:.1f}' for c, value in there if value is not None)


def of(settings: Settings | dict[str, Any]) -> References | None:
    """The recorded curves that a run can be compared with; None if there are none.

    Args:
        settings: the run's, or as its summary has them.
    """
    own = settings if isinstance(settings, dict) else settings.model_dump(mode='json')
    return next((one for one in _all() if one.fits(own)), None)


@cache
def _all() -> tuple[References, ...]:
    files = sorted(resources.files(f'{__package__}.recorded').iterdir(), key=lambda f: f.name)
    return tuple(
        References.model_validate(parsing.parse_json(one.read_text()))
        for one in files
        if one.name.endswith('.json')
    )
