"""A node of a simulated run: a real core, and what nodes decide, in turns of virtual time.

A turn is that of `ros/node.py`: take what arrived, publish the presence when it is due, ask for
what is missing, work one slice, publish what came out.
"""

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from codetr_ros.bags.definitions import encode
from codetr_ros.config import Settings
from codetr_ros.cores.core import Core
from codetr_ros.cores.simulator import Simulator
from codetr_ros.nodes.behind import Behind
from codetr_ros.nodes.errors import NodeError, first_cause
from codetr_ros.nodes.fetching import Fetching
from codetr_ros.nodes.patience import Limit, Patience
from codetr_ros.nodes.peers import GAVE_UP, Peers
from codetr_ros.nodes.traffic import Traffic
from codetr_ros.records import TOPICS, Commit, Presence, Record, RunSpec, describe
from codetr_ros.records.roles import published_by
from codetr_ros.simtest.network import KEPT_FOR_LATE
from codetr_ros.simtest.world import World

PRESENCE_EVERY = 1.0  # [s]
IDLE = 0.5  # [s] between two turns of a node that waits


@dataclass(frozen=True)
class Packet:
    """A message on its way.

    Attributes:
        kind: what it carries.
        number: one for each message, by which a second copy shows.
        data: CDR; a record as it is for presences, which are many.
    """

    kind: type
    number: int
    data: Any


@dataclass(frozen=True)
class FetchRequest:
    """Asks the recorder for a phase."""

    phase: int
    requester: str


@dataclass(frozen=True)
class FetchAnswer:
    """The messages of a phase, of which the recorder has all or none."""

    phase: int
    messages: Sequence[tuple[type, bytes]]


class Mail(Protocol):
    """Brings what a node publishes to the others."""

    def publish(self, sender: 'Process', packet: Packet) -> None:
        """Send a message to everybody who reads its kind."""

    def send(self, sender: 'Process', reader: str, packet: Packet) -> None:
        """Send a request or an answer to one node."""


@dataclass
class Pace:
    """How quickly a node works.

    Attributes:
        begins: when it starts [s].
        slice_seconds: what a slice takes, on average [s].
        stalls: when it takes no turn: from when, for how long [s].
    """

    begins: float = 0.0
    slice_seconds: float = 0.02
    stalls: list[tuple[float, float]] = field(default_factory=list)

    def stalled_until(self, now: float) -> float | None:
        """The end of the stall that it is in [s]; None if it is in none."""
        ends = [begin + length for begin, length in self.stalls if begin <= now < begin + length]
        return max(ends, default=None)


class _Log:
    """Logs into the trace."""

    def __init__(self, world: World, who: str) -> None:
        self._world = world
        self._who = who

    def warning(self, message: str) -> None:
        self._world.note(self._who, f'warning: {message}')

    error = info = warning


