"""Who scores segments; the settings of simulated people, who do it as people do.

What they do: docs/people.md#simulated-people.
"""

from typing import TYPE_CHECKING

from pydantic import Field, model_validator

from codetr_ros.config.base import Group
from codetr_ros.config.cuts import Cuts


class PeopleSettings(Group):
    """Simulated people: each has a scale of their own, is late, leaves out some and errs."""

    count: int = Field(1, ge=1, le=26, description='simulated people')
    points: int = Field(
        5,
        ge=0,
        le=100,
        description='points of their scales, 2 or more, even from a poor to a perfect '
        'segment; each after the first has one point more, and counts from another number. 0: '
        'scores are numbers, each on a scale with an offset and a slope of its own',
    )
    best: float | None = Field(
        None,
        ge=-1e9,
        le=1e9,
        description='score of a perfect segment of full length, where their scales end; if not '
        'given, that of r_max at every step',
    )
    skipped: float = Field(
        0.2, ge=0, lt=1, description='share of segments that they are asked for and do not answer'
    )
    wrong: float = Field(
        0.1, ge=0, lt=1, description='share of judgements that have nothing to do with the segment'
    )
    late: int = Field(
        200,
        ge=0,
        le=10**6,
        description='environment steps of the run that pass until a judgement is given',
    )
    shared: float = Field(
        0.25,
        ge=0,
        le=1,
        description='share of segments that all of them are asked for; each other one goes to one',
    )
    preferences: float = Field(
        0.0,
        ge=0,
        le=1,
        description='share of judgements that state which of two segments is better, not a score',
    )
    judgements: int = Field(
        0,
        ge=0,
        le=10**9,
        description='judgements of all of them together, after which they are silent; 0: no limit',
    )

    @model_validator(mode='after')
    def _a_scale_has_two_points(self) -> 'PeopleSettings':
        if self.points == 1:
            raise ValueError(
                'people.points=1: a scale of one point states nothing of a segment; set 2 or '
                'more, or 0 for scores that are numbers'
            )
        return self


class Scored:
    """What follows from who scores, mixed into the settings of a run."""

    if TYPE_CHECKING:  # fields of `Settings`; with annotations at run time they would come first
        score_missing: float
        delay: int | str
        seed: int
        phase_steps: int

        @property
        def scorer(self) -> str:
            """Who scores segments."""

        @property
        def ahead(self) -> int:
            """Phases by which a source may be ahead of the newest that was learnt from."""

    @property
    def scored_elsewhere(self) -> bool:
        """Whether scores come from another than the simulator: late, several for a segment, or
        none.
        """
        return self.scorer != 'simulator'

    @property
    def cuts(self) -> Cuts:
        """Where episodes are cut into segments."""
        return Cuts(self.delay, self.seed)

    @property
    def may_lack_scores(self) -> bool:
        """Whether a segment may have no score, which NaN states."""
        return self.score_missing > 0 or self.scored_elsewhere

    @property
    def judgements_ahead(self) -> int:
        """The most judgements that a scorer may have given and no commit has named yet."""
        return (self.ahead + 1) * self.phase_steps
