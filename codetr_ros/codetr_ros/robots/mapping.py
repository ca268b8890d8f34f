"""The mapping file: defines the topics of observation, action and score of a robot.

`codetr convert` and the robot node read the same file; its part `live` is for the node alone.
"""

from collections.abc import Mapping as AnyMapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, model_validator

from codetr_ros.config import Group, SettingsError, in_words, validate
from codetr_ros.robots.live import Live
from codetr_ros.robots.message_fields import Clock, FieldPath, Timed, Topic, field
from codetr_ros.robots.score_rules import Score
from codetr_ros.robots.values import Values
from codetr_ros.system.parsing import ParseError, read_yaml


class Action(Values):
    """The command topic."""

    low: float | tuple[float, ...] = Field(
        -1.0, description='command that becomes -1; one value for all components, or one for each'
    )
    high: float | tuple[float, ...] = Field(1.0, description='command that becomes 1')

    @model_validator(mode='after')
    def _ordered(self) -> 'Action':
        low, high = np.atleast_1d(self.low), np.atleast_1d(self.high)
        if len(low) != len(high) and 1 not in (len(low), len(high)):
            raise ValueError(f'low has {len(low)} values, high has {len(high)}')
        if not (low < high).all():
            raise ValueError(f'low = {self.low} must be less than high = {self.high}')
        return self


class Episodes(Group):
    """The ends of episodes."""

    topic: Topic | None = Field(None, description='a message on it ends the episode')
    time: Clock | None = Field(None, description='as with the other topics')
    field: FieldPath | None = Field(None, description='only where this field ...')
    equals: bool | int | float | str | None = Field(None, description='... has this value')
    terminal: bool = Field(
        False,
        description='whether such an end is a terminal state, not merely the end of the recording',
    )
    gap: float = Field(
        1.0, gt=0, le=86_400, description='seconds without a command, which end the episode too'
    )
    id: FieldPath | None = Field(
        None, description='field that names the episode, for scores that name it'
    )
    id_is_of: Literal['ended', 'next'] = Field(
        'ended',
        description='whether the message names the episode that it ends, or the one that begins',
    )

    def ends(self, message: Any) -> bool:
        """Whether a message on the topic ends the episode.

        Raises:
            MessageError: it lacks the field.
        """
        if self.field is None:
            return True
        assert self.topic is not None
        return bool(field(message, self.field, self.topic) == self.equals)

    @model_validator(mode='after')
    def _field_and_value(self) -> 'Episodes':
        if (self.field is None) != (self.equals is None):
            raise ValueError('field and equals belong together: both are needed, or neither')
        if self.field is not None and self.topic is None:
            raise ValueError('field without a topic')
        if self.id is not None and self.topic is None:
            raise ValueError('id without a topic')
        return self


class Sampling(Group):
    """The times of steps."""

    by: Literal['command', 'rate'] = Field(
        'command', description='command: a step for each command; rate: at a fixed rate'
    )
    rate: float | None = Field(None, gt=0, le=10_000, description='steps per second, for rate')
    max_age: float = Field(
        0.2, gt=0, le=3600, description='seconds after which an observation is too old to be held'
    )

    @model_validator(mode='after')
    def _rate_where_needed(self) -> 'Sampling':
        if (self.by == 'rate') != (self.rate is not None):
            raise ValueError('rate must be given if `by` is rate, and only then')
        return self


class Mapping(Group):
    """A mapping file."""

    source: str = Field(
        'robot',
        pattern=in_words(r'^[A-Za-z_]\w*$', 'a name of letters, digits and _'),
        description='name of the robot',
    )
    time: Clock = Field(
        'log',
        description='the time of a message. log: when it was received; header: what its own '
        'header states',
    )
    observation: tuple[Values, ...] = Field(
        min_length=1, description='topics, one after the other'
    )
    action: Action
    score: Score | None = Field(
        None, description='`codetr convert` needs it; live, others may score the segments'
    )
    episode: Episodes = Field(default_factory=Episodes)
    sampling: Sampling = Field(default_factory=Sampling)
    live: Live | None = Field(None, description='what the robot node needs beyond the topics')

    @model_validator(mode='after')
    def _scores_find_episodes(self) -> 'Mapping':
        if self.score is None:
            return self
        if self.score.id is not None and self.episode.id is None:
            raise ValueError(
                'score.id names an episode, but episodes have no names: give episode.id, the '
                'field of the episode topic with the same name or number'
            )
        by_rate = self.sampling.by == 'rate' and self.episode.topic is None
        if self.score.of == 'last_episode' and by_rate:
            raise ValueError(
                'score.of is last_episode, and sampling.by is rate: an episode then goes on for '
                'episode.gap seconds after its last command. Give episode.topic'
            )
        return self

    @property
    def topics(self) -> set[str]:
        """All topics of the mapping."""
        return {topic for topic, _ in self._clocks()}

    @property
    def stamped(self) -> set[str]:
        """The topics whose messages have the time of their header."""
        return {topic for topic, clock in self._clocks() if clock == 'header'}

    def _clocks(self) -> list[tuple[str, Clock]]:
        parts: tuple[Timed | Episodes, ...]
        parts = (*self.observation, self.action, self.episode)
        if self.score is not None:
            parts = (*parts, self.score)
        return [(part.topic, part.time or self.time) for part in parts if part.topic]

    @model_validator(mode='after')
    def _one_clock_for_each_topic(self) -> 'Mapping':
        clocks = dict(self._clocks())
        for topic, clock in self._clocks():
            if clock != clocks[topic]:
                raise ValueError(f'{topic} has two times, log and header: a topic has one')
        return self

    @model_validator(mode='after')
    def _live_commands_have_one_size(self) -> 'Mapping':
        if self.live is not None:
            self.live.check(self.action.low, self.action.high, len(self.action.joints or ()))
        return self


def load(path: Path) -> Mapping:
    """Read a mapping file.

    Raises:
        SettingsError: it cannot be read, is not YAML, or has a wrong key or value.
    """
    try:
        data = read_yaml(path)
    except OSError as error:
        raise SettingsError(f'mapping {path} cannot be read: {error.strerror}') from None
    except ParseError as error:
        raise SettingsError(f'mapping {path} {error}') from None
    if not isinstance(data, AnyMapping):
        raise SettingsError(f'mapping {path} must hold a mapping, not {type(data).__name__}')
    return validate(Mapping, data, f'mapping {path}')
