"""The recorder's wiring: writes messages as they arrive, and commits phases.

Every message that is admitted goes into the bag as received bytes, unless it came before; what is
refused does not, or a bag could hold what nobody has learnt from. A commit goes into the bag after
all records that it names, and out to the nodes only after the bag is flushed and synced. So nobody
learns from what could be lost, and the bag names the records of every phase that anybody has
learnt from.

A recorder that is started again in the folder of its run goes on with the bag, and asks all other
nodes for what it has missed. The service `fetch_phase` sends any committed phase again from the
bag; without a bag, the last ones from memory.
"""

import time
from collections import deque
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any, cast

from codetr_ros.bags.definitions import decode, decode_sent, encode, stamp_of
from codetr_ros.bags.topics import RECORDED, topics_of_run
from codetr_ros.cores.beside import Beside, Early
from codetr_ros.cores.recorder import Recorder
from codetr_ros.nodes.kept_run import KeptRun
from codetr_ros.nodes.peers import Peer
from codetr_ros.nodes.settling import Settling
from codetr_ros.nodes.silence import Silence
from codetr_ros.records import (
    TOPICS,
    Commit,
    CompositeReward,
    Policy,
    Preference,
    Record,
    RecordError,
    RunSpec,
    StepRewards,
    TaskSpec,
    Transitions,
)
from codetr_ros.records.roles import ROLES, WRITERS
from codetr_ros.ros.fetch import SERVICE
from codetr_ros.ros.gathering import IDLE
from codetr_ros.ros.joining import Joined
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.resend import PhaseService
from codetr_ros.ros.sweeping import Sweeper
from codetr_ros.ros.wiring import Wiring
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.reports import BagReport

RECORDED_TOPICS = [TOPICS[kind] for kind in RECORDED]
CATCH_UP = 10.0
"""The most seconds that a recorder which was held takes to ask others for what it has missed. They
keep it for some phases only, so that it commits none meanwhile."""
JUDGEMENTS = (CompositeReward, Preference)


