"""A network that delays, reorders, doubles and loses messages, and falls into parts.

It promises what reliable DDS does, and no more. Messages of one publisher to one reader keep their
order on a topic if the reader is the recorder, which counts on that; for others even that is
broken. Topics that are transient local reach a reader after any partition. On other topics a
partition that outlasts the lease of the middleware loses what was published meanwhile.
"""

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from codetr_ros.records import (
    TOPICS,
    Commit,
    CompositeReward,
    Policy,
    Presence,
    RunSpec,
    StepRewards,
    TaskSpec,
    Transitions,
    TrueRewards,
)
from codetr_ros.simtest.world import World

LEASE = 20.0  # [s] of silence after which the middleware takes a participant for gone
NUMBERED = (Transitions, CompositeReward, TrueRewards, StepRewards, Presence)
"""Kinds of which a recorder knows second copies."""
KEPT_FOR_LATE = (RunSpec, TaskSpec, Policy, Commit)
"""What is published transient local (`ros/qos.py`)."""
FETCHED_AGAIN = (Transitions, CompositeReward)
"""What a consumer can fetch again from the recorder, so that it may be lost."""


@dataclass(frozen=True)
class Partition:
    """For a while, some nodes and the others do not reach each other."""

    begin: float  # [s]
    seconds: float
    apart: frozenset[str]  # names of the nodes on one side

    def parts(self, sender: str, reader: str, now: float) -> bool:
        """Whether a message between two nodes does not get through now."""
        between = (sender in self.apart) != (reader in self.apart)
        return between and self.begin <= now < self.begin + self.seconds


@dataclass(frozen=True)
class Weather:
    """How the network behaves.

    Attributes:
        delay: of a message, on average [s].
        reorder: whether messages overtake each other on the way to all but the recorder.
        doubled: share of messages that arrive twice.
        lost: share of those messages that never arrive which a reader can fetch again.
        overrun: share of those messages that never arrive at the recorder.
        strangers: share of messages that arrive once more, as if they were of another run.
        lies: share of steps and scores of which learner and reward node get a forged copy first.
        partitions: when it falls into parts.
    """

    delay: float = 0.01
    reorder: bool = False
    doubled: float = 0.0
    lost: float = 0.0
    overrun: float = 0.0
    strangers: float = 0.0
    lies: float = 0.0
    partitions: tuple[Partition, ...] = ()


Handle = Callable[[], None]


class Network:
    """Carries messages between the nodes.

    Attributes:
        doubled: messages that arrived a second time, by reader and topic.
        lost: messages that never arrived, by reader and topic.

    Args:
        world: where it is.
        weather: how it behaves.
    """

    def __init__(self, world: World, weather: Weather) -> None:
        self.doubled: Counter[tuple[str, str]] = Counter()
        self.lost: Counter[tuple[str, str]] = Counter()
        self._world = world
        self._weather = weather
        self._last: dict[tuple[str, str, type], float] = {}

    def send(self, sender: str, reader: str, kind: type, handle: Handle, ordered: bool) -> None:
        """Let a message arrive, or not.

        Args:
            sender: name of a node.
            reader: name of a node.
            kind: what it carries: a kind of record, or another type.
            handle: called when it arrives.
            ordered: whether it must not overtake those before it.
        """
        world, weather = self._world, self._weather
        topic = TOPICS.get(kind, kind.__name__)
        begin = self._through(sender, reader, kind)
        losing = (weather.overrun if ordered else weather.lost) if kind in FETCHED_AGAIN else 0.0
        if begin is None or (losing and world.rng.random() < losing):
            self.lost[reader, topic] += 1
            world.note(sender, f'{topic} to {reader} is lost')
            return
        arrival = begin + world.rng.expovariate(1 / weather.delay)
        if ordered or not weather.reorder:
            key = sender, reader, kind
            arrival = self._last[key] = max(arrival, self._last.get(key, 0.0))
        world.at(arrival, handle)
        # copies of other kinds reach the bag
        twice = kind in TOPICS and (kind in NUMBERED or not ordered)
        if twice and world.rng.random() < weather.doubled:
            self.doubled[reader, topic] += 1
            world.at(arrival + world.rng.expovariate(1 / weather.delay), handle)

    def _through(self, sender: str, reader: str, kind: type) -> float | None:
        """When a message gets through [s]; None: never."""
        begin = self._world.now
        for partition in self._weather.partitions:
            if partition.parts(sender, reader, begin):
                if partition.seconds > LEASE and kind in TOPICS and kind not in KEPT_FOR_LATE:
                    return None
                begin = partition.begin + partition.seconds
        return begin

    def publish(
        self, sender: str, readers: Iterable[str], kind: type, arrive: Callable[[str], Handle]
    ) -> None:
        """Send a message to several readers; `arrive` makes what each handles it with."""
        for reader in readers:
            self.send(sender, reader, kind, arrive(reader), ordered=reader == 'record')
