"""What a recorder keeps of a run: its bag, if it has one, and what it can send again."""

from collections import Counter, defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator
from itertools import chain
from pathlib import Path

from codetr_ros.bags.definitions import decode
from codetr_ros.bags.errors import BagError, Damage
from codetr_ros.bags.flushes import Flushes
from codetr_ros.bags.phases import Phases
from codetr_ros.bags.raw import RawMessage
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.reopening import holds_messages, reopen
from codetr_ros.bags.topics import BagTopic
from codetr_ros.bags.writer import CHUNK_BYTES, McapWriter, Written
from codetr_ros.nodes.last_phases import LastPhases
from codetr_ros.nodes.repeats import Repeats
from codetr_ros.records import (
    TOPICS,
    Commit,
    EpisodeResult,
    Record,
    RecordError,
    RunSpec,
    TaskSpec,
)
from codetr_ros.records.fields import RECORD_TYPES, type_name
from codetr_ros.records.identity import phase_of
from codetr_ros.runs.reports import BagReport
from codetr_ros.system.disk import Disk


class KeptRun:
    """The records of a run, on the disk if there is a folder, else the last phases in memory.

    Attributes:
        recorded: counts of the records in it, by topic; in memory, of those that came.
        repeats: which records came before.
        gone_on: whether it was there before: its recorder was killed or stopped.

    Args:
        folder: of the bag; None: nothing is written.
        topics: what is written, by kind.
        phases: how many phases are held in memory where nothing is written.
        phase_steps: environment steps of a phase.
        split_bytes: size at which the next file is begun; 0: never.
        keep_free: bytes that are to be left on the disk.
        chunk_bytes: size at which a chunk of the bag is closed.
        disk: where it lies; None: the disk of this machine.
    """

    def __init__(
        self,
        folder: Path | None,
        topics: dict[type, BagTopic],
        phases: int,
        phase_steps: int,
        split_bytes: int = 0,
        keep_free: int = 0,
        chunk_bytes: int = CHUNK_BYTES,
        disk: Disk | None = None,
    ) -> None:
        self.folder = folder
        self.recorded: Counter[str] = Counter()
        self.repeats = Repeats()
        self.gone_on = False
        self._topics = topics
        self._split_bytes = split_bytes
        self._keep_free = keep_free
        self._chunk_bytes = chunk_bytes
        self._disk = disk
        self._phase_steps = phase_steps
        self._writer: McapWriter | None = None
        self._phases = Phases()
        # beside a bag only what no commit names yet: a robot that was killed asks for it
        self._last = LastPhases(phases if folder is None else 0)
        self._evaluations: dict[int, list[bytes]] = defaultdict(list)  # results, by version
        self._flushes = Flushes()

    def open(self, run_id: str, restore: Callable[[Record, bytes], None]) -> None:
        """Open the bag: a new one, or that of this run which is there, which is made whole first.

        Args:
            run_id: the run.
            restore: takes each record that the bag holds already, with its bytes.

        Raises:
            BagError: the bag is of another run or damaged, or cannot be written.
            RecordError: its commits contradict what they name.
        """
        if self.folder is None:
            return
        written = Written()
        if holds_messages(self.folder) and _run_in(self.folder) in (run_id, None):
            written = reopen(self.folder, lambda raw: self._restore(raw, restore), self._disk)
        self._writer = McapWriter(
            self.folder,
            self._topics.values(),
            self._chunk_bytes,
            split_bytes=self._split_bytes,
            keep_free=self._keep_free,
            written=written,
            disk=self._disk,
        )
        self.gone_on = bool(written.files)

    def _restore(self, raw: RawMessage, restore: Callable[[Record, bytes], None]) -> None:
        kind = RECORD_TYPES.get(raw.channel.type)
        if kind is None:
            return
        data = bytes(raw.data)
        try:
            record = decode(kind, data)
        except RecordError:  # it was refused when it came, too
            return
        self.recorded[TOPICS[kind]] += 1
        self.repeats.note(record)
        self._phases.note(record, raw.place)
        self._note(record, data)
        restore(record, data)

    @property
    def closed(self) -> bool:
        """Whether nothing can be written any more."""
        return self._writer is not None and self._writer.closed

    def write(
        self, record: Record, data: bytes, log_time: int, published: int | None = None
    ) -> None:
        """Append a record.

        Args:
            record: as it came.
            data: its message, or what is to be kept of it.
            log_time: when it came [ns].
            published: when it was published [ns].

        Raises:
            BagError: it cannot be written.
        """
        kind = type(record)
        self.recorded[TOPICS[kind]] += 1
        if self._writer is not None:
            place = self._writer.write(self._topics[kind].name, data, log_time, published)
            self._phases.note(record, place)
        self._note(record, data)

    def _note(self, record: Record, data: bytes) -> None:
        if isinstance(record, Commit):
            self._last.commit(record, data)
        else:
            self._last.hold(record, data)
        if isinstance(record, EpisodeResult) and record.purpose != 'training':
            phase = phase_of(record, self._phase_steps)
            assert phase is not None
            self._evaluations[phase].append(data)

    def check_room(self) -> None:
        """Raise an error while there is still room to close the bag properly.

        Raises:
            BagError: the disk has less room left than is to be kept.
        """
        if self._writer is not None:
            self._writer.check_room()

    def flush(self) -> None:
        """Wait until everything is on the disk.

        Raises:
            BagError: it cannot be written.
        """
        if self._writer is not None:
            with self._flushes.timed():
                self._writer.flush()

    # ---- sending again

    @property
    def newest(self) -> int | None:
        """The last committed phase; None before the first."""
        return self._last.newest if self.folder is None else self._phases.newest

    def read(self, phase: int, kinds: Collection[str] = ()) -> Iterable[tuple[type, bytes]]:
        """Kind and bytes of each message of a committed phase, and of the results of evaluations
        of the policy that was learnt from it where those are named. Of the phase after the last
        committed one, all that has come and that no commit names yet.

        Args:
            phase: the phase.
            kinds: types of the messages that are wanted; empty: all but results.

        Raises:
            KeyError: the phase is not held; the message names those that are.
            BagError: the bag cannot be read.
        """
        if phase == (-1 if self.newest is None else self.newest) + 1:
            return _of(self._last.open(), kinds)
        results = type_name(EpisodeResult)
        evaluations = self._evaluations.get(phase, []) if results in kinds else []
        found: Iterable[tuple[type, bytes]] = ((EpisodeResult, data) for data in evaluations)
        rest = [kind for kind in kinds if kind != results]
        if kinds and not rest:
            return found
        return chain(found, self._read(phase, rest))

    def _read(self, phase: int, kinds: Collection[str]) -> Iterator[tuple[type, bytes]]:
        if self.folder is not None:
            return self._phases.read(phase, kinds)
        return _of(self._last.get(phase), kinds)

    # ---- the end

    def close(self) -> None:
        """Finish the bag."""
        if self._writer is not None:
            self._writer.close()

    def report(self) -> BagReport:
        """What was recorded, and where."""
        return BagReport(
            recorded=dict(self.recorded),
            different=dict(self.repeats.different),
            bag=str(self.folder) if self._writer else None,
            bag_bytes=self._writer.size if self._writer else 0,
            flush_seconds=self._flushes.seconds,
            flush_ms=self._flushes.times(),
        )


def _of(
    messages: Iterable[tuple[type, bytes]], kinds: Collection[str]
) -> Iterator[tuple[type, bytes]]:
    """Messages of these types; all but announcements where none is named."""
    return (
        (kind, data)
        for kind, data in messages
        if (type_name(kind) in kinds if kinds else kind is not TaskSpec)
    )


def _run_in(folder: Path) -> str | None:
    """The id of the run that a bag begins with; None if it does not get so far.

    Raises:
        BagError: it cannot be read.
    """

    def pass_over(_: Damage) -> None:
        """Damage is reported where the bag is made whole."""

    for message in Bag(folder, pass_over).raw():
        if message.channel.type == type_name(RunSpec):
            record = decode(RunSpec, message.data)
            assert isinstance(record, RunSpec)
            return record.run_id
        raise BagError(
            f'bag {folder} exists and does not begin with a run: choose another folder, or remove '
            'it'
        )
    return None
