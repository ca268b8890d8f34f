"""Which of the records that others have published have not arrived.

Each presence has the counts of what its process has published. What arrives is counted by the
process that sent it, and each record once, however it comes: on its topic, again on its topic, or
sent again on request before or after that.
"""

from collections import Counter, OrderedDict, deque
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field

from codetr_ros.records import TOPICS, Presence, Record, RunSpec
from codetr_ros.records.identity import identity

MOST = 30_000
"""Records of a process that are remembered: more than it keeps to be sent again."""

_Message = tuple[int, int]
"""When a message was published [ns], which no two of a process have in common; what it is."""


@dataclass
class _Account:
    """Of one process.

    Attributes:
        published: counts by its newest presence, by topic.
        stamp: of that presence [ns].
        dated: such counts, and when they were heard [s]; the older first.
        due: those of them that were heard long ago.
        forgiven: counts of what was published until `since` [ns], of which nothing is owed.
        arrived: counts of what was published later and has arrived.
        newest: when what has arrived was published [ns], if that is later than `stamp`; its topic.
        came: what has come on its topic: when it was published [ns], and what it is.
        again: what was sent again and had not come before, likewise.
    """

    published: 'Counter[str]' = field(default_factory=Counter)
    stamp: int = 0
    dated: 'deque[tuple[float, Counter[str]]]' = field(default_factory=deque)
    due: 'Counter[str]' = field(default_factory=Counter)
    forgiven: 'Counter[str]' = field(default_factory=Counter)
    since: int = -1
    arrived: 'Counter[str]' = field(default_factory=Counter)
    newest: 'deque[tuple[int, str]]' = field(default_factory=lambda: deque(maxlen=MOST))
    came: 'OrderedDict[_Message, None]' = field(default_factory=OrderedDict)
    again: 'OrderedDict[_Message, None]' = field(default_factory=OrderedDict)

    def note(self, published: 'Counter[str]', stamp: int, now: float) -> bool:
        """Note counts; returns whether they are new."""
        if stamp >= self.stamp:  # else an earlier one, which a later one has overtaken
            self.published, self.stamp = published, stamp
            self.newest = deque((each for each in self.newest if each[0] > stamp), maxlen=MOST)
        if (self.dated[-1][1] if self.dated else self.due) == published:
            return False
        self.dated.append((now, published))
        return True

    def count(self, topic: str, stamp: int, by: int = 1) -> None:
        if stamp > self.since:
            self.arrived[topic] += by
        if stamp > self.stamp:
            if by > 0:
                self.newest.append((stamp, topic))
            elif (stamp, topic) in self.newest:
                self.newest.remove((stamp, topic))

    def forgive(self) -> None:
        if not self.stamp:
            return  # nothing is known of it, or all of it is for this node
        self.dated.clear()
        self.due = Counter()
        self.forgiven, self.since = self.published, self.stamp
        self.arrived = Counter(topic for _, topic in self.newest)

    def owed(self, published: 'Counter[str]') -> 'Counter[str]':
        owed = Counter(published)
        owed.subtract(self.forgiven)
        owed.subtract(self.arrived)
        return +owed

    def lost(self, before: float) -> 'Counter[str]':
        while self.dated and self.dated[0][0] <= before:
            self.due = self.dated.popleft()[1]
        return self.owed(self.due)


