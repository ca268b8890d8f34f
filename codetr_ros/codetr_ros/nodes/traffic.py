"""Decodes what arrives at a node, hands it to the node's core, and counts it."""

import time
from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any, Protocol

from codetr_ros.bags.definitions import decode_sent, sender_of, stamp_of
from codetr_ros.config import Settings
from codetr_ros.cores.core import Core, Silent
from codetr_ros.nodes.admission import Admission, Unknown
from codetr_ros.nodes.ledger import Ledger
from codetr_ros.nodes.peers import Peer
from codetr_ros.records import (
    TOPICS,
    Commit,
    CompositeReward,
    Policy,
    Preference,
    Presence,
    Record,
    RecordError,
    RunSpec,
    StepRewards,
    Transitions,
    describe,
)
from codetr_ros.records.bounds import LONGEST_NAME, check_bounds
from codetr_ros.records.checks import check_phase
from codetr_ros.records.shown import LONGEST_LINE, shown, worth_a_line

KEPT_BYTES = 16 << 20
"""The most bytes that are kept of messages whose senders wait for their place."""
KEPT_SECONDS = 10.0
"""How long they are kept."""
PHASED = (Policy, Transitions, Commit, StepRewards)
"""Kinds of records of a phase that must have been permitted."""
HELD_BACK = (*PHASED, CompositeReward, Preference)
"""Kinds of records that a node which joins late may fetch again: what it took before would be
counted as duplicated."""
LATE_COMMITS = 16
MOST_HELD = 4096
"""Records that are held back while a node joins."""


def arrived(kind: type, data: bytes) -> tuple[Record, str]:
    """The record in the bytes of a message from anywhere, and who sent it.

    Args:
        kind: what its topic carries.
        data: CDR.

    Raises:
        RecordError: the bytes are no such message, its lengths disagree, or a name, size or count
            in it is beyond all bounds.
    """
    record, sender = decode_sent(kind, data)
    if len(sender) > LONGEST_NAME or not sender.isprintable():
        raise RecordError(
            f'{kind.__name__}.sender is {shown(repr(sender))}: it must be at most {LONGEST_NAME} '
            'printable characters'
        )
    check_bounds(record)
    return record, sender


Again = Callable[[type, bytes], None]
"""Takes the bytes of a message of a kind."""


@dataclass(frozen=True)
class _Kept:
    """A message whose sender waits for its place."""

    sender: str
    at: float  # monotonic time [s]
    kind: type
    data: bytes
    again: Again
    error: RecordError  # why it is refused in the end


class Taker(Protocol):
    """What takes records in: a core, or a part of one."""

    @property
    def duplicated(self) -> 'Counter[str]':
        """Counts of records that arrived again and were dropped, by topic."""

    def receive(self, record: Record) -> None:
        """Take a record.

        Raises:
            RecordError: it must be refused; nothing has changed then.
        """


