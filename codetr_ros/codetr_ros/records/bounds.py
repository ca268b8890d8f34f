"""Bounds on what arrives: a message from anywhere must not decide how much memory a node takes,
how long its log becomes, or what it counts.

Bags and records of this process are not held to them.
"""

from dataclasses import fields
from functools import cache
from typing import Any

import numpy as np

from codetr_ros.records.kinds import (
    TOPICS,
    Commit,
    EpisodeResult,
    Metrics,
    Policy,
    Presence,
    Record,
    RecordError,
    RunSpec,
    ScoreRequest,
    TaskSpec,
)
from codetr_ros.records.roles import ROLES
from codetr_ros.records.shown import shown

LONGEST_NAME = 255
"""The most characters of a name: of a run, a node, a source, a task, a metric."""
MOST_NAMES = 10_000
"""The most names in a list: sources, scorers, metrics."""
LONGEST_DOING = 4096
"""The most characters of what a node does, in words: it may wait for many others."""
LONGEST_TEXT: dict[tuple[type, str], int] = {
    (RunSpec, 'settings'): 1 << 20,
    (Policy, 'network'): 1 << 16,
    (Presence, 'doing'): LONGEST_DOING,
}
"""The most characters of texts that are no names."""
LARGEST_COUNT = 1 << 48
"""The largest count of records or steps: years at a million a second."""
LARGEST: dict[tuple[type, str], int] = {
    (TaskSpec, 'observation_size'): 100_000,
    (TaskSpec, 'action_size'): 10_000,
    (TaskSpec, 'horizon'): 10_000_000,
}
"""The largest sizes of a task: networks and memory are made for them."""
PURPOSES = ('training', 'evaluation', 'random')


def check_bounds(record: Record) -> None:
    """Refuse a record with a name, size or count that no run has.

    Raises:
        RecordError: names kind, field, value and bound.
    """
    kind: type = type(record)
    for name, most in _texts(kind):
        _check_text(kind, name, getattr(record, name), most)
    for name in _lists(kind):
        _check_list(kind, name, getattr(record, name))
    for name, (least, largest) in _numbers(kind).items():
        value = getattr(record, name)
        if not least <= value <= largest:  # no number is neither
            raise _refused(kind, name, value, f'from {least:g} to {largest:g}')
    if check := _OF_KIND.get(kind):
        check(record)


def _refused(kind: type, name: str, value: Any, allowed: str) -> RecordError:
    return RecordError(
        f'{kind.__name__}.{name} is {shown(repr(value))}: it must be {allowed}; mend what '
        f'publishes it on {TOPICS[kind]!r}'
    )


@cache
def _texts(kind: type) -> tuple[tuple[str, int], ...]:
    return tuple(
        (f.name, LONGEST_TEXT.get((kind, f.name), LONGEST_NAME))
        for f in fields(kind)
        if f.type is str
    )


@cache
def _lists(kind: type) -> tuple[str, ...]:
    return tuple(f.name for f in fields(kind) if f.type == tuple[str, ...])


@cache
def _numbers(kind: type) -> dict[str, tuple[float, float]]:
    bounds: dict[str, tuple[float, float]] = {
        f.name: (1, LARGEST[kind, f.name]) for f in fields(kind) if (kind, f.name) in LARGEST
    }
    for f in fields(kind):
        if f.type is int and f.name in ('step', 'sequence', 'missed'):
            bounds[f.name] = (0, LARGEST_COUNT)
    if kind is TaskSpec:
        bounds |= {'control_period': (0, 1e9), 'r_max': (5e-324, 1e300)}
    return bounds


def _check_text(kind: type, name: str, text: str, most: int = LONGEST_NAME) -> None:
    if len(text) > most:
        raise _refused(kind, name, text, f'at most {most} characters, not {len(text)}')
    if not text.isprintable():
        raise _refused(kind, name, text, 'of printable characters')


def _check_list(kind: type, name: str, names: tuple[str, ...]) -> None:
    if len(names) > MOST_NAMES:
        raise _refused(kind, name, names[:3], f'at most {MOST_NAMES} names, not {len(names)}')
    # digests are equal where nothing new is named of two sources or scorers
    unique = kind not in (Metrics, ScoreRequest) and not name.endswith('_digests')
    if unique and len(set(names)) != len(names):
        raise _refused(kind, name, names[:10], 'names of which none comes twice')
    for each in names:
        _check_text(kind, name, each)


def _check_counts(kind: type, name: str, counts: Any, least: int) -> None:
    wrong = (counts < least) | (counts > LARGEST_COUNT)
    if wrong.any():
        value = int(counts[int(np.argmax(wrong))])
        raise _refused(kind, name, value, f'numbers from {least} to {LARGEST_COUNT}')


def _presence(record: Any) -> None:
    if record.role not in ROLES:
        raise _refused(Presence, 'role', record.role, f'one of {", ".join(ROLES)}')
    if strange := sorted(set(record.topics) - set(TOPICS.values())):
        raise _refused(Presence, 'topics', strange[0], 'topics of a run')
    _check_counts(Presence, 'published', record.published, 0)


def _commit(record: Any) -> None:
    _check_counts(Commit, 'transitions', record.transitions, -1)
    _check_counts(Commit, 'scores', record.scores, -1)


def _metrics(record: Any) -> None:
    if record.role not in ROLES:
        raise _refused(Metrics, 'role', record.role, f'one of {", ".join(ROLES)}')


def _result(record: Any) -> None:
    if record.purpose not in PURPOSES:
        raise _refused(EpisodeResult, 'purpose', record.purpose, f'one of {", ".join(PURPOSES)}')


_OF_KIND = {Presence: _presence, Commit: _commit, Metrics: _metrics, EpisodeResult: _result}
