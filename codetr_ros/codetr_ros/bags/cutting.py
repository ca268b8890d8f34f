"""Cuts the bag of a run back to its last commit, so that the run can go on from there.

What nobody has learnt from is left out: all that lies behind the last commit, and what was early,
of phases without a commit. It is made again. The commit and all before it stay byte for byte. What
no commit waits for may have come late: it stays too, if it is in the file of the last commit.
"""

import os
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

from codetr_ros.bags.copying import NewFile
from codetr_ros.bags.definitions import decode, encode
from codetr_ros.bags.errors import BagError
from codetr_ros.bags.metadata import METADATA
from codetr_ros.bags.raw import LIBRARY, RawMessage
from codetr_ros.bags.reader import Bag
from codetr_ros.bags.reopening import PARTIAL, holds_messages, mend
from codetr_ros.records import (
    Commit,
    CompositeReward,
    EpisodeResult,
    Metrics,
    Policy,
    Record,
    RunSpec,
    StepRewards,
    Transitions,
    TrueRewards,
)
from codetr_ros.records.fields import RECORD_TYPES, type_name
from codetr_ros.system.files import sync_folder

_OF_PHASES = (Policy, Transitions, TrueRewards, StepRewards, Metrics)
_MAY_BE_LATE = (TrueRewards, EpisodeResult, Metrics)


@dataclass
class Cut:
    """What is left of a bag.

    Attributes:
        commit: its last; None if there is none, and the bag is left as it was.
        left_out: messages that were left out, by topic.
    """

    commit: Commit | None
    left_out: Counter[str] = field(default_factory=Counter)


def cut(
    folder: Path,
    announcement: Callable[[RunSpec], RunSpec] = lambda spec: spec,
    newest: int | None = None,
) -> Cut:
    """Cut a bag back to its last commit.

    If the machine stops meanwhile the bag has all commits up to that one, and can be cut again.

    Args:
        folder: the bag, with one run in it.
        announcement: what its announcement becomes: the same but for the steps of the run.
        newest: the last phase that may stay; None: all that are committed.

    Raises:
        BagError: the bag is damaged before its last commit.
        OSError: it cannot be written.
    """
    if not holds_messages(folder):
        return Cut(None)
    mend(folder)
    if not holds_messages(folder):
        return Cut(None)
    kept = _Kept(newest)
    for message in Bag(folder).raw():
        kept.look(message)
    if kept.commit is None:
        return Cut(None)
    (folder / METADATA).unlink(missing_ok=True)
    made = Cut(kept.commit)
    files = Bag(folder).files
    last = files.index(kept.file)
    for path in reversed(files[last + 1 :]):
        made.left_out += Counter(m.channel.topic for m in Bag(path).raw())
        path.unlink()
    sync_folder(folder)
    numbers: Counter[str] = Counter()
    for path in files[: last + 1]:
        _rewrite(path, kept, announcement, numbers, made.left_out)
    sync_folder(folder)
    return made


