"""Finds where the clock of a recording went back, from the times of its messages in file order.

The order of a file is not the order of time: recorders write topic by topic, or from several
threads. But each topic by itself is written about as it was received. So where a topic falls
behind its own earlier messages, and others follow it there, the clock went back: a simulation was
reset, or the clock was set. Messages that come late one by one are merely out of order.

The limits are choices of this project, made for recordings at 1 to 1000 messages per second.
"""

from collections import deque
from dataclasses import dataclass, field, replace

from codetr_ros.bags.errors import BagError, Place

TOLERANCE = 100_000_000
"""[ns] by which a topic may fall behind itself and be merely out of order."""
_SURE = 1_000_000_000  # [ns] beyond which one more message as far behind is proof enough
_WITNESSES = 5  # messages in a row that must be behind where the fall is shorter
_OPPOSED = 10  # falls from one time that other topics do not follow: more, and nothing is sure
_OVERTAKEN = 5  # messages of its own that a topic must fall behind where the fall is shorter
_MOST_DOUBTED = 1000  # messages in which no topic of before comes again
_LONGEST_TAIL = 100  # messages between the time that the clock went back and the fall of a topic
_MOST_CUTS = 10_000  # places where the clock may have gone back; each one costs memory


@dataclass(slots=True)
class Span:
    """The times of a topic within a period [ns]."""

    high: int  # the latest
    recent: 'deque[int]'  # the last few that were later than all before


@dataclass(slots=True)
class Fall:
    """A topic that fell behind itself."""

    topic: str
    high: int  # [ns] the latest time of the topic before
    to: int  # [ns]
    place: Place

    def __str__(self) -> str:
        return f'at {self.place}, {self.topic} goes back from {self.high} to {self.to} ns'


@dataclass(slots=True)
class Period:
    """Messages of one file between two times that the clock went back."""

    block: int  # the first of its blocks
    fall: Fall | None = None  # what it begins with; None at the file's begin
    spans: dict[str, Span] = field(default_factory=dict)  # by topic
    start: int = 0  # [ns] the earliest time
    end: int = 0  # [ns] the latest
    late: int = 0  # messages that lie behind a later one
    lateness: int = 0  # [ns] the most that one lies behind

    def take(self, topic: str, time: int) -> None:
        """Include a message, in file order."""
        if not self.spans:
            self.start = self.end = time
        if time < self.end:
            self.late += 1
            self.lateness = max(self.lateness, self.end - time)
            self.start = min(self.start, time)
        self.end = max(self.end, time)
        span = self.spans.get(topic)
        if span is None:
            span = self.spans[topic] = Span(time, deque(maxlen=2 * _OVERTAKEN))
        if time >= span.high:
            span.high = time
            span.recent.append(time)

    def join(self, other: 'Period') -> None:
        """Include a period of the file that follows, which is of the same run of the clock."""
        self.late += other.late
        self.lateness = max(self.lateness, other.lateness, self.end - other.start)
        self.start, self.end = min(self.start, other.start), max(self.end, other.end)
        for topic, new in other.spans.items():
            if topic in self.spans:
                self.spans[topic].high = max(self.spans[topic].high, new.high)
                self.spans[topic].recent.extend(new.recent)
            else:
                self.spans[topic] = replace(new, recent=new.recent.copy())

    def copy(self) -> 'Period':
        """An own copy of it."""
        spans = {topic: replace(s, recent=s.recent.copy()) for topic, s in self.spans.items()}
        return replace(self, spans=spans)


@dataclass(slots=True)
class _Tail:
    """The last messages of a period, all behind those before them."""

    block: int  # that begins with them
    before: Period | None  # without them; None where they cannot begin a period
    messages: list[tuple[str, int]] = field(default_factory=list)

    @property
    def latest(self) -> int:
        """The latest time of them [ns]."""
        return max(time for _, time in self.messages)


