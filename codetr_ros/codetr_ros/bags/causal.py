"""Messages of a run in an order that the run can have had, whatever order its topics came in."""

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Protocol, TypeVar

from codetr_ros.records import Commit, CompositeReward, Record, StepRewards, Transitions

_MOST_HELD = 10_000  # as deep as the queue of another recorder: what is later has been lost
_PERMITTING = (Transitions, CompositeReward, Commit)  # what others wait for


class _Said(Protocol):
    """Something that was said in a run."""

    @property
    def record(self) -> Record:
        """What it was."""


Said = TypeVar('Said', bound=_Said)


def causal(found: Iterable[Said], lag: int) -> Iterator[Said]:
    """The same messages in an order that the run can have had: a commit behind all that it names,
    its labels behind it, and steps behind the commit that they were permitted after.

    A recorder that hears topics as everybody else does (`ros2 bag record`) may have noted them in
    any other order among each other. What never comes is waited for as long as its queue is deep.

    Args:
        found: messages of one run, each topic in its own order.
        lag: phases from what is learnt from to what may be under way.
    """
    held: list[Said] = []
    numbers: Counter[tuple[type, str]] = Counter()  # next of each publisher
    committed = heard = -1

    def early(record: Record) -> bool:
        if isinstance(record, Transitions):
            return record.phase - lag > committed
        if isinstance(record, StepRewards):
            return record.phase > committed
        return isinstance(record, Commit) and any(
            number >= numbers[key] for key, number in named(record).items()
        )

    for item in found:
        record = item.record
        lost = isinstance(record, Commit) and record.phase > heard + 1
        if isinstance(record, Commit):
            heard = max(heard, record.phase)
        following: Said | None = item
        if not lost and early(record):
            held.append(item)
            following = held.pop(0) if len(held) > _MOST_HELD else None
        permits = False
        while following is not None:
            record = following.record
            if isinstance(record, Commit):
                committed = max(committed, record.phase)
            elif isinstance(record, (Transitions, CompositeReward)):
                key = publisher(record)
                numbers[key] = max(numbers[key], record.sequence + 1)
            yield following
            permits |= isinstance(record, _PERMITTING)  # else nothing has become ready
            ready = (i for i, one in enumerate(held) if not early(one.record))
            at = next(ready, None) if permits else None
            following = held.pop(at) if at is not None else None
    yield from held


def publisher(record: Transitions | CompositeReward) -> tuple[type, str]:
    """Who numbers such records."""
    return type(record), record.source if isinstance(record, Transitions) else record.scorer


def named(commit: Commit) -> dict[tuple[type, str], int]:
    """The last sequence number of each publisher that a commit names."""
    return {
        (kind, name): number
        for kind, names, last in (
            (Transitions, commit.sources, commit.transitions),
            (CompositeReward, commit.scorers, commit.scores),
        )
        for name, number in zip(names, last.tolist(), strict=True)
    }
