"""A network that delays, reorders, doubles and loses messages, and falls into parts.

It promises what reliable DDS does, and less. Messages of one publisher to one reader keep their
order on a topic if the reader is the recorder, which counts on that; for others even that is
broken. Topics that are transient local reach a reader after any partition. On other topics a
partition that outlasts the lease of the middleware loses what was published meanwhile. Any other
message of any kind may be lost too, on its way to any reader, and so may questions and answers.
Messages come twice; to the recorder only where none is lost on the way there.
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
NEVER_LOST = (Presence, RunSpec)
"""Published again and again, or known to every node here from the beginning."""
FORGED = (Transitions, CompositeReward)
"""Of which learner and reward node get false ones."""


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
        lost: share of messages, of every kind, that never arrive at any reader but the recorder.
        overrun: share of messages, of every kind, that never arrive at the recorder.
        unanswered: share of questions, and of answers, that never arrive.
        strangers: share of messages that arrive once more, as if they were of another run.
        lies: share of steps and scores of which learner and reward node get a forged copy first.
        partitions: when it falls into parts.
    """

    delay: float = 0.01
    reorder: bool = False
    doubled: float = 0.0
    lost: float = 0.0
    overrun: float = 0.0
    unanswered: float = 0.0
    strangers: float = 0.0
    lies: float = 0.0
    partitions: tuple[Partition, ...] = ()

    @property
    def loses_for_the_recorder(self) -> bool:
        """Whether messages may never arrive at the recorder."""
        return bool(self.overrun) or any(each.seconds > LEASE for each in self.partitions)


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
        losing = self._losing(kind, ordered) if sender != reader else 0.0
        if begin is None or (losing and world.rng.random() < losing):
            self.lost[reader, topic] += 1
            world.note(sender, f'{topic} to {reader} is lost')
            return
        arrival = begin + world.rng.expovariate(1 / weather.delay)
        if ordered or not weather.reorder:
            key = sender, reader, kind
            arrival = self._last[key] = max(arrival, self._last.get(key, 0.0))
        world.at(arrival, handle)
        # copies of other kinds reach the bag; and in the counts of a recorder, the copy of one
        # message would make up for the loss of another
        recorded = kind in NUMBERED and not weather.loses_for_the_recorder
        twice = kind in TOPICS and (recorded or not ordered)
        if twice and world.rng.random() < weather.doubled:
            self.doubled[reader, topic] += 1
            world.at(arrival + world.rng.expovariate(1 / weather.delay), handle)

    def _losing(self, kind: type, to_the_recorder: bool) -> float:
        """The share of messages of a kind that never arrive."""
        if kind not in TOPICS:
            return self._weather.unanswered
        if kind in NEVER_LOST:
            return 0.0
        return self._weather.overrun if to_the_recorder else self._weather.lost

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
