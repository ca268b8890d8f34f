"""Who may publish what: what comes from anybody else is refused, whatever it contains.

With a key of the run (`nodes.signing`) a message must be signed with it, and one process holds
each role: the first that published as it. It holds it until it has finished, its process is gone,
or it has been silent beyond the deadline; then a new start of the node may take its place.

Without a key nobody is refused for who he is: the sender of a message is what it states, and who
reads one message can state the same. So a place that the first sender held would keep out nobody
who lies, and would let a liar who comes first keep out the true node.
"""

from collections.abc import Callable, Sized
from dataclasses import dataclass, field

from codetr_ros.bags.definitions import stamp_of
from codetr_ros.config import Settings
from codetr_ros.nodes.signing import VARIABLE, is_signed
from codetr_ros.records import (
    TOPICS,
    CompositeReward,
    EpisodeResult,
    Metrics,
    Preference,
    Presence,
    Record,
    RecordError,
    TaskSpec,
    Transitions,
    TrueRewards,
    describe,
)
from codetr_ros.records.roles import WRITERS
from codetr_ros.records.shown import shown
from codetr_ros.system.liveness import has_ended

MANY = ('sim', 'score', 'desk')
"""Roles of which a run may have several nodes, each under a name of its own."""
SCORER = 'scorer'
MOST_MEMBERS = 1000
"""The most processes that are remembered: beyond them nobody new is admitted."""

Place = tuple[str, str]
"""Role and, where there may be several of it, name within the run."""


@dataclass
class _Member:
    """A process that holds or held a place."""

    place: Place
    heard_at: float  # monotonic time [s] of its newest message
    finished: bool = False
    stamps: dict[type, int] = field(default_factory=dict)  # newest of each topic [ns]


class Unknown(RecordError):  # noqa: N818 - a refusal that may still change
    """The place of the sender is still held by another: its messages may be kept a while."""