class _Kept:
    """Decides what stays."""

    def __init__(self, newest: int | None) -> None:
        self._newest = newest
        self.commit: Commit | None = None
        self.file = Path()
        self._at = 0  # messages of the file up to the commit
        self._count: Counter[Path] = Counter()
        self._open: dict[str, int] = {}  # of each source: its first episode without an end
        self._ends: list[Transitions] = []  # ends of episodes since the last commit

    def look(self, message: RawMessage) -> None:
        """Look at the next message, before any is decided on."""
        self._count[message.place.file] += 1
        if message.channel.type == type_name(Transitions):
            chunk = decode(Transitions, message.data)
            assert isinstance(chunk, Transitions)
            self._ends.append(chunk)
        elif message.channel.type == type_name(Commit):
            commit = decode(Commit, message.data)
            assert isinstance(commit, Commit)
            if self._newest is not None and commit.phase > self._newest:
                return
            self.commit, self.file = commit, message.place.file
            self._at = self._count[message.place.file]
            self._close(commit.phase)

    def _close(self, phase: int) -> None:
        for chunk in self._ends:
            if chunk.phase <= phase:
                ended = chunk.terminated or chunk.truncated
                self._open[chunk.source] = chunk.episode + ended
        self._ends = [chunk for chunk in self._ends if chunk.phase > phase]

    def stays(self, message: RawMessage, number: int) -> bool:
        """Whether a message stays.

        Args:
            message: of a file up to that with the commit.
            number: its own in the file, from 1.
        """
        kind = RECORD_TYPES.get(message.channel.type)
        if message.place.file == self.file and number > self._at:
            return kind in _MAY_BE_LATE and self._came_late(decode(kind, message.data))
        if kind is None or kind not in (*_OF_PHASES, CompositeReward, EpisodeResult):
            return True
        return self._belongs(decode(kind, message.data))

    def _came_late(self, record: Record) -> bool:
        """Whether a record behind the commit is of a simulator and of a phase that is committed:
        the simulator goes on behind it, and does not publish it again.
        """
        if isinstance(record, Metrics) and record.role != 'sim':
            return False
        if isinstance(record, EpisodeResult) and record.purpose != 'training':
            return False
        return self._belongs(record)

    def _belongs(self, record: Record) -> bool:
        """Whether a record is of a committed phase, or of none."""
        commit = self.commit
        assert commit is not None
        if isinstance(record, _OF_PHASES):
            return record.phase <= commit.phase
        if isinstance(record, CompositeReward):
            last = dict(zip(commit.scorers, commit.scores.tolist(), strict=True))
            return record.sequence <= int(last.get(record.scorer, -1))
        if isinstance(record, EpisodeResult) and record.purpose == 'training':
            return record.episode < self._open.get(record.source, 0)
        return True


def _rewrite(
    path: Path,
    kept: _Kept,
    announcement: Callable[[RunSpec], RunSpec],
    numbers: Counter[str],
    left_out: Counter[str],
) -> None:
    """Replace a file by one with what stays of it, unless all of it does."""
    changed = False
    for message, stays, announced in _decided(path, kept, announcement):
        changed |= not stays or announced is not None
        left_out[message.channel.topic] += not stays
    if not changed:
        numbers += Counter(m.channel.topic for m in Bag(path).raw())
        return
    partial = path.with_name(f'.{path.name}{PARTIAL}')
    new = NewFile(partial, LIBRARY)
    try:
        for message, stays, announced in _decided(path, kept, announcement):
            if stays:
                data = message.data if announced is None else announced
                topic = message.channel.topic
                new.add(message._replace(data=data, sequence=numbers[topic]))
                numbers[topic] += 1
        new.finish()
    finally:
        new.close()
    os.replace(partial, path)


def _decided(
    path: Path, kept: _Kept, announcement: Callable[[RunSpec], RunSpec]
) -> Iterator[tuple[RawMessage, bool, bytes | None]]:
    """Each message of a file, whether it stays, and what takes its place if anything does."""
    for number, message in enumerate(Bag(path).raw(), 1):
        announced = None
        if message.channel.type == type_name(RunSpec):
            spec = decode(RunSpec, message.data)
            assert isinstance(spec, RunSpec)
            if (new := announcement(spec)) is not spec:
                announced = encode(new, message.publish_time)
        yield message, kept.stays(message, number), announced


def announced(folder: Path) -> RunSpec | None:
    """The announcement of the run in a bag that may lack its end; None if there is none.

    Raises:
        BagError: the bag holds several runs.
    """
    if not holds_messages(folder):
        return None
    found: RunSpec | None = None
    for entry in Bag(folder, lambda damage: None).entries({RunSpec}):
        assert isinstance(entry.record, RunSpec)
        if found is not None and found.run_id != entry.record.run_id:
            raise BagError(
                f'bag {folder} holds runs {found.run_id!r} and {entry.record.run_id!r}: only a '
                'run with a bag of its own can go on'
            )
        found = entry.record
    return found
