"""The recorder's wiring: writes what arrives as it came, and commits phases.

Everything of the run is appended to the bag as received bytes before the core sees it, sound or
not. A commit goes into the bag after all that it names, and out to the nodes only when the bag is
flushed and synced: nobody learns from what could be lost, and the bag says of every phase that
anybody has learnt from what belongs to it. What belongs to another run is refused and not
recorded. The last phases are kept in memory too, and the service `fetch_phase` sends one of them
again.
"""

import time
from collections import Counter, deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rclpy.serialization import deserialize_message, serialize_message

from codetr_ros.bags.first_labels import FirstLabels
from codetr_ros.bags.topics import BagTopic
from codetr_ros.bags.writer import McapWriter
from codetr_ros.config import Settings
from codetr_ros.records import TOPICS, Commit, Presence, Record, RecordError, RunSpec, StepRewards
from codetr_ros.records.checks import check_run
from codetr_ros.records.roles import published_by
from codetr_ros.ros import messages, qos
from codetr_ros.ros.node import CoreNode, MakeCore
from codetr_ros.ros.resend import Resender
from codetr_ros.ros.signals import Stop
from codetr_ros.runs import folder as run_folder
from codetr_ros.runs.reports import BagReport, FlushTimes

NOT_RECORDED = (Presence,)
"""Says who is alive, once a second: nothing of the run itself."""
FLUSHES = 1000
"""Flushes of which the report gives the median: the newest."""


