"""The recorder of a simulated run: the real core and the real bag, on a disk with troubles."""

from collections import Counter
from pathlib import Path
from typing import Any, cast

from codetr_ros.bags.definitions import encode
from codetr_ros.bags.topics import BagTopic
from codetr_ros.bags.writer import McapWriter
from codetr_ros.config import Settings
from codetr_ros.cores.beside import Beside, Early
from codetr_ros.cores.recorder import Recorder
from codetr_ros.nodes.last_phases import LastPhases
from codetr_ros.nodes.repeats import Repeats
from codetr_ros.nodes.settling import Settling, still_missing
from codetr_ros.nodes.silence import Silence
from codetr_ros.records import (
    TOPICS,
    Commit,
    EpisodeResult,
    Metrics,
    Presence,
    Record,
    RunSpec,
    TaskSpec,
)
from codetr_ros.records.fields import type_name
from codetr_ros.records.roles import published_by
from codetr_ros.simtest.disks import TroubledDisk
from codetr_ros.simtest.process import FetchAnswer, FetchRequest, Packet, Process

RECORDED = tuple(kind for kind in TOPICS if kind is not Presence)
CHUNK_BYTES = 2048
"""So small that a phase has several chunks."""


class Recording(Process):
    """The recorder: writes what arrives, and publishes a commit once it is on the disk."""

    def __init__(
        self,
        *given: Any,
        folder: Path,
        disk: TroubledDisk,
        settings: Settings,
        leave_out_after: float,
    ) -> None:
        super().__init__(*given)
        self.disk = disk
        self.recorded: Counter[str] = Counter()
        self.history: list[tuple[type, bytes]] = []  # what the bag holds, in its order
        self._silence = Silence(self.peers, settings, leave_out_after)
        self._full = {kind: f'/run/{TOPICS[kind]}' for kind in RECORDED}
        topics = [BagTopic(self._full[kind], type_name(kind), 16, False) for kind in RECORDED]
        self._bag = McapWriter(folder, topics, CHUNK_BYTES, keep_free=0, disk=disk)
        self._last = LastPhases(settings.ahead + 2)
        core = cast(Recorder, self.core)
        self._beside = Beside(self.run, settings, lambda: core.phase)
        self._early = Early(settings)
        self._repeats = Repeats()
        self._settling = Settling(f'/{self.name}', self.peers, self.limit)
        self._write(RunSpec, encode(self.run))

    def _write(self, kind: type, raw: bytes) -> None:
        self._bag.write(self._full[kind], raw, round(self.world.now * 1e9))
        self.recorded[TOPICS[kind]] += 1
        self.history.append((kind, raw))

    @property
    def without(self) -> list[str]:
        """Names of the nodes without which the run has ended."""
        return [who.rpartition('/')[2] for who in self._settling.without]

    def take(self, kind: type, raw: bytes) -> None:
        """Take the bytes of a message: what is admitted is written as it came."""
        record = self.traffic.decode(kind, raw)
        if record is not None:
            self._admit(record, raw)

    def _admit(self, record: Record, raw: bytes) -> None:
        if self._early.holds(record, raw):
            return
        beside = isinstance(record, (EpisodeResult, Metrics))
        ours = record.run_id == self.run.run_id
        if beside and ours and self._repeats.note(record):  # of a node that was started again
            self.core.duplicated[TOPICS[type(record)]] += 1
            return
        learnt_from = type(record) in self.core.subscribes
        if not self.traffic.receive(record, None if learnt_from else self._beside):
            return
        self._write(type(record), raw)
        self._last.hold(record, raw)
        if isinstance(record, TaskSpec):
            for waiting, data in self._early.announced(record.source):
                self._admit(waiting, data)

    def _take(self, packet: Packet) -> None:
        if isinstance(packet.data, FetchRequest):
            self._answer(packet.data)
        else:
            super()._take(packet)

    def _answer(self, request: FetchRequest) -> None:
        try:
            messages = self._last.get(request.phase)
        except KeyError as error:
            self.world.note(self.name, f'does not send again: {error.args[0]}')
            return
        answer = FetchAnswer(request.phase, messages)
        self.mail.send(self, request.requester, Packet(FetchAnswer, 0, answer))

    def deliver(self, record: Record) -> None:
        """Publish a record of the core; a commit only after all that it names is on the disk."""
        if not isinstance(record, Commit):
            super().deliver(record)
            return
        raw = encode(record, round(self.world.now * 1e9))
        self._write(Commit, raw)
        self._bag.flush()
        self._last.commit(record, raw)
        self.publish(record, raw)

    def _do_turn(self) -> float | None:
        silent = self._silence.sources(self.world.now)
        for source in cast(Recorder, self.core).leave_out(silent):
            self.world.note(self.name, f'leaves {source} out')
        return super()._do_turn()

    def settled(self, seconds: float) -> bool:
        """Whether all nodes have finished and all their records are in the bag."""
        ours = {t: n for t, n in self.published.items() if t in published_by(self.role)}
        commits = {TOPICS[Commit]: self.recorded[TOPICS[Commit]]}
        missing = still_missing(self.peers.published(), ours, self.traffic.received, commits)
        self.traffic.lost_for_good = missing
        settled, self.doing = self._settling.check(missing, seconds, self.world.now)
        return settled

    def end(self) -> None:
        """Finish the bag, then as all nodes."""
        try:
            self._bag.close()
        except Exception as error:  # noqa: BLE001 - judged by the simulation
            self.error = self.error or error
        super().end()
