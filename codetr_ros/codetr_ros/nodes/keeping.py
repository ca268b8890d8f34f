"""What a recorder keeps of the messages that arrive, whom it asks for what it lacks, whom it
leaves out, and when it may end.

Every message that is admitted is kept as received bytes, unless it came before; what is refused is
not, or a bag could hold what nobody has learnt from.
"""

import time
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

from codetr_ros.bags.definitions import decode_sent, encode, stamp_of
from codetr_ros.bags.topics import RECORDED
from codetr_ros.config import Settings
from codetr_ros.cores.beside import Beside, Early
from codetr_ros.cores.recorder import Recorder
from codetr_ros.nodes.asking import MakeAsks
from codetr_ros.nodes.kept_run import KeptRun
from codetr_ros.nodes.patience import Limit
from codetr_ros.nodes.peers import Peer, Peers
from codetr_ros.nodes.settling import Settling
from codetr_ros.nodes.silence import Silence
from codetr_ros.nodes.sweeping import Sweeper
from codetr_ros.nodes.traffic import Traffic
from codetr_ros.records import (
    TOPICS,
    Commit,
    Metrics,
    Policy,
    Record,
    RecordError,
    RunSpec,
    StepRewards,
    TaskSpec,
    Transitions,
)
from codetr_ros.records.numbering import Judgement
from codetr_ros.records.roles import ROLES, WRITERS

RECORDED_TOPICS = [TOPICS[kind] for kind in RECORDED]
CATCH_UP = 10.0
"""The most seconds that a recorder which was held takes to ask others for what it has missed. They
keep it for some phases only, so that it commits none meanwhile. One that was killed, and comes to
the end of the run, waits for their answers as long as it waits for anybody."""
ASKS_ALL = (5.0, 30.0)
"""For how long [s] all others have waited when all of them are asked for what is lacking; behind
that it is nothing that they have."""


@dataclass(frozen=True)
class Keeper:
    """A recorder, as far as it matters what it keeps.

    Attributes:
        who: its full name.
        run: the run.
        settings: its settings.
        core: the recorder's.
        bag: what it keeps.
        traffic: hands records to the core.
        peers: the other nodes.
        limit: how long it waits for others.
        leave_out_after: seconds of silence after which a source is left out; 0: never.
        make: makes what asks a node.
        note_own: notes what it has published itself.
        log: its logger.
        stamp: returns the time that is written beside a message [ns].
        clock: monotonic time [s].
    """

    who: str
    run: RunSpec
    settings: Settings
    core: Recorder
    bag: KeptRun
    traffic: Traffic
    peers: Peers
    limit: Limit
    leave_out_after: float
    make: MakeAsks
    note_own: Callable[[], None]
    log: Any
    stamp: Callable[[], int]
    clock: Callable[[], float] = time.monotonic


