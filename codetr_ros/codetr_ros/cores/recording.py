"""The bag of a run in process: the records that a run over topics leaves, in the same form.

A record is written before anybody receives it, but for labels: the recorder's core has them first,
and states what the bag keeps of them. A commit is on the disk, with all that it names, before
anybody learns from it.
"""

import time
from collections import Counter
from pathlib import Path

from codetr_ros.bags.definitions import encode
from codetr_ros.bags.flushes import Flushes
from codetr_ros.bags.topics import RECORDED, topics_of_run
from codetr_ros.bags.writer import McapWriter, Written
from codetr_ros.config import Settings
from codetr_ros.records import TOPICS, Commit, Record
from codetr_ros.runs.reports import BagReport

KEEP_FREE = 64_000_000
"""Bytes to leave free on the disk, as a recorder's node does by default."""


class RunBag:
    """Writes the bag of a run in process.

    Args:
        folder: the bag; does not exist, or is empty, unless `written` is given.
        settings: of the run.
        namespace: in which its topics are.
        written: what the bag holds already, to go on with it.

    Raises:
        BagError: the folder holds something else, or cannot be made.
    """

    def __init__(
        self,
        folder: Path,
        settings: Settings,
        namespace: str,
        written: Written | None = None,
    ) -> None:
        self._topics = {kind: f'{namespace}/{TOPICS[kind]}' for kind in RECORDED}
        self._writer = McapWriter(
            folder, topics_of_run(self._topics, settings), keep_free=KEEP_FREE, written=written
        )
        self._flushes = Flushes()
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
        now = time.time_ns()
        self._writer.write(self._topics[type(record)], encode(record, now), now)
        if isinstance(record, Commit):
            with self._flushes.timed():
                self._writer.flush()
        self.seconds += time.perf_counter() - began

    def close(self) -> None:
        """Finish the bag."""
        self._writer.close()

    def report(self) -> BagReport:
        """What was recorded, and where."""
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
            flush_seconds=self._flushes.seconds,
            flush_ms=self._flushes.times(),
        )
