"""Records from the fields of messages, which come over a topic or from a bag.

Lengths that must agree are checked here, once for both.
"""

from typing import Any

import numpy as np

from codetr_ros.records import (
    TOPICS,
    Commit,
    Metrics,
    Policy,
    Presence,
    Record,
    RecordError,
    ScoreRequest,
    StepRewards,
    Transitions,
    TrueRewards,
)
from codetr_ros.records.shown import shown

PACKAGE = 'codetr_msgs'


def type_name(record_type: type) -> str:
    """The full name of the message type of a kind of record, as in bags and services."""
    return f'{PACKAGE}/msg/{record_type.__name__}'


RECORD_TYPES: dict[str, type] = {type_name(record_type): record_type for record_type in TOPICS}
"""The kind of record that a message type carries."""

_PARALLEL: dict[type, tuple[tuple[str, ...], ...]] = {
    Presence: (('topics', 'published'),),
    Policy: (('sources', 'steps'),),
    Commit: (('sources', 'transitions'), ('scorers', 'scores')),
    StepRewards: (('episodes', 'first_steps', 'lengths'),),
    ScoreRequest: (('sources', 'episodes', 'first_steps', 'lengths', 'worths'),),
    Metrics: (('names', 'values'),),
}
"""Names of arrays: each must be as long as the first of its row."""

_STATED: dict[type, tuple[tuple[str, str], ...]] = {
    Commit: (('sources', 'transition_digests'), ('scorers', 'score_digests')),
}
"""Names of arrays: the second is empty, or as long as the first."""


def record_of(record_type: type, values: dict[str, Any]) -> Record:
    """The record that a message carries.

    Args:
        record_type: its kind.
        values: every field of it; arrays are one-dimensional and belong to the record from now on.

    Raises:
        RecordError: arrays whose lengths disagree; names field, length, expectation and source.
    """
    _check_lengths(record_type, values)
    if record_type is Transitions:
        _shape(values)
    return record_type(**values)  # type: ignore[no-any-return]


def _refuse(record_type: type, values: dict[str, Any], field: str, expected: str) -> RecordError:
    sender = values.get('source') or values.get('node') or values.get('role') or 'its publisher'
    sender = shown(sender)
    numbers = ', '.join(
        f'{name}={values[name]}' for name in ('sequence', 'phase', 'part') if name in values
    )
    return RecordError(
        f'{record_type.__name__}({numbers}) from {sender!r}: {field} has length '
        f'{len(values[field])}, expected {expected}; mend what {sender!r} publishes on '
        f'{TOPICS[record_type]!r}'
    )


def _check_lengths(record_type: type, values: dict[str, Any]) -> None:
    for first, *others in _PARALLEL.get(record_type, ()):
        for name in others:
            if len(values[name]) != len(values[first]):
                raise _refuse(record_type, values, name, f'{len(values[first])} as {first}')
    for first, name in _STATED.get(record_type, ()):
        if values.get(name) and len(values[name]) != len(values[first]):
            raise _refuse(record_type, values, name, f'{len(values[first])} as {first}, or 0')
    if record_type is StepRewards:
        steps = int(values['lengths'].sum(dtype=np.uint64))
        if len(values['labels']) != steps:
            raise _refuse(record_type, values, 'labels', f'{steps}, the sum of lengths')
    if record_type is TrueRewards and not len(values['rewards']):
        raise _refuse(record_type, values, 'rewards', 'at least 1')


def _shape(values: dict[str, Any]) -> None:
    steps = values['steps']
    for name, rows in (('observations', steps + 1), ('actions', steps)):
        length = len(values[name])
        if steps < 1 or length < rows or length % rows:
            expected = (
                f'a multiple of {rows} for steps={steps}'
                if steps
                else 'steps of at least 1, not 0'
            )
            raise _refuse(Transitions, values, name, expected)
        values[name] = values[name].reshape(rows, length // rows)
