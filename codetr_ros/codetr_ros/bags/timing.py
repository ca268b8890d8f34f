"""The time of a message: when it was received, or what its own header states."""

import struct
from collections import Counter
from collections.abc import Callable, Collection
from typing import Any, NamedTuple

from codetr_ros.bags.errors import BagError
from codetr_ros.bags.raw import Channel, RawMessage
from codetr_ros.bags.schemas import UNREADABLE, types_of
from codetr_ros.records.names import full_name

_HEADER = 'std_msgs/msg/Header'
_MOST_APART = 10 * 10**9  # [ns] between a header and its receipt, if one clock gives both
_SHOWS_DATE = 86_400 * 10**9  # [ns] after its first day a clock does not show 0 by itself


class Selection(NamedTuple):
    """Which messages are read, and by which time.

    An empty selection is of all messages, by when they were received.
    """

    topics: frozenset[str]  # full names
    types: frozenset[str]
    stamped: frozenset[str]  # topics whose messages have the time of their header

    @classmethod
    def of(
        cls, topics: Collection[str], types: Collection[str], stamped: Collection[str]
    ) -> 'Selection':
        """A selection of topics with or without their leading slash."""
        names = frozenset(full_name(topic) for topic in topics)
        return cls(names, frozenset(types), frozenset(full_name(topic) for topic in stamped))

    def has(self, channel: Channel) -> bool:
        """Whether a channel is selected."""
        if not self.topics and not self.types:
            return True
        return full_name(channel.topic) in self.topics or channel.type in self.types


class Timing:
    """Gives selected messages their times.

    Args:
        selection: of messages.
        unpack: unpacks a compressed message; None where that fails.

    Attributes:
        unset: messages without a time in their header, by topic; they are left out.
    """

    def __init__(
        self, selection: Selection, unpack: Callable[[RawMessage], RawMessage | None]
    ) -> None:
        self.unset: Counter[str] = Counter()
        self._stamps: Counter[str] = Counter()
        self._apart: Counter[str] = Counter()
        self._selection = selection
        self._unpack = unpack
        self._channels: dict[int, tuple[Channel, bool, bool]] = {}  # by identity

    def __call__(self, packed: RawMessage) -> tuple[int, RawMessage] | None:
        """The time of a message [ns], and the message, unpacked; None if it is left out.

        Raises:
            BagError: it has no header, or is damaged.
        """
        channel = packed.channel
        known = self._channels.get(id(channel))
        if known is None:
            stamped = full_name(channel.topic) in self._selection.stamped
            known = self._channels[id(channel)] = channel, self._selection.has(channel), stamped
        _, has, stamped = known
        raw = self._unpack(packed) if has else None
        if raw is None:
            return None
        if not stamped:
            return raw.log_time, raw
        time = _stamp(raw)
        if time < 0 or (time == 0 and raw.log_time > _SHOWS_DATE):
            self.unset[full_name(channel.topic)] += 1
            return None
        self._stamps[channel.topic] += 1
        self._apart[channel.topic] += abs(time - raw.log_time) > _MOST_APART
        return time, raw

    def check_clocks(self) -> None:
        """Compare the clocks by which messages are ordered, after all of them.

        Raises:
            BagError: headers have another clock than the log, and some topics are ordered by one,
                some by the other.
        """
        others = sorted(self._selection.topics - self._selection.stamped)
        for topic, count in self._apart.items():
            if others and 2 * count > self._stamps[topic]:
                raise BagError(
                    f'the times in the headers of {topic} are more than '
                    f'{_MOST_APART // 10**9} s from when they were received: the clocks differ, '
                    f'so {", ".join(others)} cannot be ordered with it by log time. Give all of '
                    'them the same time: log, or header'
                )


def _stamp(raw: RawMessage) -> int:
    """The time in a message's header [ns]."""
    channel = raw.channel
    fields = types_of(channel.type, channel.definition).fielddefs[channel.type][1]
    kinds: dict[str, Any] = {name: node[1] for name, node in fields}
    if kinds.get('header') != _HEADER:
        raise BagError(
            f'{raw.place}: {channel.topic} ({channel.type}) has no header, so no time of its own: '
            'take its log time instead (`time: log` for this topic)'
        )
    try:
        if fields[0][0] == 'header':
            seconds, rest = struct.unpack_from('<iI' if raw.data[1] & 1 else '>iI', raw.data, 4)
        else:
            types = types_of(channel.type, channel.definition)
            message: Any = types.deserialize_cdr(raw.data, channel.type)
            seconds, rest = message.header.stamp.sec, message.header.stamp.nanosec
    except (*UNREADABLE, struct.error) as error:
        raise BagError(f'{raw.place}: {channel.topic} cannot be decoded: {error}') from error
    return int(seconds) * 10**9 + int(rest)