class Keeping:
    """Takes the messages of a recorder.

    Args:
        keeper: whose messages they are.

    Attributes:
        early: counts of records, by topic, that came while something before them was lacking, and
            that are asked for again with it.
    """

    def __init__(self, keeper: Keeper) -> None:
        self._by = keeper
        self._core, self._bag, self._traffic = keeper.core, keeper.bag, keeper.traffic
        self._log = keeper.log
        self._silence = Silence(keeper.peers, keeper.settings, keeper.leave_out_after)
        self._settling = Settling(
            keeper.who, keeper.peers, keeper.limit, self._gone, self._has_all_of
        )
        self._done: set[str] = set()  # simulators whose last record is there
        self._beside = Beside(keeper.run, keeper.settings, lambda: keeper.core.phase)
        self._unannounced = Early(keeper.settings)
        self._catches_up_until = 0.0  # [s, monotonic]
        self._missed_until = 0.0  # as long it does not end before others have sent what it missed
        self.early: Counter[str] = Counter()
        # the newest of each publisher that came while something before it was lacking
        self._early: dict[object, Record] = {}
        self._sweeper = Sweeper(
            keeper.make, self._knows, self._take_again, keeper.log, keeper.clock
        )

    @property
    def without(self) -> list[str]:
        """Roles and names of the nodes without which the run has ended."""
        return self._settling.without

    # ---- a bag that was there before

    def restore(self, record: Record) -> None:
        """Take a record that the bag holds already.

        Raises:
            RecordError: a commit contradicts what it names.
        """
        if isinstance(record, TaskSpec):
            self._unannounced.announced(record.source)
        self._note_done(record)
        try:
            self._core.restore(record)
            if type(record) not in self._core.subscribes:
                self._beside.receive(record)
        except RecordError:
            if isinstance(record, Commit):
                raise
            # else it was refused when it came, too

    def go_on(self) -> None:
        """Ask all nodes for what was missed, if the bag was there before."""
        if self._bag.gone_on:
            self._traffic.ledger.forgive()
            self._sweeper.ask(self._nodes())
            self._missed_until = self._by.clock() + max(CATCH_UP, self._by.limit.seconds)

    def _nodes(self, roles: Collection[str] = ROLES) -> list[str]:
        """Full names of the other nodes of these roles."""
        return [
            peer.presence.node
            for role in roles
            if role != 'record'
            for peer in self._by.peers.alive(role)
        ]

    # ---- records

    def take(self, kind: type, raw: bytes) -> None:
        """Take the bytes of a message: what is admitted is written as it came."""
        record = self._traffic.decode(kind, raw, self.take)
        if record is not None and not self._bag.closed:  # else others may still publish
            self._take(record, raw)

    def _take_again(self, kind: type, raw: bytes) -> bool:
        """Take the bytes of a message that was sent again; returns whether it was new."""
        try:
            new = self._take(self._traffic.sent_again(kind, raw), raw)
        except RecordError as error:
            self._traffic.refuse(kind, error)
            return False
        if new:
            self._traffic.recovered[TOPICS[kind]] += 1
        return new

    def _knows(self, kind: type, raw: bytes) -> bool:
        try:
            return self._bag.repeats.knows(self._traffic.fetched(kind, raw))
        except RecordError:
            return True  # nothing is to be had from it

    def _take(self, record: Record, raw: bytes) -> bool:
        """Take a record; returns whether it is new and admitted."""
        traffic, core = self._traffic, self._core
        try:
            if self._unannounced.holds(record, raw):
                return False
        except RecordError as error:
            traffic.refuse(type(record), error)
            return False
        if self._came_before(record):
            return False
        if core.comes_early(record):  # something before it was lost
            self.early[TOPICS[type(record)]] += 1
            traffic.ledger.set_aside(record)
            self._early[type(record), getattr(record, 'source', '')] = record
            self._sweeper.ask(self._nodes(WRITERS[TOPICS[type(record)]]))
            return False
        learnt_from = type(record) in core.subscribes
        known = core.duplicated.total()
        if not traffic.receive(record, None if learnt_from else self._beside):
            if core.duplicated.total() > known:
                self._bag.repeats.note(record)  # which compares them
            return False
        if self._bag.repeats.note(record):
            return False
        self.write(record, self._kept(record, raw), stamp_of(raw))
        if isinstance(record, TaskSpec):
            for waiting, data in self._unannounced.announced(record.source):
                self._take(waiting, data)
        return True

    def _came_before(self, record: Record) -> bool:
        """Whether a record came before, and is neither of those whose number the core checks nor
        labels, of which the bag may hold less than came. The core refuses another policy for a
        phase that is permitted already.
        """
        if isinstance(record, Transitions | Judgement | StepRewards):
            return False
        if not self._bag.repeats.knows(record):
            return False
        if isinstance(record, TaskSpec) and record.source in self._core.left_out:
            self._core.receive(record)  # it is there again
            return True
        permits = isinstance(record, Policy) and not self._by.settings.free
        if permits and self._bag.repeats.differs(record):
            return False
        self._bag.repeats.note(record)  # which compares them
        self._core.duplicated[TOPICS[type(record)]] += 1
        return True

    def _kept(self, record: Record, raw: bytes) -> bytes:
        """The bytes that the bag keeps of a message: all, or only the first labels if so set."""
        if not isinstance(record, StepRewards):
            return raw
        kept = self._core.kept(record)
        if kept is record:
            return raw
        return encode(kept, stamp_of(raw), sender=decode_sent(StepRewards, raw)[1])

    def write(self, record: Record, raw: bytes, published: int | None = None) -> None:
        """Append a record to the bag.

        Args:
            record: the record.
            raw: its message.
            published: when it was published [ns].
        """
        if isinstance(record, Commit):
            self._beside.receive(record)
        self._note_done(record)
        self._bag.write(record, raw, self._by.stamp(), published)

    # ---- what is lacking

    def held(self) -> None:
        """Ask all nodes for what was published while nothing was read: the middleware takes who is
        silent for 20 s for gone, and drops what is for him.
        """
        self._sweeper.ask(self._nodes())
        self._catches_up_until = self._by.clock() + CATCH_UP

    def catches_up(self) -> bool:
        """Whether what was missed while nothing was read is still being sent again; goes on with
        it. No phase must be committed meanwhile.
        """
        if not self._sweeper.busy or self._by.clock() >= self._catches_up_until:
            return False
        self._sweeper.check()
        return True

    def lacks_true_rewards(self, commit: Commit) -> bool:
        """Whether true rewards of steps that a commit names are still to come. No commit needs
        them, but were all nodes killed right behind it, nobody would publish them again.
        """
        return self._beside.lacks_true_rewards(commit)

    def look_after(self) -> None:
        """Ask for what was lost on the way, and leave out who is silent for too long."""
        self._leave_out()
        # until it has come again itself: what was asked for may have been sent before it was
        due = {key: each for key, each in self._early.items() if self._core.still_due(each)}
        self._early = due
        lost = {TOPICS[type(record)] for record in due.values()}
        self._ask_again([*lost, *self._traffic.lost(RECORDED_TOPICS)])
        if self._nobody_works():
            self._sweeper.ask(self._nodes(), lacking=True)

    @property
    def asked_for(self) -> dict[str, float]:
        """Topics of what is asked for whenever it is lost, since ever."""
        return dict.fromkeys(RECORDED_TOPICS, 0.0)

    def _nobody_works(self) -> bool:
        """Whether all others have waited for a while, so that something is lacking which no count
        shows: after a node was killed, what was under way is not counted.
        """
        there = [each.presence for each in self._by.peers.newest() if not each.presence.finished]
        return bool(there) and ASKS_ALL[0] < min(each.waiting for each in there) < ASKS_ALL[1]

    def _leave_out(self) -> None:
        """Go on without simulators that are silent, if there are others."""
        silent = self._silence.sources(self._by.clock())
        for source in self._core.leave_out(silent):
            seconds, after = silent[source], self._silence.after
            why = (
                f'nothing has come from it for {seconds:.0f} s (parameter leave_out_after: '
                f'{after:g} s)'
                if seconds > after
                else 'it has ended'
            )
            self._log.warning(
                f'{source} is left out of phase {self._core.phase}: {why}. Its steps of the '
                'phase are dropped; it joins again with a later one'
            )

    def _has_all_of(self, peer: Peer) -> bool:
        """Whether all that a simulator has to publish is there."""
        return peer.presence.role == 'sim' and peer.name in self._done

    def _note_done(self, record: Record) -> None:
        """Note which simulators are done: their metrics of the last phase are the last of all. A
        robot may publish scores behind them.
        """
        settings = self._by.settings
        if settings.on_robot or not isinstance(record, Metrics):
            return
        if (record.role, record.phase) == ('sim', settings.phases - 1):
            self._done.add(record.node)

    def _gone(self, peer: Peer, now: float) -> bool:
        """Whether a node is silent and all that it simulates is left out: nobody waits for it."""
        self._silence.sources(now)
        out = peer.left_out(self._by.settings, self._core.left_out)
        return out and (peer.failed or self._silence.silent(peer, now))

    def _ask_again(self, lost: Collection[str]) -> None:
        """Ask those who publish on these topics for what was lost."""
        roles = sorted({role for topic in lost for role in WRITERS[topic]})
        self._sweeper.ask(self._nodes(roles), lacking=True)
        self._sweeper.check()

    # ---- the end

    def settled(self, seconds: float) -> tuple[bool, str]:
        """Whether all nodes have finished and all their records are in the bag; and what the
        recorder does.

        Args:
            seconds: time since every phase is committed.

        Raises:
            NodeError: a node has ended too early, or records never arrived.
        """
        self._by.note_own()
        now = self._by.clock()
        gone = [peer.presence.instance_id for peer in self._settling.gone(now)]
        missing = self._traffic.ledger.owed(without=gone)
        self._traffic.lost_for_good = missing
        settled, doing = self._settling.check(missing, seconds, now)
        if not settled:
            self._sweeper.ask(self._traffic.ledger.owing(), lacking=True)
            self._sweeper.check()
        elif self._sweeper.busy and now < self._missed_until:
            self._sweeper.check()
            return False, 'waits for what others have published while it was away'
        held = self._settling.held
        lacking = [who for who in self.without if who not in held]
        if settled and lacking:
            self._log.warning(
                f'ends without {", ".join(lacking)}: what was still to come from there is '
                'not in the bag'
            )
        if settled and held:
            self._log.warning(
                f'ends without {", ".join(held)}, from which nothing has come for longer than '
                'peer_deadline: all that it had to publish is in the bag'
            )
        return settled, doing