class Ledger:
    """Counts records that were published but have not arrived.

    A `Presence` may overtake the messages that it counts. So a record counts as lost only when it
    has not arrived `patience` seconds after a presence that counts it.

    Args:
        patience: these seconds.
    """

    def __init__(self, patience: float = 5.0) -> None:
        self._patience = patience
        self._by: dict[str, _Account] = {}
        self._instances: dict[str, str] = {}  # the newest of each node
        self._lost: dict[str, int] | None = {}  # as it was found last; None: something has changed
        self._lost_until = float('inf')  # when more may be lost, if nothing changes [s]

    def note(self, presence: Presence, stamp: int, now: float) -> None:
        """Note what a process has published by now. One that has taken the place of another begins
        anew: what that had published and has not arrived, it publishes again.

        Args:
            presence: that of the process.
            stamp: when it was published [ns].
            now: monotonic time [s].
        """
        counts = dict(zip(presence.topics, presence.published.tolist(), strict=True))
        self._note(presence.node, presence.instance_id, counts, stamp, now)

    def note_own(self, instance: str, published: Mapping[str, int], now: float) -> None:
        """Note what a process that receives its own records has published by now."""
        self._note('', instance, published, 0, now)

    def _note(
        self, node: str, instance: str, published: Mapping[str, int], stamp: int, now: float
    ) -> None:
        counts = Counter(published)
        del counts[TOPICS[RunSpec]]  # announced by other means, too
        news = self._account(instance).note(counts, stamp, now)
        if news or self._instances.get(node) != instance:
            self._instances[node] = instance
            self._lost = None

    def _account(self, instance: str) -> _Account:
        return self._by.setdefault(instance, _Account())

    def arrived(self, record: Record | type, sender: str, stamp: int) -> None:
        """Note a record that has come on its topic.

        Args:
            record: the record; the kind of one that is not sound.
            sender: instance id of the process that has published it; empty: it counts for nothing.
            stamp: when it was published [ns].
        """
        if not sender:
            return
        account, message = self._account(sender), (stamp, _key(record))
        if message in account.came:
            return
        self._lost = None
        if message not in account.again:
            kind = record if isinstance(record, type) else type(record)
            account.count(TOPICS[kind], stamp)
        _remember(account.came, message)

    def sent_again(self, record: Record, sender: str, stamp: int) -> None:
        """Note a record that was sent again on request.

        Args:
            record: the record.
            sender: instance id of the process that has published it; empty: it counts for nothing.
            stamp: when it was published at first [ns].
        """
        account, message = self._by.get(sender), (stamp, _key(record))
        if account is None or message in account.came or message in account.again:
            return
        self._lost = None
        account.count(TOPICS[type(record)], stamp)
        _remember(account.again, message)

    def set_aside(self, record: Record) -> None:
        """Take back that a record has come on its topic: it is let go, and must be sent again."""
        key = _key(record)
        self._lost = None
        for account in self._by.values():
            # it has just come, as a rule
            message = next((each for each in reversed(account.came) if each[1] == key), None)
            if message is not None:
                del account.came[message]
                account.count(TOPICS[type(record)], message[0], -1)

    def forgive(self) -> None:
        """Begin to count anew: of what was published by now, nothing is owed. It was published for
        those who were there before.
        """
        self._lost = None
        for account in self._by.values():
            account.forgive()

    def owed(self, without: Collection[str] = ()) -> dict[str, int]:
        """Counts of records that were published and have not arrived, by topic, whenever that
        was.

        Args:
            without: instance ids of processes that do not count.
        """
        return _sum(account.owed(account.published) for account in self._present(without))

    def lost(self, now: float) -> dict[str, int]:
        """Counts of the lost records, for topics that lost any."""
        before = now - self._patience
        if self._lost is None or before >= self._lost_until:  # asked for in every turn
            self._lost = _sum(account.lost(before) for account in self._present())
            heard = (each.dated[0][0] for each in self._present() if each.dated)
            self._lost_until = min(heard, default=float('inf'))
        return self._lost

    def owing(self) -> list[str]:
        """Full names of the nodes of which something has not arrived."""
        return [
            node
            for node, instance in self._instances.items()
            if node and self._by[instance].owed(self._by[instance].published)
        ]

    def _present(self, without: Collection[str] = ()) -> Iterator[_Account]:
        there = self._instances.values()
        return (self._by[instance] for instance in there if instance not in without)


def _sum(counts: 'Iterable[Counter[str]]') -> dict[str, int]:
    total: Counter[str] = Counter()
    for each in counts:
        total.update(each)
    return dict(sorted(total.items()))


def _key(record: Record | type) -> int:
    return hash(record if isinstance(record, type) else (type(record), identity(record)))


def _remember(there: 'OrderedDict[_Message, None]', message: _Message) -> None:
    there[message] = None
    if len(there) > MOST:
        there.popitem(last=False)
