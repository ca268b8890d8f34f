"""The part `live` of a mapping: how the robot node drives the robot, and what keeps it safe."""

from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from codetr_ros.config import Group, in_words
from codetr_ros.records import F64
from codetr_ros.robots.message_fields import Topic
from codetr_ros.robots.values import Values

Numbers = float | tuple[float, ...]
"""One value for all components of a command, or one for each."""

HOLD = 'hold'

_TYPE = in_words(
    r'^[a-z]\w*/msg/[A-Z]\w*$', 'the type of a message, such as std_msgs/msg/Float64MultiArray'
)


def expanded(numbers: Numbers, size: int) -> F64:
    """Numbers as an array (size,)."""
    return np.broadcast_to(np.asarray(numbers, np.float64), (size,)).copy()


def _check_order(low: Numbers | None, high: Numbers | None, where: str) -> None:
    if low is None or high is None:
        return
    least, most = np.atleast_1d(low), np.atleast_1d(high)
    if len(least) != len(most) and 1 not in (len(least), len(most)):
        raise ValueError(f'{where}low has {len(least)} values, {where}high has {len(most)}')
    if not (least < most).all():
        raise ValueError(f'{where}low = {low} must be less than {where}high = {high}')


class Command(Group):
    """The robot's command."""

    type: str = Field(pattern=_TYPE, description='type of the command topic')
    kind: Literal['position', 'velocity', 'effort'] = Field(
        description='what a number of the command is; decides what the limits do'
    )
    safe: Literal['hold'] | Numbers = Field(
        description='the safe command: numbers in units of the command (0 stops a robot that is '
        'driven by velocity), or `hold`, the measured positions (a robot driven by position)'
    )
    size: int | None = Field(
        None, ge=1, le=10_000, description='numbers of a command, where no joint and no list of '
        'values shows it'
    )  # fmt: skip


class PositionLimit(Values):
    """Measured positions, one for each number of the command, and how far they may go."""

    low: Numbers = Field(description='lowest position')
    high: Numbers = Field(description='highest position')
    ahead: float = Field(
        0.2,
        gt=0,
        le=60,
        description='seconds for which a velocity must not lead beyond a limit: how long the '
        'robot takes to stop',
    )

    @model_validator(mode='after')
    def _ordered(self) -> 'PositionLimit':
        _check_order(self.low, self.high, '')
        return self


class SpeedLimit(Values):
    """Measured speeds, one for each number of the command."""

    most: Numbers = Field(
        description='largest amount of the speed; beyond it the robot is halted until a person '
        'lets it go on'
    )

    @model_validator(mode='after')
    def _positive(self) -> 'SpeedLimit':
        if not (np.atleast_1d(self.most) > 0).all():
            raise ValueError(f'most = {self.most} must be greater than 0')
        return self


class Limits(Group):
    """What a command must keep to. Each is enforced before the command leaves the node."""

    low: Numbers | None = Field(
        None, description='lowest command, in its own units; without: `low` of the action'
    )
    high: Numbers | None = Field(None, description='highest command')
    change: Numbers | None = Field(
        None,
        description='most by which a command may change in a second: the speed of a robot driven '
        'by position, the acceleration of one driven by velocity',
    )
    position: PositionLimit | None = Field(None, description='measured positions')
    speed: SpeedLimit | None = Field(None, description='measured speeds')

    @model_validator(mode='after')
    def _sound(self) -> 'Limits':
        _check_order(self.low, self.high, '')
        if self.change is not None and not (np.atleast_1d(self.change) > 0).all():
            raise ValueError(f'change = {self.change} must be greater than 0')
        return self


class Watchdog(Group):
    """What must go on, for the robot to be driven by a policy."""

    learner: float = Field(
        10.0, ge=0, le=86_400, description='seconds of silence of the learner after which the '
        'safe command is sent; 0: it may be silent for ever'
    )  # fmt: skip
    heartbeat: Topic | None = Field(
        None, description='a topic, of any type, on which a message must come again and again'
    )
    heartbeat_age: float = Field(
        0.5, gt=0, le=3600, description='seconds after which the last heartbeat is too old'
    )
    late: float = Field(
        5.0, ge=1, le=1000, description='control periods by which a step may be late before the '
        'episode is cut: what happened meanwhile is no step'
    )  # fmt: skip


class EmergencyStop(Group):
    """Who may stop the robot at once, beside the service `stop` of the node."""

    topic: Topic | None = Field(
        None, description='std_msgs/Bool: true stops; a person must resume, also after false'
    )
    age: float | None = Field(
        None, gt=0, le=3600, description='seconds of silence on the topic that stop the robot too'
    )

    @model_validator(mode='after')
    def _topic_with_age(self) -> 'EmergencyStop':
        if self.age is not None and self.topic is None:
            raise ValueError(f'age = {self.age} without a topic: give the topic, or leave it out')
        return self