class Traffic:
    """Decodes messages, hands their records to the node's core and counts them, by topic.

    Attributes:
        core: takes the records; a silent one until the node has joined.
        settings: those of the run, once it is known.
        run_id: the run, once it is known.
        admission: decides whose messages are taken.
        received: messages of this run that arrived, sound or not.
        refused: those of them that were refused.
        recovered: records that had not arrived, and did when they were fetched again.
        ledger: counts what peers have published and what of it has arrived.
        lost_for_good: records that will not arrive any more, once that is certain.
        early: takes a record of a phase that cannot have begun yet, with the reason for which it
            would be refused; returns whether it holds it. None: all of them are refused.

    Args:
        log: the node's logger.
        clock: monotonic time [s].
        admission: decides whose messages are taken; None: of whoever has joined.
    """

    def __init__(
        self,
        log: Any,
        clock: Callable[[], float] = time.monotonic,
        admission: Admission | None = None,
    ) -> None:
        self._log = log
        self._clock = clock
        self.core: Core[Any] = Silent()
        self.settings: Settings | None = None
        self.run_id = ''
        self.admission = admission or Admission(TOPICS.__getitem__, None, lambda: 0.0)
        self._kept: list[_Kept] = []
        self.received: Counter[str] = Counter()
        self.refused: Counter[str] = Counter()
        self.recovered: Counter[str] = Counter()
        self.ledger = Ledger()
        self.lost_for_good: dict[str, int] | None = None
        self.early: Callable[[Record, RecordError], bool] | None = None
        self._held: list[Record] | None = None

    def hold(self) -> None:
        """Hold back records of phases until it is certain which phase is the next one here."""
        self._held = []

    def release(self, later: Callable[[Record], bool] = lambda record: False) -> None:
        """Hand over what was held back, and what comes from now on.

        Args:
            later: whether a record is fetched again when its turn has come: it is let go.
        """
        held, self._held = self._held or [], None
        for record in held:
            if not later(record):
                self.receive(record)

    def _holds_back(self, record: Record) -> bool:
        if self._held is None or not isinstance(record, HELD_BACK):
            return False
        if len(self._held) >= MOST_HELD:
            raise RecordError(
                f'{describe(record)} came before this node had joined, when {MOST_HELD} others '
                'waited for that already: what it lacks is fetched again'
            )
        self._held.append(record)
        return True

    def decode(self, kind: type, data: bytes, again: Again | None = None) -> Record | None:
        """The record in a message that arrived; None if it is refused, which is counted, or kept
        until its sender has its place.

        Args:
            kind: what its topic carries.
            data: CDR.
            again: takes the message again, once its sender has its place; None: it is not kept.
        """
        try:
            self.admission.check_signature(kind, data)
        except RecordError as error:  # nothing that counts for anything
            self.refuse(kind, error)
            return None
        now = self._clock()
        ours = kind not in (Presence, RunSpec)  # of which nothing is missed
        record, sender = None, ''
        try:
            record, sender = arrived(kind, data)
            # what is of another run must not stand in for what is lost of this one
            ours = ours and self.run_id in ('', record.run_id)
            self.admission.admit(record, sender, data, now)
        except Unknown as error:
            ours = False
            if again is None or not self._keep(_Kept(sender, now, kind, data, again, error)):
                self.refuse(kind, error)
            return None
        except RecordError as error:
            self.refuse(kind, error)
            return None
        finally:
            if ours:
                self.received[TOPICS[kind]] += 1  # sound or not, it is not lost
                sender = sender or sender_of(kind, data)
                if sender:
                    self.ledger.arrived(record or kind, sender, stamp_of(data))
        if kind is Presence:
            self._take_kept(sender)
        return record

    def _keep(self, message: '_Kept') -> bool:
        held = sum(len(each.data) for each in self._kept)
        if message.kind is Presence or held + len(message.data) > KEPT_BYTES:
            return False
        self._kept.append(message)
        return True

    def _take_kept(self, sender: str) -> None:
        """Take what a process published before it got its place."""
        mine = [each for each in self._kept if each.sender == sender]
        self._kept = [each for each in self._kept if each.sender != sender]
        for each in mine:
            each.again(each.kind, each.data)

    def expire(self) -> None:
        """Refuse what was kept for a sender that got no place in time."""
        due = self._clock() - KEPT_SECONDS
        late = [each for each in self._kept if each.at < due]
        self._kept = [each for each in self._kept if each.at >= due]
        for each in late:
            self.refuse(each.kind, each.error)

    def receive(self, record: Record, taker: Taker | None = None) -> bool:
        """Hand a record to the core, or to another taker; returns whether it was new and taken."""
        taker = self.core if taker is None else taker
        before = taker.duplicated.total()
        try:
            if self._holds_back(record):
                return True
            if not self._came_early(record):
                taker.receive(record)
        except RecordError as error:
            self.refuse(type(record), error)
            return False
        return taker.duplicated.total() == before

    def _came_early(self, record: Record) -> bool:
        """Whether a record of a phase that cannot have begun yet is held by `early`.

        Raises:
            RecordError: it is of such a phase, and is not held.
        """
        due, settings = self.core.due, self.settings
        if due is None or settings is None or not isinstance(record, PHASED):
            return False
        # so many commits reach a node that was started again and takes in earlier phases
        late = LATE_COMMITS if isinstance(record, Commit) else 0
        if (permitted := self.core.permitted) is not None:
            # it goes on from a checkpoint, and takes the phases up to that in once more
            due = max(due, permitted - settings.ahead)
        try:
            check_phase(record, due + late, settings)
        except RecordError as error:
            if self.early is None or not self.early(record, error):
                raise
            return True
        return False

    def fetched(self, kind: type, data: bytes) -> Record:
        """The record in a message that was fetched again.

        Raises:
            RecordError: it is no message, is not signed, or its sender may not publish it.
        """
        return self._fetched(kind, data)[0]

    def _fetched(self, kind: type, data: bytes) -> tuple[Record, str]:
        self.admission.check_signature(kind, data)
        record, sender = arrived(kind, data)
        self.admission.check_again(record, sender)
        return record, sender

    def sent_again(self, kind: type, data: bytes) -> Record:
        """The record in a message that was fetched again: it counts as one that has arrived.

        Raises:
            RecordError: it is no message, is not signed, or its sender may not publish it.
        """
        record, sender = self._fetched(kind, data)
        self.ledger.sent_again(record, sender, stamp_of(data))
        return record

    def take_again(self, kind: type, data: bytes, lost: bool = False) -> None:
        """Take the bytes of a message that was fetched again.

        Args:
            kind: what it is.
            data: the bytes.
            lost: whether it is certain that it was lost, though it is a commit.
        """
        try:
            self.receive_again(self.sent_again(kind, data), lost)
        except RecordError as error:
            self.refuse(kind, error)

    def receive_again(self, record: Record, lost: bool = False) -> None:
        """Hand over a record that was fetched again; one that is new was lost before."""
        # a node that fetches what a commit names has the commit
        if self.receive(record) and (lost or not isinstance(record, Commit)):
            self.recovered[TOPICS[type(record)]] += 1

    def refuse(self, what: type | str, error: Exception) -> None:
        """Count a refusal; log the first ten on a topic, then every thousandth.

        Args:
            what: the kind of record, or the service whose answer it was.
            error: why.
        """
        topic = what if isinstance(what, str) else TOPICS[what]
        self.refused[topic] += 1
        n = self.refused[topic]
        if worth_a_line(n):
            reason = shown(str(error), LONGEST_LINE)
            self._log.error(f'refused on {topic!r} (number {n}): {reason}')

    def lost(self, topics: Collection[str] | None = None) -> dict[str, int]:
        """Counts of the records that peers published a while ago, according to their presence,
        and that never arrived, not even when fetched again.

        Args:
            topics: those that are looked at; None: what the core takes in.
        """
        if self.lost_for_good is not None:
            return self.lost_for_good
        wanted = [TOPICS[k] for k in self.core.subscribes] if topics is None else topics
        lost = self.ledger.lost(self._clock())
        return {topic: n for topic, n in lost.items() if topic in wanted}

    def left_out(self, peer: Peer) -> bool:
        """Whether nobody waits for a node: all that it simulates is left out of the run."""
        return self.settings is not None and peer.left_out(self.settings, self.core.left_out)

    def counters(self) -> dict[str, dict[str, int]]:
        """All counts, by their names on /diagnostics."""
        return {
            'received': dict(self.received),
            'lost': self.lost(),
            'duplicated': dict(self.core.duplicated),
            'refused': dict(self.refused + self.core.refused),
        }