class Admission:
    """Decides whose messages are taken.

    Args:
        topic: returns the full name of the topic of a kind of record.
        key: that of the run; None: there is none.
        deadline: returns the seconds of silence after which a place is free; 0: never.

    Attributes:
        settings: those of the run, once they are known.
    """

    def __init__(
        self, topic: Callable[[type], str], key: bytes | None, deadline: Callable[[], float]
    ) -> None:
        self._topic = topic
        self._key = key
        self._deadline = deadline
        self.settings: Settings | None = None
        self._members: dict[str, _Member] = {}
        self._scorers: dict[Place, _Member] = {}
        self._holders: dict[Place, str] = {}

    def check_signature(self, kind: type, data: bytes) -> None:
        """Refuse a message that is not signed with the key of the run, if there is one.

        Raises:
            RecordError: it is not.
        """
        if self._key is not None and not is_signed(self._key, self._topic(kind), data):
            raise RecordError(
                f'{kind.__name__} is not signed with the key of this run: whoever published it '
                f'is no node of it, or was started without the environment variable {VARIABLE}'
            )

    def admit(self, record: Record, sender: str, data: bytes, now: float) -> None:
        """Refuse a message of somebody who may not publish it. Its signature is checked already.

        Args:
            record: what it says.
            sender: the instance id of the process that published it.
            data: its bytes.
            now: monotonic time [s].

        Raises:
            Unknown: the place of the sender is still held by another process.
            RecordError: the sender may not publish this, or it is older than what came before.
        """
        if self._key is None:
            return
        kind: type = type(record)
        if not sender:
            raise RecordError(
                f'{kind.__name__} names no sender: it is of an older version of codetr_ros, or of '
                'a program that does not fill the field'
            )
        if isinstance(record, Presence) and record.instance_id != sender:
            raise RecordError(
                f'Presence of {record.node} has instance_id {shown(repr(record.instance_id))} and '
                f'sender {shown(repr(sender))}: they must be the same'
            )
        place = self._place(record)
        if place[0] == SCORER:
            member = self._scorer(record, sender, place, now)
        else:
            member = self._members.get(sender) or self._join(record, sender, place, now)
            self._check_place(record, sender, member, place, now)
        stamp = stamp_of(data)
        if stamp <= member.stamps.get(kind, -1):
            raise RecordError(
                f'{describe(record)} is not newer than what {shown(repr(sender))} has published '
                f'on {TOPICS[kind]!r} before: it is a repetition of an old message'
            )
        member.stamps[kind] = stamp
        member.heard_at = now
        if isinstance(record, Presence):
            member.finished = record.finished

    def check_again(self, record: Record, sender: str) -> None:
        """Refuse a message that was fetched again, of somebody who may not have published it.

        Raises:
            RecordError: its sender is known, and may not publish this.
        """
        member = self._members.get(sender)
        if member is not None:
            self._check_role(record, member)

    # ---- places

    def _place(self, record: Record) -> Place:
        """Whose record it is, as far as it says so itself."""
        if isinstance(record, Presence):
            name = record.node.rpartition('/')[2]
            return record.role, name if record.role in MANY else ''
        if isinstance(record, (TaskSpec, Transitions, TrueRewards)):
            return 'sim', self._simulator(record.source)
        if isinstance(record, (CompositeReward, Preference)):
            if record.scorer != record.source:
                return SCORER, record.scorer
            return 'sim', self._simulator(record.source)
        if isinstance(record, EpisodeResult):
            training = record.purpose == 'training'
            return ('sim', self._simulator(record.source)) if training else ('evaluate', '')
        if isinstance(record, Metrics):
            return record.role, record.node if record.role in MANY else ''
        (role,) = WRITERS[TOPICS[type(record)]]
        return role, ''

    def _simulator(self, source: str) -> str:
        return source if self.settings is None else self.settings.simulator_of(source)

    def _scorer(self, record: Record, sender: str, place: Place, now: float) -> _Member:
        """Who is neither a simulator nor needs to join: the first of a name is the scorer."""
        node = self._members.get(sender)
        if node is not None:
            self._check_role(record, node)
        holder = self._holders.get(place, sender)
        known = self._scorers.get(place)
        if known is None:
            self._check_room(record, self._scorers)
            known = self._scorers[place] = _Member(place, now)
        elif holder != sender:
            if not self._free(known, holder, now):
                raise RecordError(
                    f'{describe(record)} is of {shown(repr(sender))}, where {holder!r} is the '
                    f'scorer {place[1]!r}: give one of them another name'
                )
            known = self._scorers[place] = _Member(place, now)
        self._holders[place] = sender
        return known

    def _join(self, record: Record, sender: str, place: Place, now: float) -> _Member:
        """Give a process its place, if it may have one."""
        self._check_room(record, self._members)
        self._take(record, sender, place, now)
        member = self._members[sender] = _Member(place, now)
        return member

    def _check_room(self, record: Record, there: Sized) -> None:
        if len(there) >= MOST_MEMBERS:
            raise RecordError(
                f'{describe(record)} is of one more than the {MOST_MEMBERS} that have joined: '
                'stop whoever starts them'
            )

    def _take(self, record: Record, sender: str, place: Place, now: float) -> None:
        holder = self._holders.get(place)
        if (
            holder is not None
            and holder != sender
            and not self._free(self._members[holder], holder, now)
        ):
            raise Unknown(
                f'{describe(record)} is of a second {_words(place)}, {shown(repr(sender))}, where '
                f'{holder!r} has joined and still lives: stop one of them, or give it another '
                'name (--ros-args -r __node:=other) or namespace'
            )
        if holder is None and self.settings is not None and place[0] == 'sim':
            joiners = self.settings.joiners
            there = sum(
                role == 'sim' and _last(name) not in joiners for role, name in self._holders
            )
            if there >= self.settings.simulators and _last(place[1]) not in joiners:
                raise RecordError(
                    f'{describe(record)} is of one simulator too many, {_words(place)}: the run '
                    f'has simulators={self.settings.simulators}. Start the run with more, or stop '
                    'this one'
                )
        self._holders[place] = sender

    def _free(self, member: _Member, holder: str, now: float) -> bool:
        deadline = self._deadline()
        silent = deadline > 0 and now - member.heard_at > deadline
        return member.finished or silent or has_ended(holder.partition(' ')[2])

    def _check_place(
        self, record: Record, sender: str, member: _Member, place: Place, now: float
    ) -> None:
        self._check_role(record, member)
        if place != member.place:
            raise RecordError(
                f'{describe(record)} is of {_words(place)}, but was published by '
                f'{_words(member.place)}: no node publishes for another'
            )
        if self._holders.get(place) != sender:
            self._take(record, sender, place, now)

    def _check_role(self, record: Record, member: _Member) -> None:
        role = member.place[0]
        topic = TOPICS[type(record)]
        if topic in WRITERS and role not in WRITERS[topic]:
            raise RecordError(
                f'{describe(record)} was published by {_words(member.place)}: no {role} publishes '
                f'on {topic!r}'
            )


def _last(name: str) -> str:
    """The last part of a node's name."""
    return name.rpartition('/')[2]


def _words(place: Place) -> str:
    return f'{place[0]} {place[1]!r}' if place[1] else place[0]
