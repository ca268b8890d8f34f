"""Order the messages of a run as it can have published them, whatever order its topics came in."""

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Protocol, TypeVar

from codetr_ros.records import (
    Commit,
    CompositeReward,
    Preference,
    Record,
    ScoreRequest,
    StepRewards,
    Transitions,
)
from codetr_ros.records.chain import named, publisher, void

_MOST_HELD = 10_000  # the depth of another recorder's queue: a message that is later is lost
_PERMITTING = (Transitions, CompositeReward, Preference, Commit)  # records that others wait for


class _Message(Protocol):
    """A message of a run."""

    @property
    def record(self) -> Record:
        """Its record."""


MessageT = TypeVar('MessageT', bound=_Message)


def causal(messages: Iterable[MessageT], lag: int) -> Iterator[MessageT]:
    """The same messages in an order that the run can have had: a commit after all that it names,
    its labels after it, and steps after the commit that permits them.

    A recorder that receives topics like any other subscriber (`ros2 bag record`) may have mixed
    the order between topics. The wait for a message that never comes ends when as many others are
    held as the queue of such a recorder takes.

    Args:
        messages: of one run, each topic in its own order.
        lag: phases from the one learnt from to the last that may be under way.
    """
    held: list[MessageT] = []
    numbers: Counter[tuple[type, str]] = Counter()  # next of each publisher
    committed = seen = -1

    def early(record: Record) -> bool:
        if isinstance(record, Transitions):
            return record.phase - lag > committed
        if isinstance(record, (StepRewards, ScoreRequest)):
            return record.phase > committed
        if not isinstance(record, Commit):
            return False
        out = void(record)
        return any(n >= numbers[key] for key, n in named(record).items() if key not in out)

    for message in messages:
        record = message.record
        lost = isinstance(record, Commit) and record.phase > seen + 1
        if isinstance(record, Commit):
            seen = max(seen, record.phase)
        following: MessageT | None = message
        if not lost and early(record):
            held.append(message)
            following = held.pop(0) if len(held) > _MOST_HELD else None
        permits = False
        while following is not None:
            record = following.record
            if isinstance(record, Commit):
                committed = max(committed, record.phase)
            elif isinstance(record, (Transitions, CompositeReward, Preference)):
                key = publisher(record)
                numbers[key] = max(numbers[key], record.sequence + 1)
            yield following
            permits |= isinstance(record, _PERMITTING)  # else nothing has become ready
            ready = (i for i, one in enumerate(held) if not early(one.record))
            at = next(ready, None) if permits else None
            following = held.pop(at) if at is not None else None
    yield from held