class RecordNode(CoreNode):
    """The recorder's core, wired to ROS and to a bag."""

    def __init__(
        self, role: str, name: str, load_core: Callable[[], MakeCore], stop: Stop
    ) -> None:
        super().__init__(role, name, load_core, stop)
        self._bag: McapWriter | None = None
        self._run_message: bytes | None = None
        self._full: dict[type, str] = {}
        self._recorded: Counter[str] = Counter()
        self._missed: dict[str, int] = {}
        self._flush_seconds = self._longest_flush = 0.0
        self._flushes: deque[float] = deque(maxlen=FLUSHES)  # seconds, the newest

    def open_topics(self, settings: Settings) -> None:
        """Open the bag, then subscribe to everything as raw bytes."""
        node = self.link.node
        self._first = FirstLabels(settings) if settings.record_relabels == 'first' else None
        kinds = [kind for kind in TOPICS if kind not in NOT_RECORDED]
        self._full = {kind: node.resolve_topic_name(TOPICS[kind]) for kind in kinds}
        folder = (
            Path(self.values['bag'])
            if self.values['bag']
            else self.folder and self.folder / run_folder.BAG
        )
        if folder:
            self._bag = McapWriter(
                folder,
                [self._bag_topic(kind, settings) for kind in kinds],
                split_bytes=round(self.values['bag_split_mb'] * 1e6),
                keep_free=round(self.values['bag_keep_free_mb'] * 1e6),
            )
            self.log.info(f'records to {folder}')
        assert self._run_message is not None
        self._write(RunSpec, self._run_message)
        for kind in kinds:
            if kind not in (RunSpec, Commit):  # the one has come, the other is our own
                self.link.subscribe(kind, self._take_raw, settings, raw=True)
        assert self.run_spec is not None
        self._last = Resender(self.link, self.run_spec.run_id, settings.lag + 2)

    def _bag_topic(self, kind: type, settings: Settings) -> BagTopic:
        topic = TOPICS[kind]
        durable = qos.QUALITIES[topic].transient_local
        return BagTopic(
            self._full[kind], messages.type_name(kind), qos.depth(topic, settings), durable
        )

    def _take(self, record_type: type, message: Any) -> None:
        joined = self.run_spec is not None
        super()._take(record_type, message)
        if not joined and self.run_spec is not None:
            self._run_message = serialize_message(message)

    def _take_raw(self, kind: type, raw: bytes) -> None:
        self.received[TOPICS[kind]] += 1
        if self._bag is not None and self._bag.closed:
            return  # stopped: others may still speak
        message = deserialize_message(raw, messages.message_type(kind))
        published = message.stamp.sec * 10**9 + message.stamp.nanosec
        assert self.run_spec is not None
        try:
            record = messages.from_message(message)
            check_run(record, self.run_spec)
        except RecordError as error:
            if message.run_id == self.run_spec.run_id:
                self._write(kind, raw, published)  # the bag tells what came, sound or not
            self.refuse(kind, error)
            return
        kept = (
            self._first.keep(record) if self._first and isinstance(record, StepRewards) else None
        )
        if kept is None:
            self._write(kind, raw, published)
        else:
            self._write(
                kind, serialize_message(messages.to_message(kept, message.stamp)), published
            )
        if self.core is None or kind not in self.core.subscribes:
            return
        if self._receive(record):
            self._last.hold(record, raw)

    def _write(self, kind: type, raw: bytes, published: int | None = None) -> None:
        now = self.link.node.get_clock().now().nanoseconds
        if self._bag is not None:
            self._bag.write(self._full[kind], raw, now, published)
        self._recorded[TOPICS[kind]] += 1

    def deliver(self, record: Record) -> None:
        """Pass on a record of the core; a commit only once what it names is on the disk."""
        if not isinstance(record, Commit):
            super().deliver(record)
            return
        if self._bag is not None:
            self._bag.check_room()
        message = self.link.message(record)
        raw = serialize_message(message)
        self._write(Commit, raw)
        if self._bag is not None:
            began = time.perf_counter()
            self._bag.flush()
            seconds = time.perf_counter() - began
            self._flushes.append(seconds)
            self._flush_seconds += seconds
            self._longest_flush = max(self._longest_flush, seconds)
        self._last.commit(record, raw)
        self.link.send(TOPICS[Commit], message)

    def _still_missing(self) -> dict[str, int]:
        told = self.peers.told()
        told.update({t: n for t, n in self.link.published.items() if t in published_by(self.role)})
        arrived = self.received + Counter({TOPICS[Commit]: self._recorded[TOPICS[Commit]]})
        return {
            topic: n - arrived[topic] for topic, n in sorted(told.items()) if n > arrived[topic]
        }

    def settled(self, seconds: float) -> bool:
        """Whether everybody has finished and all that they published is in the bag."""
        running = [
            f'{p.said.role} {p.said.node}' for p in self.peers.newest() if not p.said.finished
        ]
        self._missed = self._still_missing()
        if not running and not self._missed:
            return True
        lacking = [f'{n} of {topic}' for topic, n in self._missed.items()]
        self._doing = (
            f'waits for the end of {", ".join(running) or "nobody"} '
            f'and for {", ".join(lacking) or "nothing"}'
        )
        deadline = self.values['peer_deadline']
        # somebody who still speaks may work as long as it takes
        heard = max((p.heard for p in self.peers.by_instance.values()), default=0.0)
        silent = time.monotonic() - heard
        if deadline and min(seconds, silent) > deadline:
            self.log.error(f'gave up after {deadline:g} s: {self._doing}')
            return True
        return False

    def lost(self) -> dict[str, int]:
        """Records that were published and never came, by topic: for certain at the end, before as
        others see it.
        """
        return self._missed if self.core and self.core.finished else super().lost()

    def closing(self) -> None:
        """Finish the bag."""
        if self._bag is not None:
            self._bag.close()

    def own_report(self) -> BagReport:
        """What was recorded, and where."""
        median = 1e3 * sorted(self._flushes)[len(self._flushes) // 2] if self._flushes else 0.0
        return BagReport(
            recorded=dict(self._recorded),
            bag=str(self._bag.folder) if self._bag else None,
            bag_bytes=self._bag.size if self._bag else 0,
            flush_seconds=self._flush_seconds,
            flush_ms=FlushTimes(median=median, max=1e3 * self._longest_flush),
        )