class Recording(Wiring):
    """The wiring of the recorder's core: to a bag, and to all topics."""

    def __init__(self, member: Membership, joined: Joined) -> None:
        super().__init__(member, joined)
        settings = joined.settings
        self._silence = Silence(member.peers, settings, member.values['leave_out_after'])
        self._settling = Settling(member.link.full_name, member.peers, member.limit, self._gone)
        names = {k: member.link.node.resolve_topic_name(TOPICS[k]) for k in RECORDED}
        self._bag = KeptRun(
            self._bag_folder(),
            dict(zip(RECORDED, topics_of_run(names, settings), strict=True)),
            settings.ahead + 2,
            settings.phase_steps,
            round(member.values['bag_split_mb'] * 1e6),
            round(member.values['bag_keep_free_mb'] * 1e6),
        )
        # the newest commits, as bytes: published again by a recorder that was started again
        self._commits: deque[bytes] = deque(maxlen=settings.ahead + 1)
        core = cast(Recorder, joined.core)
        self._beside = Beside(joined.run, settings, lambda: core.phase)
        self._unannounced = Early(settings)
        self._catches_up = 0.0  # until when [s, monotonic]
        self._early: list[Record] = []  # came while something before them was lacking
        self._sweeper = Sweeper(member.link, joined.run.run_id, self._knows, self._take_again)

    def open(self) -> None:
        """Open the bag, then subscribe to everything as raw bytes."""
        settings, link, bag = self.joined.settings, self.member.link, self._bag
        run_id = self.joined.run.run_id
        bag.open(run_id, self._restore)
        if bag.gone_on:
            self.log.info(f'goes on with {bag.folder}, behind phase {bag.newest}')
        elif bag.folder:
            self.log.info(f'records to {bag.folder}')
        if not bag.recorded[TOPICS[RunSpec]]:
            self._write(self.joined.run, self.member.announcement)
        for kind in RECORDED:
            if kind not in (RunSpec, Commit):  # the first has arrived, the second is our own
                link.subscribe(kind, self.take, settings)
        PhaseService(link, SERVICE, run_id, self._read, lambda: bag.newest)
        for data in self._commits:  # and by the counts of its presence others know of them
            known = link.is_signed(Commit, data)  # else all nodes are new, and take none of ours
            link.send(TOPICS[Commit], data if known else link.message(decode(Commit, data)))

    def _read(self, phase: int, kinds: Collection[str]) -> Iterable[tuple[type, bytes]]:
        """The messages of a phase, as the nodes of this run take them."""
        found = self._bag.read(phase, kinds)
        if not self._bag.gone_on:
            return found
        return ((kind, self.member.link.signed_again(kind, raw)) for kind, raw in found)

    def _restore(self, record: Record, data: bytes) -> None:
        """Take a record that the bag holds already."""
        core: Any = self.joined.core
        if isinstance(record, Commit):
            self._commits.append(data)
        if isinstance(record, TaskSpec):
            self._unannounced.announced(record.source)
        try:
            core.restore(record)
            if type(record) not in core.subscribes:
                self._beside.receive(record)
        except RecordError:
            if isinstance(record, Commit):
                raise
            # else it was refused when it came, too

    def go_on(self) -> bool:
        """Ask all nodes for what was missed, if the bag was there before."""
        if self._bag.gone_on:
            self.member.begin_counting_anew()
            self._sweeper.ask(self._nodes())
        return True

    def _nodes(self, roles: Collection[str] = ROLES) -> list[str]:
        """Full names of the other nodes of these roles."""
        return [
            peer.presence.node
            for role in roles
            if role != self.member.role
            for peer in self.member.peers.alive(role)
        ]

    def _bag_folder(self) -> Path | None:
        if self.member.values['bag']:
            return Path(self.member.values['bag'])
        return self.joined.folder and self.joined.folder / run_folder.BAG

    # ---- records

    def take(self, kind: type, raw: bytes) -> None:
        """Take the bytes of a message: what is admitted is written as it came."""
        record = self.member.traffic.decode(kind, raw, self.take)
        if record is not None and not self._bag.closed:  # else others may still publish
            self._take(record, raw)

    def _take_again(self, kind: type, raw: bytes) -> bool:
        """Take the bytes of a message that was sent again; returns whether it was new."""
        try:
            new = self._take(self.member.traffic.fetched(kind, raw), raw)
        except RecordError as error:
            self.member.traffic.refuse(kind, error)
            return False
        if new:
            self.member.traffic.recovered[TOPICS[kind]] += 1
        return new

    def _knows(self, kind: type, raw: bytes) -> bool:
        try:
            return self._bag.repeats.knows(self.member.traffic.fetched(kind, raw))
        except RecordError:
            return True  # nothing is to be had from it

    def _take(self, record: Record, raw: bytes) -> bool:
        """Take a record; returns whether it is new and admitted."""
        traffic, core = self.member.traffic, cast(Recorder, self.joined.core)
        try:
            if self._unannounced.holds(record, raw):
                return False
        except RecordError as error:
            traffic.refuse(type(record), error)
            return False
        if self._came_before(record):
            return False
        if core.comes_early(record):  # something before it was lost
            self._early.append(record)
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
        self._write(record, self._kept(record, raw), stamp_of(raw))
        if isinstance(record, TaskSpec):
            for waiting, data in self._unannounced.announced(record.source):
                self._take(waiting, data)
        return True

    def _came_before(self, record: Record) -> bool:
        """Whether a record came before, and is neither of those whose number the core checks nor
        labels, of which the bag may hold less than came. The core refuses another policy for a
        phase that is permitted already.
        """
        if isinstance(record, (Transitions, *JUDGEMENTS, StepRewards)):
            return False
        if not self._bag.repeats.knows(record):
            return False
        core = cast(Recorder, self.joined.core)
        if isinstance(record, TaskSpec) and record.source in core.absent:
            core.receive(record)  # it is there again
            return True
        permits = isinstance(record, Policy) and not self.joined.settings.free
        if permits and self._bag.repeats.differs(record):
            return False
        self._bag.repeats.note(record)  # which compares them
        core.duplicated[TOPICS[type(record)]] += 1
        return True

    def _kept(self, record: Record, raw: bytes) -> bytes:
        """The bytes that the bag keeps of a message: all, or only the first labels if so set."""
        if not isinstance(record, StepRewards):
            return raw
        kept = cast(Recorder, self.joined.core).kept(record)
        if kept is record:
            return raw
        return encode(kept, stamp_of(raw), sender=decode_sent(StepRewards, raw)[1])

    def _write(self, record: Record, raw: bytes, published: int | None = None) -> None:
        now = self.member.link.node.get_clock().now().nanoseconds
        self._bag.write(record, raw, now, published)

    def deliver(self, given: Record) -> None:
        """Publish a record of the core; a commit only after all that it names is on the disk."""
        link = self.member.link
        if not isinstance(given, Commit):
            super().deliver(given)
            return
        self._catch_up()
        self._bag.check_room()
        raw = link.message(given)
        self._write(given, raw)
        self._bag.flush()
        link.send(TOPICS[Commit], raw)

    def held(self) -> None:
        """Ask all nodes for what was published while nothing was read: the middleware takes who is
        silent for 20 s for gone, and drops what is for him.
        """
        self._sweeper.ask(self._nodes())
        self._catches_up = time.monotonic() + CATCH_UP

    def _catch_up(self) -> None:
        """Wait until what was missed has been sent again."""
        while self._sweeper.busy and time.monotonic() < self._catches_up and not self.member.stop:
            self.member.turn(IDLE)
            self._sweeper.check()

    # ---- waiting

    def waits(self) -> str:
        """What the recorder waits for, in words. What was lost on the way is asked for again, and
        who is silent for too long is left out.
        """
        core: Any = self.joined.core
        self._leave_out()
        self._early = [record for record in self._early if core.comes_early(record)][-1:]
        lost = [TOPICS[type(record)] for record in self._early]
        self._ask_again([*lost, *self.member.traffic.lost(RECORDED_TOPICS)])
        return super().waits()

    def _leave_out(self) -> None:
        """Go on without simulators that are silent, if there are others."""
        core = cast(Recorder, self.joined.core)
        silent = self._silence.sources(time.monotonic())
        for source in core.leave_out(silent):
            self.log.warning(
                f'{source} is left out of phase {core.phase}: nothing has come from it for '
                f'{silent[source]:.0f} s (parameter leave_out_after: {self._silence.after:g} s). '
                'Its steps of the phase are dropped; it joins again with a later one'
            )
            self.member.begin_counting_anew()  # what it has not sent yet is dropped

    def _gone(self, peer: Peer, now: float) -> bool:
        """Whether a node is silent and all that it simulates is left out: nobody waits for it."""
        if peer.presence.role != 'sim':
            return False
        self._silence.sources(now)
        sources = self.joined.settings.sources_of(peer.presence.node.rpartition('/')[2])
        absent = cast(Recorder, self.joined.core).absent
        return set(sources) <= absent and (peer.failed or self._silence.silent(peer, now))

    def _ask_again(self, lost: Collection[str]) -> None:
        """Ask those who publish on these topics for what was lost."""
        roles = {role for topic in lost for role in WRITERS[topic]}
        self._sweeper.ask(self._nodes(roles), lacking=True)
        self._sweeper.check()

    def settled(self, seconds: float) -> bool:
        """Whether all nodes have finished and all their records are in the bag.

        Raises:
            NodeError: a node has ended too early, or records never arrived.
        """
        member, traffic = self.member, self.member.traffic
        arrived_ = traffic.received + traffic.recovered
        missing = traffic.ledger.owed(member.all_published(), arrived_)
        traffic.lost_for_good = missing
        settled, member.doing = self._settling.check(missing, seconds, time.monotonic())
        if not settled:
            self._ask_again(missing)
        elif self._settling.without:
            self.log.warning(
                f'ends without {", ".join(self._settling.without)}: what was still to come from '
                'there is not in the bag'
            )
        return settled

    def close(self) -> None:
        """Finish the bag."""
        self._bag.close()

    def report(self) -> BagReport:
        """What was recorded, and where."""
        return self._bag.report()