class Clock:
    """Follows the times of one file's messages.

    Args:
        before: the period that came before, in another file.

    Attributes:
        periods: of the file, in its order.
    """

    def __init__(self, before: Period | None = None) -> None:
        self.periods: list[Period] = [before or Period(0)]
        self._doubted: list[tuple[str, int]] = []  # messages since a fall, until others follow it
        self._witnesses = 0
        self._tail: _Tail | None = None
        self._falls = self._cuts = 0
        self._opposed: dict[str, tuple[int, int]] = {}  # falls alone: from which time, how many

    def take(self, topic: str, time: int, place: Place, block: int) -> bool:
        """Include a message, in file order.

        Args:
            topic: its topic.
            time: its time [ns].
            place: where it lies.
            block: number of the block that begins with it, if one does.

        Returns:
            Whether a block must begin with it, since the clock may have gone back here.

        Raises:
            BagError: topics contradict each other, or go back too often.
        """
        if self._doubted:
            self._weigh(topic, time)
        period = self.periods[-1]
        span = period.spans.get(topic)
        if span is not None and time >= period.end and not self._doubted:  # as nearly always
            period.end = span.high = time
            span.recent.append(time)
            self._tail = None
            return False
        cut, fell = False, span is not None and self._falls_behind(span, time)
        if fell:
            assert span is not None
            cut = self._begin(Fall(topic, span.high, time, place), block)
        elif time < period.end - TOLERANCE and period.spans:
            cut = self._late(topic, time, block)
        else:
            self._tail = None
        if fell or self._doubted:
            self._doubted.append((topic, time))
        self.periods[-1].take(topic, time)
        return cut

    @staticmethod
    def _falls_behind(span: Span, time: int) -> bool:
        behind = span.high - time
        if behind <= TOLERANCE:
            return False
        return behind > _SURE or sum(one > time for one in span.recent) >= _OVERTAKEN

    def _late(self, topic: str, time: int, block: int) -> bool:
        """Note a message that lies behind others, though not behind its own topic: a topic that
        comes rarely may be the first after the clock went back. Returns whether a block begins.
        """
        if self._tail is None:
            self._cuts += 1
            before = self.periods[-1].copy() if self._cuts <= _MOST_CUTS else None
            self._tail = _Tail(block, before)
        tail = self._tail
        if len(tail.messages) < _LONGEST_TAIL:
            tail.messages.append((topic, time))
        else:
            tail.before = None
        return tail.before is not None and tail.block == block

    def _begin(self, fall: Fall, block: int) -> bool:
        """Begin a period that is doubted as yet; returns whether a block must begin here, too."""
        self._falls += 1
        high, times = self._opposed.get(fall.topic, (0, 0))
        if high == fall.high and times >= (1 if high - fall.to > _SURE else _OPPOSED):
            raise BagError(
                f'{fall} and stays behind, while other topics go on: either their clocks differ, '
                'or the file is in no order at all. Write it in the order of receipt first'
            )
        if self._falls > _MOST_CUTS:
            raise BagError(
                f'{fall}, and such happens more than {_MOST_CUTS} times: the messages cannot be '
                'brought into an order of time. Write them in the order of receipt first'
            )
        tail, self._tail, self._doubted, self._witnesses = self._tail, None, [], 0
        period = Period(block, fall)
        if tail is not None and tail.before is not None and tail.latest <= fall.to + TOLERANCE:
            self.periods[-1] = tail.before
            period.block = tail.block
            for message in tail.messages:
                period.take(*message)
            self._doubted = tail.messages
        self.periods.append(period)
        return period.block == block

    def _weigh(self, topic: str, time: int) -> None:
        """Decide by the messages that follow whether the clock went back."""
        before, fall = self.periods[-2], self.periods[-1].fall
        assert fall is not None
        span = before.spans.get(topic)
        if span is None and len(self._doubted) < _MOST_DOUBTED:
            return
        if span is None or time < span.high - TOLERANCE:
            self._witnesses += 1
            if fall.high - fall.to > _SURE or self._witnesses >= _WITNESSES:
                self._doubted = []
            return
        if topic != fall.topic:
            high, times = self._opposed.get(fall.topic, (fall.high, 0))
            self._opposed[fall.topic] = fall.high, (times if high == fall.high else 0) + 1
        self.periods.pop()
        self._tail = None
        for message in self._doubted:
            before.take(*message)
        self._doubted = []