class Reset(Group):
    """How the robot gets back to its start after an episode."""

    by: Literal['nobody', 'service', 'person'] = Field(
        'nobody',
        description='nobody: it goes on from where it is; service: the robot resets itself when '
        'called; person: someone calls the service `ready` of the node',
    )
    service: Topic | None = Field(None, description='the service of the robot')
    type: Literal['std_srvs/srv/Trigger', 'std_srvs/srv/Empty'] = Field(
        'std_srvs/srv/Trigger', description='type of that service'
    )
    seconds: float = Field(
        60.0, gt=0, le=86_400, description='seconds after which a reset by service is asked for '
        'again; what it lacks is logged'
    )  # fmt: skip
    pause: float = Field(
        0.0, ge=0, le=3600, description='seconds to wait after it, for the robot to be at rest'
    )
    silent: bool = Field(
        True,
        description='whether no command is sent during a reset by service, in which the robot '
        'moves by itself; else the safe command is sent',
    )

    @model_validator(mode='after')
    def _service_where_needed(self) -> 'Reset':
        if (self.by == 'service') != (self.service is not None):
            raise ValueError('service must be given if `by` is service, and only then')
        return self


class Live(Group):
    """How the robot node drives the robot."""

    rate: float = Field(gt=0, le=1000, description='control steps per second')
    episode_steps: int = Field(
        ge=1, le=10**6, description='steps after which an episode is cut off, if not before'
    )
    command: Command
    limits: Limits = Field(default_factory=Limits)
    watchdog: Watchdog = Field(default_factory=Watchdog)
    stop: EmergencyStop = Field(default_factory=EmergencyStop)
    reset: Reset = Field(default_factory=Reset)

    @property
    def period(self) -> float:
        """Seconds of a control step."""
        return 1 / self.rate

    @model_validator(mode='after')
    def _hold_needs_positions(self) -> 'Live':
        if self.command.safe == HOLD:
            if self.command.kind != 'position':
                raise ValueError(
                    f'command.safe = hold with command.kind = {self.command.kind}: only a robot '
                    'driven by position holds by a command of its positions; give numbers'
                )
            if self.limits.position is None:
                raise ValueError(
                    'command.safe = hold needs limits.position, which names the measured positions'
                )
        return self

    def size(self, low: Numbers, high: Numbers, joints: int) -> int:
        """The number of components of a command.

        Args:
            low: what becomes -1.
            high: what becomes 1.
            joints: how many joints the command names; 0: none.
        """
        given = self._sizes(low, high, joints)
        return max(given.values(), default=1)

    def _sizes(self, low: Numbers, high: Numbers, joints: int) -> dict[str, int]:
        """The number of components by the name of what shows it."""
        limits, position, speed = self.limits, self.limits.position, self.limits.speed
        numbers: dict[str, Numbers | None] = {
            'action.low': low,
            'action.high': high,
            'live.command.safe': None if self.command.safe == HOLD else self.command.safe,  # type: ignore[dict-item]
            'live.limits.low': limits.low,
            'live.limits.high': limits.high,
            'live.limits.change': limits.change,
            'live.limits.position.low': position.low if position else None,
            'live.limits.position.high': position.high if position else None,
            'live.limits.speed.most': speed.most if speed else None,
        }
        sizes = {name: len(each) for name, each in numbers.items() if isinstance(each, tuple)}
        if self.command.size is not None:
            sizes['live.command.size'] = self.command.size
        if joints:
            sizes['action.joints'] = joints
        return sizes

    def check(self, low: Numbers, high: Numbers, joints: int) -> None:
        """Refuse numbers that are not of one command.

        Raises:
            ValueError: sizes differ, or a limit lies outside what -1 and 1 become.
        """
        sizes = self._sizes(low, high, joints)
        if len(set(sizes.values())) > 1:
            shown = ', '.join(f'{name} has {n}' for name, n in sizes.items())
            raise ValueError(
                f'a command has one number of components, but {shown}: give each as many values, '
                'or one value for all'
            )
        size = self.size(low, high, joints)
        least, most = expanded(low, size), expanded(high, size)
        for name, given in (('low', self.limits.low), ('high', self.limits.high)):
            if given is not None:
                limit = expanded(given, size)
                if not ((limit >= least) & (limit <= most)).all():
                    raise ValueError(
                        f'live.limits.{name} = {given} lies outside action.low = {low} to '
                        f'action.high = {high}, which no command leaves: make it narrower'
                    )
