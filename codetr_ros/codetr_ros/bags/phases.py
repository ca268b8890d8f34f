"""Where the phases of a bag lie, so that any of them can be read again while it is written."""

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path

from codetr_ros.bags.definitions import decode
from codetr_ros.bags.errors import BagError, Place
from codetr_ros.bags.files import bag_files
from codetr_ros.bags.mcap_channels import McapChannels
from codetr_ros.bags.mcap_file import McapFile
from codetr_ros.bags.mcap_layout import summary_records
from codetr_ros.bags.raw import RawMessage
from codetr_ros.records import (
    Commit,
    CompositeReward,
    Policy,
    Preference,
    Record,
    TaskSpec,
    Transitions,
    TrueRewards,
)
from codetr_ros.records.fields import RECORD_TYPES, type_name
from codetr_ros.records.identity import identity
from codetr_ros.records.numbering import Judgement

NAMED = (Policy, Transitions, CompositeReward, Preference, Commit)
"""The kinds of records that belong to a phase by their number or by its commit."""
ON_REQUEST = (TrueRewards, TaskSpec)
"""Those that are read where they are asked for. True rewards may come late: those that came after
the commit are not among them. An announcement belongs to the phase that was committed next."""


@dataclass(frozen=True)
class _Phase:
    """A committed phase: its commit, the one before, the chunks that hold it, and the sources that
    announced themselves between the two.
    """

    commit: Commit
    before: Commit | None
    begin: Place
    end: Place
    announced: frozenset[str]

    def holds(self, record: Record) -> bool:
        """Whether a record belongs to the phase."""
        if isinstance(record, (Policy, Commit)):
            return record.phase == self.commit.phase
        if isinstance(record, TaskSpec):
            return record.source in self.announced
        if isinstance(record, (Transitions, TrueRewards)):
            of, name = ('sources', 'transitions'), record.source
        elif isinstance(record, Judgement):
            of, name = ('scorers', 'scores'), record.scorer
        else:
            return False
        last = _last(self.commit, *of, name)
        return _last(self.before, *of, name) < record.sequence <= last


class Phases:
    """Where the committed phases of a bag lie, and the newest policies.

    Takes about 1.6 KB for each phase, its commit. The bag is read from the chunk with the policy
    of a phase to that with its commit: in lock-step that phase, with overlap the one before, too.

    Attributes:
        newest: the last committed phase; None before the first.
    """

    def __init__(self) -> None:
        self._phases: dict[int, _Phase] = {}
        self._begins: dict[int, tuple[int, Place]] = {}  # of phases that are not committed
        # judgements that no commit has named: they may have come long before it
        self._judged: dict[tuple[str, int], tuple[int, Place]] = {}
        self._announced: dict[str, tuple[int, Place]] = {}  # since the last commit
        self._noted = 0  # records: puts places in the order of the bag
        self._described: dict[Path, McapChannels] = {}
        self.newest: int | None = None

    def note(self, record: Record, place: Place) -> None:
        """Note a record that was written, in the order of the bag.

        Args:
            record: the record.
            place: where the chunk begins in which it lies.
        """
        self._noted += 1
        if isinstance(record, (Policy, Transitions)):
            self._begins.setdefault(record.phase, (self._noted, place))
        elif isinstance(record, Judgement):
            self._judged.setdefault((record.scorer, record.sequence), (self._noted, place))
        elif isinstance(record, TaskSpec):
            self._announced.setdefault(record.source, (self._noted, place))
        elif isinstance(record, Commit) and record.phase not in self._phases:
            phase = record.phase
            before = self._phases.get(phase - 1)
            announced, self._announced = self._announced, {}
            begins = [
                self._begins.pop(phase, (self._noted, place)),
                *self._named(record),
                *announced.values(),
            ]
            self._phases[phase] = _Phase(
                record,
                None if before is None else before.commit,
                min(begins, key=lambda begin: begin[0])[1],
                place,
                frozenset(announced),
            )
            self.newest = phase

    def _named(self, commit: Commit) -> Iterator[tuple[int, Place]]:
        """Where the judgements lie that a commit is the first to name."""
        last = dict(zip(commit.scorers, commit.scores.tolist(), strict=True))
        for key in [key for key in self._judged if key[1] <= last.get(key[0], -1)]:
            yield self._judged.pop(key)

    def read(
        self, phase: int, kinds: Collection[str] = ()
    ) -> Iterator[tuple[type[Record], bytes]]:
        """Kind and bytes of each message that belongs to a committed phase, each once.

        Args:
            phase: the phase, which must be on the disk.
            kinds: types of the messages that are wanted; empty: all of `NAMED`.

        Raises:
            KeyError: the phase is not committed; the message names those that are.
            BagError: the bag cannot be read.
        """
        if phase not in self._phases:
            held = 'none yet' if self.newest is None else f'0 to {self.newest}'
            raise KeyError(f'phase {phase} is not committed; these are: {held}')
        known = (*NAMED, *ON_REQUEST) if kinds else NAMED
        wanted = {type_name(kind) for kind in known if not kinds or type_name(kind) in kinds}
        return self._read(self._phases[phase], wanted)

    def _read(self, phase: _Phase, wanted: set[str]) -> Iterator[tuple[type[Record], bytes]]:
        seen = set()
        for message in self._between(phase.begin, phase.end):
            kind = RECORD_TYPES.get(message.channel.type)
            if kind is None or (message.channel.type not in wanted and kind is not Commit):
                continue
            record = decode(kind, message.data)
            key = kind, identity(record)
            if phase.holds(record) and key not in seen:
                seen.add(key)
                if message.channel.type in wanted:
                    yield kind, bytes(message.data)
                if kind is Commit:
                    return  # a file that is still written to has no end behind it

    def _between(self, begin: Place, end: Place) -> Iterator[RawMessage]:
        """All messages from one chunk of the bag to another."""
        files = bag_files(end.file.parent, None)
        for path in files[files.index(begin.file) : files.index(end.file) + 1]:
            first = begin.offset if path == begin.file else 0
            file = McapFile(path, known=self._topics_of(path))
            for message in file.messages(Place(path, first)):
                if path == end.file and message.place.offset > end.offset:
                    return
                yield message

    def _topics_of(self, path: Path) -> McapChannels:
        """The topics of a file: our recorder describes all of them in the first chunk, other
        writers at the file's end.
        """
        if path not in self._described:
            file = McapFile(path)
            if next(file.messages(), None) is None:
                raise BagError(f'{path} holds no message any more: restore it from a copy')
            with path.open('rb') as stream:
                file.described.borrow(summary_records(stream, path.stat().st_size))
            self._described[path] = file.described
        return self._described[path]


def _last(commit: Commit | None, names: str, numbers: str, name: str) -> int:
    """The last number that a commit names of a source or scorer; -1 if it names none."""
    if commit is None or name not in getattr(commit, names):
        return -1
    return int(getattr(commit, numbers)[getattr(commit, names).index(name)])
