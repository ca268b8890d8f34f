"""The part of a mapping that defines what a score is of."""

from typing import Literal

from pydantic import Field, model_validator

from codetr_ros.robots.message_fields import FieldPath, Timed

Of = Literal['since_last', 'last_steps', 'window', 'last_episode', 'episode']

_BELONGS = {
    'steps': ('last_steps',),
    'seconds': ('window',),
    'begin': ('window',),
    'id': ('episode',),
    'again_within': ('since_last', 'last_steps'),
}
"""Keys that mean something for these values of `of` only."""


class Score(Timed):
    """The score topic."""

    field: FieldPath = Field('data', description='the number that is the score')
    of: Of = Field(
        'since_last',
        description='since_last: of all steps since the last score or the begin of the episode; '
        'last_steps: of the last `steps` steps; window: of the steps of a stretch of time; '
        'last_episode: of the whole episode that ended last; episode: of the whole episode that '
        'the score names by `id` or `stamp`',
    )
    steps: int | None = Field(
        None, ge=1, le=100_000, description='number of steps, for last_steps'
    )
    seconds: float | None = Field(
        None, gt=0, le=86_400, description='length of a window that ends at the time of the score'
    )
    begin: FieldPath | None = Field(
        None, description='field of the score with the time at which its window begins'
    )
    stamp: FieldPath | None = Field(
        None,
        description='field with the time of the score, such as header.stamp; without: the time of '
        'its message',
    )
    id: FieldPath | None = Field(
        None, description='field that names the episode, as `id` of `episode` does'
    )
    late: float | None = Field(
        None,
        ge=0,
        le=1e9,
        description='seconds by which a score may come after the end of what it is of. Without, '
        'no score is too late; but for since_last and last_steps by reception, one that may be of '
        'the episode before is dropped',
    )
    again: Literal['first', 'replace'] = Field(
        'first',
        description='a second score of the same steps; first: it is dropped; replace: it replaces '
        'the one before',
    )
    again_within: float = Field(
        0.0,
        ge=0,
        le=86_400,
        description='seconds after a score within which another one is of the same steps, for '
        'since_last and last_steps',
    )

    @model_validator(mode='after')
    def _complete(self) -> 'Score':
        for key, kinds in _BELONGS.items():
            if self.of not in kinds and getattr(self, key) not in (None, 0.0):
                raise ValueError(
                    f'{key} means nothing if `of` is {self.of}: only for {" and ".join(kinds)}'
                )
        if self.of == 'last_steps' and self.steps is None:
            raise ValueError('steps must be given if `of` is last_steps, and only then')
        if self.of == 'window' and (self.seconds is None) == (self.begin is None):
            raise ValueError('seconds or begin must be given if `of` is window, and not both')
        if self.of == 'episode' and (self.id is None) == (self.stamp is None):
            raise ValueError('id or stamp must be given if `of` is episode, and not both')
        return self

    @property
    def by_arrival(self) -> bool:
        """Whether only the time of its reception decides which episode's steps it is of."""
        return self.of in ('since_last', 'last_steps') and self.stamp is None

    @property
    def timed(self) -> bool:
        """Whether the times of steps decide which of them it is of."""
        return self.of == 'window' or (self.stamp is not None and self.of != 'last_episode')
