"""A node of a simulated run: a real core, and what nodes decide, in turns of virtual time.

A turn is that of `ros/node.py`: take what arrived, publish the presence when it is due, ask for
what is missing, work one slice, publish what came out.
"""

from collections import Counter, defaultdict, deque
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from codetr_ros.bags.definitions import encode
from codetr_ros.config import queues
from codetr_ros.cores.core import Core
from codetr_ros.cores.simulator import Simulator
from codetr_ros.nodes.asking import SERVICE, Answer, answer_to
from codetr_ros.nodes.behind import Behind
from codetr_ros.nodes.catching_up import Fetcher
from codetr_ros.nodes.errors import NodeError, first_cause
from codetr_ros.nodes.outbox import Outbox
from codetr_ros.nodes.patience import Limit, Patience
from codetr_ros.nodes.peers import GAVE_UP, Peers
from codetr_ros.nodes.restoring import (
    Restoring,
    Returning,
    Steps,
    go_on,
    newest_committed,
    take_place,
)
from codetr_ros.nodes.traffic import Traffic
from codetr_ros.nodes.waiting import Waiting
from codetr_ros.records import TOPICS, Commit, Presence, Record, describe
from codetr_ros.records.roles import READ_BY_ITSELF, published_by
from codetr_ros.simtest.asking import Asker, FetchAnswer, FetchRequest
from codetr_ros.simtest.disks import KilledError
from codetr_ros.simtest.network import KEPT_FOR_LATE
from codetr_ros.simtest.place import Packet, Place
from codetr_ros.simtest.world import World

