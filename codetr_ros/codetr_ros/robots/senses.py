"""What a robot observes: the newest values of its topics, and whether they are young enough.

Shared by all who act on a robot, learning or not. Messages may be of rclpy or of a bag.
"""

from collections import Counter
from typing import Any

import numpy as np

from codetr_ros.records import F32, F64
from codetr_ros.robots.errors import MessageError
from codetr_ros.robots.mapping import Mapping
from codetr_ros.robots.message_fields import NS, moment
from codetr_ros.robots.values import Values, joint_names, names_a_joint_twice, numbers

NO_JOINTS = 'messages without all of the joints'
JOINT_TWICE = 'messages that name one of the joints twice'
NOT_FINITE = 'messages with numbers that are not finite'
OTHER_SIZE = 'messages with another number of values than before'
UNREADABLE = 'messages without the fields of the mapping'
AHEAD = 'messages stamped later than they came'
A_DAY = 86_400.0  # [s]
OTHER_CLOCK = ' (its stamps are of another clock: set use_sim_time, or `time: log` in the mapping)'


class Senses:
    """Holds the newest values of each topic that a mapping names, with their times.

    Times are in seconds of one clock: that of reception, or where the mapping has `time: header`
    that of the stamps, which must then be the same clock.

    Args:
        rules: the mapping; its part `live` must be there.
    """

    def __init__(self, rules: Mapping) -> None:
        live = rules.live
        assert live is not None
        self._rules = rules
        self._stamped = rules.stamped
        limits = live.limits
        self._position, self._speed = limits.position, limits.speed
        wanted = [*rules.observation, self._position, self._speed]
        self._wanted: list[Values] = [values for values in wanted if values is not None]
        self._held: dict[int, tuple[float, F64]] = {}
        self._size = 0
        self.counts: Counter[str] = Counter()  # of messages that could not be used
        self.fault = ''  # why the newest of these could not be read

    @property
    def topics(self) -> set[str]:
        """Full names of the topics that must be received."""
        return {values.topic for values in self._wanted}

    def forget(self) -> None:
        """Hold no value: the clock was set back, and everything held is of later than now."""
        self._held.clear()

    def take(self, topic: str, message: Any, now: float) -> None:
        """Take a message that was received now [s]."""
        try:
            at = moment(message, 'header.stamp', topic) / NS if topic in self._stamped else now
            for i, values in enumerate(self._wanted):
                if values.topic == topic:
                    self._hold(i, values, message, at)
        except MessageError as error:
            self.unreadable(error)
            return
        if at > now + self._rules.sampling.max_age:
            self.counts[AHEAD] += 1

    def unreadable(self, error: MessageError) -> None:
        """Count a message that is not as the mapping has it."""
        self.counts[UNREADABLE] += 1
        self.fault = str(error)

    def _hold(self, place: int, values: Values, message: Any, at: float) -> None:
        array = numbers(message, values)
        before = self._held.get(place)
        if array is None:
            self._without_joints(message, values)
        elif not (np.abs(array) <= np.finfo(np.float32).max).all():
            self.counts[NOT_FINITE] += 1
        elif before is not None and len(before[1]) != len(array):
            self.counts[OTHER_SIZE] += 1
        elif before is None or at >= before[0]:  # one that comes late is older
            self._held[place] = (at, array)

    def _without_joints(self, message: Any, values: Values) -> None:
        """Count a message without one value for each joint; of what it has, the last is kept."""
        twice = names_a_joint_twice(message, values)
        self.counts[JOINT_TWICE if twice else NO_JOINTS] += 1
        there = ', '.join(joint_names(message, values.topic)) or 'none'
        wanted, fields = ', '.join(values.joints or ()), ', '.join(values.fields)
        self.fault = (
            f'{values.topic} names the joints {there}, and the mapping wants {fields} of {wanted}'
        )

    def lacking(self) -> list[str]:
        """Topics from which nothing was received yet."""
        lacks = {v.topic for i, v in enumerate(self._wanted) if i not in self._held}
        return sorted(lacks)

    def old(self, now: float) -> list[str]:
        """Topics whose newest values are older than `max_age`, and how old they are, in words."""
        most = self._rules.sampling.max_age
        ages = {
            values.topic: now - self._held[i][0]
            for i, values in enumerate(self._wanted)
            if i in self._held
        }
        found = [
            f'{topic} is {age:.2f} s old' + (OTHER_CLOCK if age > A_DAY else '')
            for topic, age in ages.items()
            if age > most
        ]
        return [*(f'{topic} has brought nothing' for topic in self.lacking()), *found]

    def observe(self, now: float) -> F32 | None:
        """The observation (O,) that holds now; None where a part is missing or too old."""
        if self.old(now):
            return None
        parts = [self._held[i][1] for i in range(len(self._rules.observation))]
        return np.concatenate(parts).astype(np.float32)

    @property
    def size(self) -> int:
        """O, once something was received from every topic; 0 before."""
        if not self._size and not self.lacking():
            self._size = sum(self.sizes())
        return self._size

    def sizes(self) -> tuple[int, ...]:
        """The numbers of each entry of the observation, once something was received from all."""
        return tuple(len(self._held[i][1]) for i in range(len(self._rules.observation)))

    def positions(self) -> F64 | None:
        """The measured positions that were received last; None where the mapping has none."""
        return self._newest(self._position)

    def too_fast(self) -> str | None:
        """Which measured speed is beyond its limit, in words; None if none is."""
        speeds = self._newest(self._speed)
        if speeds is None or self._speed is None:
            return None
        most = np.broadcast_to(np.asarray(self._speed.most, np.float64), speeds.shape)
        beyond = np.flatnonzero(np.abs(speeds) > most)
        if not len(beyond):
            return None
        i = int(beyond[0])
        names = self._speed.joints
        who = names[i] if names else f'number {i}'
        return f'{who} moves at {speeds[i]:.3g}, its limit is {most[i]:g}'

    def _newest(self, values: Values | None) -> F64 | None:
        if values is None:
            return None
        held = self._held.get(self._wanted.index(values))
        return None if held is None else held[1]
