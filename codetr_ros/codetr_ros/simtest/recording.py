"""The recorder of a simulated run: the real core and the real bag, on a disk with troubles."""

from collections import Counter
from pathlib import Path
from typing import Any

from codetr_ros.bags.definitions import decode, encode
from codetr_ros.bags.topics import BagTopic
from codetr_ros.bags.writer import McapWriter
from codetr_ros.nodes.last_phases import LastPhases
from codetr_ros.nodes.settling import Settling, still_missing
from codetr_ros.records import TOPICS, Commit, Presence, Record, RecordError, RunSpec
from codetr_ros.records.checks import check_run
from codetr_ros.records.fields import type_name
from codetr_ros.records.roles import published_by
from codetr_ros.simtest.disks import TroubledDisk
from codetr_ros.simtest.process import FetchAnswer, FetchRequest, Packet, Process

RECORDED = tuple(kind for kind in TOPICS if kind is not Presence)
CHUNK_BYTES = 2048
"""So small that a phase has several chunks."""


class Recording(Process):
    """The recorder: writes what arrives, and publishes a commit once it is on the disk."""

    def __init__(self, *given: Any, folder: Path, disk: TroubledDisk, lag: int) -> None:
        super().__init__(*given)
        self.disk = disk
        self.recorded: Counter[str] = Counter()
        self._full = {kind: f'/run/{TOPICS[kind]}' for kind in RECORDED}
        topics = [BagTopic(self._full[kind], type_name(kind), 16, False) for kind in RECORDED]
        self._bag = McapWriter(folder, topics, CHUNK_BYTES, keep_free=0, disk=disk)
        self._last = LastPhases(lag + 2)
        self._settling = Settling(f'/{self.name}', self.peers, self.limit)
        self._write(RunSpec, encode(self.run))

    def _write(self, kind: type, raw: bytes) -> None:
        self._bag.write(self._full[kind], raw, round(self.world.now * 1e9))
        self.recorded[TOPICS[kind]] += 1

    def take(self, kind: type, raw: bytes) -> bool:
        """Write the bytes of a message, and hand the record to the core."""
        if kind in self.core.subscribes:
            taken = super().take(kind, raw)
        else:
            self.traffic.received[TOPICS[kind]] += 1
            taken = self._is_ours(kind, raw)
        if taken:
            self._write(kind, raw)
            self._last.hold(decode(kind, raw), raw)
        return taken

    def _is_ours(self, kind: type, raw: bytes) -> bool:
        try:
            check_run(decode(kind, raw), self.run)
        except RecordError as error:
            self.traffic.refuse(kind, error)
            return False
        return True

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
