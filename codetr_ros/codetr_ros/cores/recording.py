"""The bag of a run in process: the records that a run over topics leaves, in the same form.

A record is written before anybody receives it. A commit is on the disk, with all that it names,
before anybody learns from it.
"""

import time
from collections import Counter, deque
from pathlib import Path

from codetr_ros.bags.definitions import encode
from codetr_ros.bags.first_labels import FirstLabels
from codetr_ros.bags.topics import topics_of_run
from codetr_ros.bags.writer import McapWriter, Written
from codetr_ros.config import Settings
from codetr_ros.records import TOPICS, Commit, Presence, Record, StepRewards
from codetr_ros.runs.reports import BagReport, FlushTimes

NOT_RECORDED = (Presence,)
"""Published once a second to show that a node is alive: no part of the run itself."""
KEEP_FREE = 64_000_000
"""Bytes to leave free on the disk, as a recorder's node does by default."""


class RunBag:
    """Writes the bag of a run in process.

    Args:
        folder: the bag; does not exist, or is empty, unless `written` is given.
        settings: of the run.
        namespace: in which its topics are.
        written: what the bag holds already, to go on with it.
        first: knows the labels that it holds, if it keeps only the first ones.

    Raises:
        BagError: the folder holds something else, or cannot be made.
    """

    def __init__(
        self,
        folder: Path,
        settings: Settings,
        namespace: str,
        written: Written | None = None,
        first: FirstLabels | None = None,
    ) -> None:
        kinds = [kind for kind in TOPICS if kind not in NOT_RECORDED]
        self._topics = {kind: f'{namespace}/{TOPICS[kind]}' for kind in kinds}
        self._writer = McapWriter(
            folder, topics_of_run(self._topics, settings), keep_free=KEEP_FREE, written=written
        )
        self._first: FirstLabels | None = None
        if settings.record_relabels == 'first':
            self._first = first or FirstLabels(settings)
        self._flushes: deque[float] = deque(maxlen=1000)  # seconds, the newest
        self.seconds = 0.0
        """That all of this took."""

    def write(self, record: Record) -> None:
        """Write a record; a commit is then on the disk, with all before it.

        Raises:
            BagError: it cannot be written.
        """
        began = time.perf_counter()
        if isinstance(record, Commit):
            self._writer.check_room()
        kept = record
        if self._first is not None and isinstance(record, StepRewards):
            kept = self._first.keep(record) or record
        now = time.time_ns()
        self._writer.write(self._topics[type(record)], encode(kept, now), now)
        if isinstance(record, Commit):
            flushing = time.perf_counter()
            self._writer.flush()
            self._flushes.append(time.perf_counter() - flushing)
        self.seconds += time.perf_counter() - began

    def close(self) -> None:
        """Finish the bag."""
        self._writer.close()

    def report(self) -> BagReport:
        """What was recorded, and where."""
        flushes = sorted(self._flushes)
        return BagReport(
            recorded=dict(
                Counter(
                    {
                        TOPICS[kind]: self._writer.counts[topic]
                        for kind, topic in self._topics.items()
                        if self._writer.counts[topic]
                    }
                )
            ),
            bag=str(self._writer.folder),
            bag_bytes=self._writer.size,
            flush_seconds=sum(flushes),
            flush_ms=FlushTimes(
                median=1e3 * flushes[len(flushes) // 2] if flushes else 0.0,
                max=1e3 * max(flushes, default=0.0),
            ),
        )