PRESENCE_EVERY = 1.0  # [s]
IDLE = 0.5  # [s] between two turns of a node that waits


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
        place: where it is, and who it is.
        core: its core.
        error: why it gave up; None if it has not.
        over: whether it has done everything, and stays for those that lack what it has published.
        ended: whether it has taken its last turn.
        killed: whether that was because it was killed.
        finished: whether its core was, when it ended.
        ended_at: when that was [s].
        when_killed: called where that was within a call of its disk.
        repeated: second copies that it has taken, by topic.
        set_aside: messages that are fetched again later instead, by topic.
        lasting: packets that it has published on topics which keep them for late readers.

    Args:
        place: where it is, and who it is.
        core: its core.
    """

    def __init__(self, place: Place, core: Core[Record]) -> None:
        self.place, self.core = place, core
        self.world, self.mail, self.run = place.world, place.mail, place.run
        self.role, self.name = place.role, place.name
        self.instance = f'{place.name}#{place.instance}'
        self.error: Exception | None = None
        self.over = self.ended = self.killed = self.finished = False
        self.ended_at = 0.0
        self.when_killed: Callable[[Process], None] = lambda process: None
        self.repeated: Counter[str] = Counter()
        self.set_aside: Counter[str] = Counter()
        self.published: Counter[str] = Counter()
        self.lasting: defaultdict[type, deque[Packet]] = defaultdict(deque)
        self.doing = 'starting'
        self.peers = Peers(self.role)
        self.peers.know(place.settings, self.name)
        self.limit = Limit(place.deadline)
        self.log = _Log(self.world, self.name)
        self.traffic = Traffic(self.log, self.now)
        self.traffic.core = core
        self.traffic.settings, self.traffic.run_id = place.settings, place.run.run_id
        self._work = core.work()
        self._behind: Behind | None = None
        if isinstance(core, Simulator):
            self._behind = Behind(self.traffic, core, place.settings)
        self._patience = Patience(
            f'/{self.name}',
            self.peers,
            [TOPICS[kind] for kind in core.subscribes],
            self.limit,
            self.log,
            left_out=self.traffic.left_out,
        )
        take, phases = self.traffic.take_again, Commit in core.subscribes
        self._fetcher = Fetcher(self.make_asker, self.peers, take, self.log, phases, self.now)
        self._outbox = Outbox.of(self.role, place.settings)
        self._asked: dict[int, Asker] = {}  # by the numbers of their questions
        self._restoring: Restoring | None = None
        self._inbox: deque[Packet] = deque()
        self._seen: set[int] = set()
        self._presence_at = -PRESENCE_EVERY
        self._stamp = 0  # of the newest message [ns]
        self._waiting = Waiting()
        self._begun = False
        self._was_held = False
        self._turn_due = 0  # number of the turn that is to come
        self._idle = False
        if self.role != 'record':
            self.traffic.hold()
        self._schedule(place.pace.begins)

    # ---- time

    def now(self) -> float:
        """Virtual time [s]."""
        return self.world.now

    def _schedule(self, time: float) -> None:
        self._turn_due += 1
        due = self._turn_due
        self.world.at(time, lambda: self._turn(due))

    def arrive(self, packet: Packet) -> None:
        """Take a message into the inbox; wakes the node if it waits."""
        self._inbox.append(packet)
        if self._idle and not self.ended:
            self._idle = False
            self._schedule(self.world.now)

    def _turn(self, due: int) -> None:
        if self.ended or due != self._turn_due:
            return
        until = self.place.pace.stalled_until(self.world.now)
        if until is not None:
            self._idle = False
            self._was_held = True
            self.world.note(self.name, f'stalls for {until - self.world.now:.1f} s')
            self._schedule(until)
            return
        try:
            pause = self._do_turn_or_fail()
        except KilledError:  # even while it closed its bag, since it had failed
            self.die()
            self.when_killed(self)
            return
        if not self.ended:
            self._idle = pause is None
            self._schedule(self.world.now + (IDLE if pause is None else pause))

    def _do_turn_or_fail(self) -> float | None:
        try:
            return self._do_turn()
        except Exception as error:  # noqa: BLE001 - judged by the simulation, whatever it is
            self.error = error
            self.end()
            return None

    def _do_turn(self) -> float | None:
        """One turn: how long it takes [s]; None if the node waits for messages."""
        while self._inbox:
            self._take(self._inbox.popleft())
        if self.world.now - self._presence_at >= PRESENCE_EVERY:
            self.publish_presence()
        if self.over:
            deadline = self.limit.seconds
            if self.peers.waits_for_nobody('record', self.world.now, deadline):
                self.end()
            return None
        if not (self._gathered() and self._restored()):
            return None
        if self._was_held:
            self._was_held = False
            self._waiting.over()
            self.held()
        if self.pauses():
            return None
        runs_away = self._fetcher.runs_away(self.core, self._outbox)
        if not runs_away:
            self._fetcher.check(self.core)
        given = None if runs_away or self._over() else next(self._work)
        for record in given or ():
            self.deliver(record)
        if given is not None:
            self._waiting.over()
            return self.world.rng.expovariate(1 / self.place.pace.slice_seconds)
        self._wait()
        return None

    def _wait(self) -> None:
        now = self.world.now
        self.doing = 'has finished' if self.core.finished else self.waits()
        seconds = self._waiting.seconds(self.doing, now)
        if self.core.finished:
            if self.settled(seconds):
                self.leave()
            return
        lost, asked_for = self.traffic.lost(), self.asked_for()
        self._patience.check(now, seconds, self.doing, lost, asked_for)

    def waits(self) -> str:
        """What the node waits for, in words. A simulator that was left out goes on where the run
        stands.
        """
        if self._behind is not None and self._behind.asks:
            self._restore(newest_committed(self._behind.answered))
        elif isinstance(self.core, Simulator) and self.core.displaced:
            self._restore(take_place(self._returning()))
        return f'waits for {self.core.waiting_for()}'

    def _over(self) -> bool:
        return self._behind is not None and self._behind.over(self.peers)

    def asked_for(self) -> Mapping[str, float]:
        """Topics of what the node lacks and asks for, and since when [s] that is in vain."""
        return self._fetcher.asked_for

    def held(self) -> None:
        """Note that the process was held, and has read nothing for a while."""

    def pauses(self) -> bool:
        """Whether the core must not work yet."""
        return False

    # ---- joining

    def _gathered(self) -> bool:
        if self._begun:
            return True
        if self._lacks(self.peers.absent(self.place.settings, self.run.settings_hash)):
            return False
        self._begun = True
        self.go_on()
        return True

    def go_on(self) -> None:
        """Let the core be as it was, if the run has begun without it or it was killed."""
        self._restore(go_on(self._returning()))

    def _returning(self) -> Returning:
        return Returning(
            role=self.role,
            name=self.name,
            core=self.core,
            settings=self.place.settings,
            peers=self.peers,
            catch_up=self._catch_up,
            begin_counting_anew=self.begin_counting_anew,
            log=self.log,
        )

    def _catch_up(self, newest: int) -> None:
        core: Any = self.core
        core.catch_up(newest)
        self._fetcher.behind = newest

    def _restore(self, steps: Steps) -> None:
        asker = self.make_asker(SERVICE)
        self._restoring = Restoring(asker, self.traffic.fetched, f'/{self.name}', steps)

    def _restored(self) -> bool:
        """Whether all that was asked of the recorder has come."""
        if self._restoring is not None:
            if not self._over() and self._lacks(self._restoring.lacking()):
                return False
            self._restoring = None
            self.traffic.release(self._later)
        return True

    def _lacks(self, lacking: list[str]) -> bool:
        """Whether something is lacking; gives up if it is for too long."""
        if not lacking:
            self._waiting.over()
            return False
        self.doing = f'waits for {"; ".join(lacking)}'
        if self._waiting.seconds(self.doing, self.world.now) > self.limit.seconds:
            raise NodeError(
                f'/{self.name} gave up after {self.limit.seconds:g} s: it {self.doing}',
                self.peers.cause(),
            )
        return True

    # ---- messages

    def _take(self, packet: Packet) -> None:
        if isinstance(packet.data, Presence):
            self._note_peer(packet.data, packet.stamp)
        elif isinstance(packet.data, FetchAnswer):
            asker = self._asked.pop(packet.data.number, None)
            if asker is not None:
                asker.arrived(packet.data)
        elif isinstance(packet.data, FetchRequest):
            self._answer(packet.data)
        else:
            self.repeated[TOPICS[packet.kind]] += packet.number in self._seen
            self._seen.add(packet.number)
            self.take(packet.kind, packet.data)

    def _note_peer(self, presence: Presence, stamp: int) -> None:
        news = self.peers.note(presence, self.world.now)
        if news:
            self.world.note(self.name, news)
        self.traffic.ledger.note(presence, stamp, self.world.now)
        self.note_own()

    def note_own(self) -> None:
        """Note what this node has published that it receives itself."""
        own = {topic: self.published[topic] for topic in READ_BY_ITSELF.get(self.role, ())}
        if own:
            self.traffic.ledger.note_own(self.instance, own, self.world.now)

    def begin_counting_anew(self) -> None:
        """Count as lost only what is published from now on and never arrives."""
        self.traffic.ledger.forgive()

    def take(self, kind: type, raw: bytes) -> None:
        """Take the bytes of a message."""
        record = self.traffic.decode(kind, raw)
        if record is None:
            return
        if not self._later(record):
            self.traffic.receive(record)

    def _later(self, record: Record) -> bool:
        later = self._fetcher.later(record, self.core)
        self.set_aside[TOPICS[type(record)]] += later
        if later:
            self.traffic.ledger.set_aside(record)
        return later

    def make_asker(self, service: str) -> Asker:
        """What asks a service."""
        return Asker(self, service)

    def ask(self, asker: Asker, reader: str, request: FetchRequest) -> None:
        """Send a question of an asker."""
        self._asked[request.number] = asker
        self.mail.send(self, reader, Packet(FetchRequest, 0, request))

    def _answer(self, request: FetchRequest) -> None:
        answer = FetchAnswer(request.number, self.answer(request))
        self.mail.send(self, request.requester, Packet(FetchAnswer, 0, answer))

    def answer(self, request: FetchRequest) -> Answer:
        """What the node answers: it sends again what it has published."""

        def read(phase: int, kinds: Any) -> list[tuple[type, bytes]]:
            there = self._outbox.read(phase, kinds)
            return [(type(each), self.message(each, stamp)) for each, stamp in there]

        outbox = self._outbox
        return answer_to(request.phase, request.kinds, read, lambda: outbox.newest, self.log)

    def stamp(self) -> int:
        """The present time [ns], and never the same twice."""
        self._stamp = max(round(self.world.now * 1e9), self._stamp + 1)
        return self._stamp

    def message(self, record: Record, stamp: int) -> bytes:
        """The bytes of a record's message."""
        return encode(record, stamp, sender=self.instance)

    def deliver(self, record: Record) -> None:
        """Publish a record of the core."""
        stamp = self.stamp()
        self._outbox.keep(record, stamp)
        self.publish(record, self.message(record, stamp))

    def publish(self, record: Record, raw: bytes) -> None:
        """Publish the bytes of a record."""
        kind = type(record)
        self.published[TOPICS[kind]] += 1
        self.world.note(self.name, f'publishes {describe(record)}')
        packet = Packet(kind, self.world.number(), raw)
        if kind in KEPT_FOR_LATE:
            self.lasting[kind].append(packet)
            if len(self.lasting[kind]) > queues.depth(TOPICS[kind], self.place.settings):
                self.lasting[kind].popleft()
        self.mail.publish(self, packet)

    def publish_presence(self) -> None:
        """Publish the presence."""
        self._presence_at = self.world.now
        topics = tuple(t for t in published_by(self.role) if t in self.published)
        doing, waiting, over = self.doing, 0.0, self.over or self.ended
        if over:
            cause = self.error and first_cause(self.error, f'{self.role} /{self.name}')
            doing = f'{GAVE_UP}{cause}' if cause else 'has finished'
        elif self._waiting.since is not None:
            waiting = self.world.now - self._waiting.since
        presence = Presence(
            run_id=self.run.run_id,
            role=self.role,
            node=f'/{self.name}',
            instance_id=self.instance,
            settings_hash='' if self.error else self.run.settings_hash,
            finished=over,
            topics=topics,
            published=np.array([self.published[t] for t in topics], np.uint64),
            missed=sum(self.traffic.lost().values()),
            doing=doing,
            waiting=waiting,
        )
        self.mail.publish(self, Packet(Presence, 0, presence, self.stamp()))

    # ---- the end

    def die(self) -> None:
        """End at once: nobody hears of it, and nothing is saved."""
        self.ended = self.killed = True
        self.world.note(self.name, 'is killed')

    def settled(self, seconds: float) -> bool:
        """Whether the node may end, `seconds` after its core has finished."""
        return True

    def leave(self) -> None:
        """Stay until the recorder has finished: it, or a node that is started again, may lack what
        only this one can send.
        """
        self.over = True
        self.core.close()
        self.publish_presence()

    def end(self) -> None:
        """Close the core and take leave."""
        self.close()
        self.finished = self.core.finished and self.error is None
        self.ended, self.ended_at = True, self.world.now
        self.world.note(self.name, 'has finished' if self.finished else f'fails: {self.error}')
        self.publish_presence()

    def close(self) -> None:
        """Save what must outlast the process."""
        try:
            self.core.close()
        except Exception as error:  # noqa: BLE001 - judged by the simulation
            self.error = self.error or error