class Process:
    """One node.

    Attributes:
        core: its core.
        error: why it gave up; None if it has not.
        ended: whether it has taken its last turn.
        when_ended: called once it has.
        newest_committed: returns the last committed phase, as its recorder answers.
        when_displaced: called while it is permitted to go on after it was left out.
        repeated: second copies that it has taken, by topic.
        kept: what has arrived on topics that keep their messages for late readers.

    Args:
        world: where it is.
        mail: brings what it publishes.
        run: the run.
        settings: its settings.
        role: one of `records.ROLES`.
        name: its name.
        core: its core.
        pace: how quickly it works.
        deadline: how long it waits for others [s].
        instance: which start of the node this is: 1, 2, ...
    """

    def __init__(
        self,
        world: World,
        mail: Mail,
        run: RunSpec,
        settings: Settings,
        role: str,
        name: str,
        core: Core[Record],
        pace: Pace,
        deadline: float,
        instance: int = 1,
    ) -> None:
        self.instance = instance
        self.role, self.name, self.core = role, name, core
        self.error: Exception | None = None
        self.when_ended: Callable[[Process], None] = lambda process: None
        self.newest_committed: Callable[[], int | None] = lambda: None
        self.when_displaced: Callable[[Process], None] = lambda process: None
        self.ended = False
        self.finished = False  # the core was, when it ended
        self.kept: list[Packet] = []
        self.repeated: Counter[str] = Counter()
        self.published: Counter[str] = Counter()
        self.doing = 'starting'
        self.world = world
        self.mail = mail
        self.run = run
        self.peers = Peers(role)
        self.limit = Limit(deadline)
        self.log = _Log(world, name)
        self.traffic = Traffic(self.log, lambda: world.now)
        self.traffic.core = core
        self.traffic.settings, self.traffic.run_id = settings, run.run_id
        self._settings = settings
        self._pace = pace
        self._work = core.work()
        self._behind: Behind | None = None
        if isinstance(core, Simulator):
            self._behind = Behind(self.traffic, core, settings)
        self._patience = Patience(
            f'/{name}',
            self.peers,
            [TOPICS[kind] for kind in core.subscribes],
            self.limit,
            self.log,
        )
        self._fetching = Fetching() if Commit in core.subscribes else None
        self._inbox: deque[Packet] = deque()
        self._seen: set[int] = set()
        self._presence_at = -PRESENCE_EVERY
        self._waiting: float | None = None  # since when [s]
        self._begun = False
        self._turn_due = 0  # number of the turn that is to come
        self._idle = False
        self._schedule(pace.begins)

    # ---- time

    def _schedule(self, time: float) -> None:
        self._turn_due += 1
        due = self._turn_due
        self.world.at(time, lambda: self._turn(due))

    def arrive(self, packet: Packet) -> None:
        """Take a message into the inbox; wakes the node if it waits."""
        self._inbox.append(packet)
        if packet.kind in KEPT_FOR_LATE:
            self.kept.append(packet)
        if self._idle and not self.ended:
            self._idle = False
            self._schedule(self.world.now)

    def _turn(self, due: int) -> None:
        if self.ended or due != self._turn_due:
            return
        until = self._pace.stalled_until(self.world.now)
        if until is not None:
            self._idle = False
            self.world.note(self.name, f'stalls for {until - self.world.now:.1f} s')
            self._schedule(until)
            return
        try:
            pause = self._do_turn()
        except Exception as error:  # noqa: BLE001 - judged by the simulation, whatever it is
            self.error = error
            self.end()
            return
        if not self.ended:
            self._idle = pause is None
            self._schedule(self.world.now + (IDLE if pause is None else pause))

    def _do_turn(self) -> float | None:
        """One turn: how long it takes [s]; None if the node waits for messages."""
        while self._inbox:
            self._take(self._inbox.popleft())
        if self.world.now - self._presence_at >= PRESENCE_EVERY:
            self.publish_presence()
        if not self._begun and not self._gathered():
            return None
        self._ask_again()
        given = next(self._work)
        for record in given or ():
            self.deliver(record)
        if given is not None:
            self._waiting = None
            return self.world.rng.expovariate(1 / self._pace.slice_seconds)
        now = self.world.now
        self._waiting = now if self._waiting is None else self._waiting
        if self._behind is not None and self._behind.asks:
            self._behind.answered(self.newest_committed())
        if isinstance(self.core, Simulator) and self.core.displaced:
            self.when_displaced(self)
        elif self.core.finished:
            self.doing = 'has finished'
            if self.settled(now - self._waiting):
                self.end()
        else:
            self.doing = f'waits for {self.core.waiting_for()}'
            self._patience.check(now, now - self._waiting, self.doing, self.traffic.lost())
        return None

    def _gathered(self) -> bool:
        absent = self.peers.absent(self._settings, self.run.settings_hash)
        if not absent:
            self._begun = True
            return True
        doing, now = f'waits for {"; ".join(absent)}', self.world.now
        if doing != self.doing:
            self.doing, self._waiting = doing, now
        if self._waiting is not None and now - self._waiting > self.limit.seconds:
            raise NodeError(
                f'/{self.name} gave up after {self.limit.seconds:g} s: it {doing}',
                self.peers.cause(),
            )
        return False

    # ---- messages

    def _take(self, packet: Packet) -> None:
        if packet.kind in TOPICS:
            self.repeated[TOPICS[packet.kind]] += packet.number in self._seen
            self._seen.add(packet.number)
        if isinstance(packet.data, Presence):
            news = self.peers.note(packet.data, self.world.now)
            if news:
                self.world.note(self.name, news)
            self.traffic.ledger.note(self.peers.published(), self.world.now)
        elif isinstance(packet.data, FetchAnswer):
            self.world.note(self.name, f'phase {packet.data.phase} came again')
            for kind, raw in packet.data.messages:
                self.traffic.take_again(kind, raw)
            self.core.fetched(packet.data.phase)
        else:
            self.take(packet.kind, packet.data)

    def take(self, kind: type, raw: bytes) -> None:
        """Take the bytes of a message."""
        record = self.traffic.decode(kind, raw)
        if record is not None:
            self.traffic.receive(record)

    def _ask_again(self) -> None:
        if self._fetching is None or not self._fetching.due(self.core.missing, self.world.now):
            return
        assert self.core.missing is not None
        self.world.note(self.name, f'asks for phase {self.core.missing} again')
        request = FetchRequest(self.core.missing, self.name)
        self.mail.send(self, 'record', Packet(FetchRequest, 0, request))

    def deliver(self, record: Record) -> None:
        """Publish a record of the core."""
        self.publish(record, encode(record, round(self.world.now * 1e9)))

    def publish(self, record: Record, raw: bytes) -> None:
        """Publish the bytes of a record."""
        self.published[TOPICS[type(record)]] += 1
        self.world.note(self.name, f'publishes {describe(record)}')
        self.mail.publish(self, Packet(type(record), self.world.number(), raw))

    def publish_presence(self) -> None:
        """Publish the presence."""
        self._presence_at = self.world.now
        topics = tuple(t for t in published_by(self.role) if t in self.published)
        doing, waiting = self.doing, 0.0
        if self.ended:
            cause = self.error and first_cause(self.error, f'{self.role} /{self.name}')
            doing = f'{GAVE_UP}{cause}' if cause else 'has finished'
        elif self._waiting is not None:
            waiting = self.world.now - self._waiting
        presence = Presence(
            run_id=self.run.run_id,
            role=self.role,
            node=f'/{self.name}',
            instance_id=f'{self.name}#{self.instance}',
            settings_hash='' if self.error else self.run.settings_hash,
            finished=self.ended,
            topics=topics,
            published=np.array([self.published[t] for t in topics], np.uint64),
            missed=sum(self.traffic.lost().values()),
            doing=doing,
            waiting=waiting,
        )
        self.mail.publish(self, Packet(Presence, 0, presence))

    # ---- the end

    def die(self) -> None:
        """End at once: nobody hears of it."""
        self.ended = True
        self.core.close()
        self.world.note(self.name, 'is killed')

    def settled(self, seconds: float) -> bool:
        """Whether the node may end, `seconds` after its core has finished."""
        return True

    def end(self) -> None:
        """Close the core and take leave."""
        self.finished = self.core.finished and self.error is None
        self.ended = True
        self.world.note(self.name, 'has finished' if self.finished else f'fails: {self.error}')
        self.core.close()
        self.publish_presence()
        self.when_ended(self)
