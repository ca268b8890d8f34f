"""The recorder's wiring: writes messages as they arrive, and commits phases.

Every message that is admitted goes into the bag as received bytes; what is refused does not, or a
bag could hold what nobody has learnt from. A commit goes into the bag after all records that it
names, and out to the nodes only after the bag is flushed and synced. So nobody learns from what
could be lost, and the bag names the records of every phase that anybody has learnt from. The last
phases stay in memory too: the service `fetch_phase` sends one of them again.
"""

import time
from collections import Counter, deque
from pathlib import Path
from typing import cast

from codetr_ros.bags.definitions import encode, stamp_of
from codetr_ros.bags.topics import topics_of_run
from codetr_ros.bags.writer import McapWriter
from codetr_ros.cores.beside import Beside, Early
from codetr_ros.cores.recorder import Recorder
from codetr_ros.nodes.settling import Settling, still_missing
from codetr_ros.records import (
    TOPICS,
    Commit,
    Presence,
    Record,
    RecordError,
    RunSpec,
    StepRewards,
    TaskSpec,
)
from codetr_ros.records.roles import published_by
from codetr_ros.ros.joining import Joined
from codetr_ros.ros.membership import Membership
from codetr_ros.ros.resend import Resender
from codetr_ros.ros.wiring import Wiring
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.reports import BagReport, FlushTimes

NOT_RECORDED = (Presence,)
"""Published once a second to show that a node is alive: no part of the run itself."""
FLUSHES = 1000
"""Number of the newest flushes, whose median the report gives."""


class Recording(Wiring):
    """The wiring of the recorder's core: to a bag, and to all topics."""

    def __init__(self, member: Membership, joined: Joined) -> None:
        super().__init__(member, joined)
        settings, node = joined.settings, member.link.node
        kinds = [kind for kind in TOPICS if kind not in NOT_RECORDED]
        self._full = {kind: node.resolve_topic_name(TOPICS[kind]) for kind in kinds}
        core = cast(Recorder, joined.core)
        self._beside = Beside(joined.run, settings, lambda: core.phase)
        self._early = Early(settings)
        self._bag: McapWriter | None = None
        self._recorded: Counter[str] = Counter()
        self._settling = Settling(member.link.full_name, member.peers, member.limit)
        self._flush_seconds = self._longest_flush = 0.0
        self._flushes: deque[float] = deque(maxlen=FLUSHES)  # seconds, the newest

    def open(self) -> None:
        """Open the bag, then subscribe to everything as raw bytes."""
        settings, link = self.joined.settings, self.member.link
        folder = self._bag_folder()
        if folder:
            self._bag = McapWriter(
                folder,
                topics_of_run(self._full, settings),
                split_bytes=round(self.member.values['bag_split_mb'] * 1e6),
                keep_free=round(self.member.values['bag_keep_free_mb'] * 1e6),
            )
            self.log.info(f'records to {folder}')
        self._write(RunSpec, self.member.announcement)
        for kind in self._full:
            if kind not in (RunSpec, Commit):  # the first has arrived, the second is our own
                link.subscribe(kind, self.take, settings)
        self._last = Resender(link, self.joined.run.run_id, settings.ahead + 2)

    def _bag_folder(self) -> Path | None:
        if self.member.values['bag']:
            return Path(self.member.values['bag'])
        return self.joined.folder and self.joined.folder / run_folder.BAG

    def take(self, kind: type, raw: bytes) -> None:
        """Take the bytes of a message: what is admitted is written as it came."""
        record = self.member.traffic.decode(kind, raw)
        if self._bag is not None and self._bag.closed:
            return  # stopped, while others may still publish
        if record is not None:
            self._take(record, raw)

    def _take(self, record: Record, raw: bytes) -> None:
        traffic = self.member.traffic
        try:
            if self._early.holds(record, raw):
                return
        except RecordError as error:
            traffic.refuse(type(record), error)
            return
        core = self.joined.core
        learnt_from = type(record) in core.subscribes
        if not traffic.receive(record, None if learnt_from else self._beside):
            return
        self._write(type(record), self._kept(record, raw), stamp_of(raw))
        self._last.hold(record, raw)
        if isinstance(record, TaskSpec):
            for waiting, data in self._early.announced(record.source):
                self._take(waiting, data)

    def _kept(self, record: Record, raw: bytes) -> bytes:
        """The bytes that the bag keeps of a message: all, or only the first labels if so set."""
        if not isinstance(record, StepRewards):
            return raw
        kept = cast(Recorder, self.joined.core).kept(record)
        return raw if kept is record else encode(kept, stamp_of(raw))

    def _write(self, kind: type, raw: bytes, published: int | None = None) -> None:
        now = self.member.link.node.get_clock().now().nanoseconds
        if self._bag is not None:
            self._bag.write(self._full[kind], raw, now, published)
        self._recorded[TOPICS[kind]] += 1

    def deliver(self, given: Record) -> None:
        """Publish a record of the core; a commit only after all that it names is on the disk."""
        link = self.member.link
        if not isinstance(given, Commit):
            super().deliver(given)
            return
        if self._bag is not None:
            self._bag.check_room()
        raw = link.message(given)
        self._write(Commit, raw)
        if self._bag is not None:
            began = time.perf_counter()
            self._bag.flush()
            seconds = time.perf_counter() - began
            self._flushes.append(seconds)
            self._flush_seconds += seconds
            self._longest_flush = max(self._longest_flush, seconds)
        self._last.commit(given, raw)
        link.send(TOPICS[Commit], raw)

    def settled(self, seconds: float) -> bool:
        """Whether all nodes have finished and all their records are in the bag.

        Raises:
            NodeError: a node has ended too early, or records never arrived.
        """
        member = self.member
        ours = {t: n for t, n in member.link.published.items() if t in published_by(member.role)}
        commits = {TOPICS[Commit]: self._recorded[TOPICS[Commit]]}
        missing = still_missing(member.peers.published(), ours, member.traffic.received, commits)
        member.traffic.lost_for_good = missing
        settled, member.doing = self._settling.check(missing, seconds, time.monotonic())
        return settled

    def close(self) -> None:
        """Finish the bag."""
        if self._bag is not None:
            self._bag.close()

    def report(self) -> BagReport:
        """What was recorded, and where."""
        median = 1e3 * sorted(self._flushes)[len(self._flushes) // 2] if self._flushes else 0.0
        return BagReport(
            recorded=dict(self._recorded),
            bag=str(self._bag.folder) if self._bag else None,
            bag_bytes=self._bag.size if self._bag else 0,
            flush_seconds=self._flush_seconds,
            flush_ms=FlushTimes(median=median, max=1e3 * self._longest_flush),
        )
