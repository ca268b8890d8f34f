"""The recorder of a simulated run: the real core, the real bag on a disk with troubles, and what a
real recorder decides.
"""

from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import cast

from codetr_ros.bags.topics import RECORDED, topics_of_run
from codetr_ros.cores.core import Core
from codetr_ros.cores.recorder import Recorder
from codetr_ros.nodes.asking import Answer, answer_to
from codetr_ros.nodes.keeping import Keeper, Keeping
from codetr_ros.nodes.kept_run import KeptRun
from codetr_ros.records import TOPICS, Commit, Record, RunSpec
from codetr_ros.records.digests import digest
from codetr_ros.simtest.asking import FetchRequest
from codetr_ros.simtest.disks import TroubledDisk
from codetr_ros.simtest.place import Place
from codetr_ros.simtest.process import Process

CHUNK_BYTES = 2048
"""So small that a phase has several chunks."""


class _Bag(KeptRun):
    """A bag that remembers what it was given.

    Attributes:
        history: kind and bytes of each message in it, in its order.
        commits: bytes of each commit in it, by its digest.
    """

    history: list[tuple[type, bytes]]
    commits: dict[str, bytes]

    def write(
        self, record: Record, data: bytes, log_time: int, published: int | None = None
    ) -> None:
        """Append a record."""
        super().write(record, data, log_time, published)
        self.remember(record, data)

    def remember(self, record: Record, data: bytes) -> None:
        """Note what is in the bag."""
        self.history.append((type(record), data))
        if isinstance(record, Commit):
            self.commits[digest(record)] = data


class Recording(Process):
    """The recorder: writes what arrives, and publishes a commit once it is on the disk.

    Attributes:
        disk: where its bag lies.
        bag: what it keeps.
        opened: whether the bag could be opened.

    Args:
        place: where it is.
        core: its core.
        folder: of the bag.
        disk: where it lies.
        leave_out_after: seconds of silence after which a source is left out; 0: never.
    """

    def __init__(
        self,
        place: Place,
        core: Core[Record],
        folder: Path,
        disk: TroubledDisk,
        leave_out_after: float,
    ) -> None:
        super().__init__(place, core)
        self.disk, self.opened = disk, False
        settings = place.settings
        names = {kind: f'/run/{TOPICS[kind]}' for kind in RECORDED}
        self.bag = _Bag(
            folder,
            dict(zip(RECORDED, topics_of_run(names, settings), strict=True)),
            settings.ahead + 2,
            settings.phase_steps,
            chunk_bytes=CHUNK_BYTES,
            disk=disk,
        )
        self.bag.history, self.bag.commits = [], {}
        # the newest commits are published again by a recorder that was started again
        self._commits: deque[Commit] = deque(maxlen=settings.ahead + 1)
        self._keeping = Keeping(
            Keeper(
                who=f'/{self.name}',
                run=place.run,
                settings=settings,
                core=cast(Recorder, core),
                bag=self.bag,
                traffic=self.traffic,
                peers=self.peers,
                limit=self.limit,
                leave_out_after=leave_out_after,
                make=self.make_asker,
                note_own=self.note_own,
                log=self.log,
                stamp=lambda: round(self.world.now * 1e9),
                clock=self.now,
            )
        )
        self.set_aside = self._keeping.early

    def open(self) -> None:
        """Open the bag.

        Raises:
            BagError: it cannot be written.
        """
        self.bag.open(self.run.run_id, self._hold_already)
        self.opened = True
        if not self.bag.recorded[TOPICS[RunSpec]]:
            self._write(self.run, self.message(self.run, self.stamp()))
        for commit in self._commits:
            self.publish(commit, self.message(commit, self.stamp()))

    def _hold_already(self, record: Record, data: bytes) -> None:
        self.bag.remember(record, data)
        if isinstance(record, Commit):
            self._commits.append(record)
        self._keeping.restore(record)

    def _write(self, record: Record, raw: bytes) -> None:
        self._keeping.write(record, raw)

    @property
    def without(self) -> list[str]:
        """Names of the nodes without which the run has ended."""
        return [who.rpartition('/')[2] for who in self._keeping.without]

    def go_on(self) -> None:
        """Ask all nodes for what was missed, if the bag was there before."""
        self._keeping.go_on()

    def take(self, kind: type, raw: bytes) -> None:
        """Take the bytes of a message: what is admitted is written as it came."""
        self._keeping.take(kind, raw)

    def answer(self, request: FetchRequest) -> Answer:
        """What the recorder answers: it sends a phase again from the bag."""
        bag = self.bag
        return answer_to(request.phase, request.kinds, bag.read, lambda: bag.newest, self.log)

    def deliver(self, record: Record) -> None:
        """Publish a record of the core; a commit only after all that it names is on the disk."""
        raw = self.message(record, self.stamp())
        if isinstance(record, Commit):
            self._write(record, raw)
            self.bag.flush()
        self.publish(record, raw)

    def held(self) -> None:
        """Ask all nodes for what was published while nothing was read."""
        self._keeping.held()

    def pauses(self) -> bool:
        """Whether what was missed is still being sent again."""
        return self._keeping.catches_up()

    def waits(self) -> str:
        """What the recorder waits for, in words. What was lost on the way is asked for again, and
        who is silent for too long is left out.
        """
        self._keeping.look_after()
        return super().waits()

    def asked_for(self) -> Mapping[str, float]:
        """Topics of what the recorder asks for: all that it records."""
        return self._keeping.asked_for

    def settled(self, seconds: float) -> bool:
        """Whether all nodes have finished and all their records are in the bag."""
        settled, self.doing = self._keeping.settled(seconds)
        return settled

    def leave(self) -> None:
        """End: all others have."""
        self.end()

    def close(self) -> None:
        """Finish the bag."""
        try:
            self.bag.close()
        except Exception as error:  # noqa: BLE001 - judged by the simulation
            self.error = self.error or error

    def die(self) -> None:
        """End at once: what was not handed to the system yet is lost."""
        super().die()
        self.disk.abandon()
