"""Digests of what records mean, for commits that prove what they name.

A digest is the sha256 of a record's kind and fields, each in one fixed form, arrays by their
shape and bytes. It leaves out what differs between ways of carrying the same record: the stamp and
the bytes of its message, and the run's id, which every receiver checks. So a run in process and
one over topics have the same digests. sha256 was chosen because processors have instructions for
it: measured on one with them, 2 GB/s for pieces of 4 to 50 KB, and 0.4 to 1.4 GB/s for blake2b.
"""

import hashlib
import struct
from collections.abc import Callable, Iterable
from dataclasses import fields
from functools import cache
from typing import Any, get_args, get_type_hints

import numpy as np

from codetr_ros.records.kinds import Commit, Record, StepRewards

_LEFT_OUT = {'run_id'}
_LEFT_OUT_OF: dict[type, set[str]] = {
    Commit: set(),  # a commit is one of its run
    StepRewards: {'run_id', 'commit'},  # the labels themselves, whatever they were made of
}
_LENGTH = struct.Struct('<Q').pack
_FLOAT = struct.Struct('<d').pack


def _of_text(value: str) -> bytes:
    raw = value.encode()
    return _LENGTH(len(raw)) + raw


def _of_bytes(value: bytes) -> bytes:
    return _LENGTH(len(value)) + value


def _of_number(value: int) -> bytes:
    return int(value).to_bytes(9, 'little', signed=True)  # 64 bits, signed or not


def _of_texts(value: tuple[str, ...]) -> bytes:
    return _LENGTH(len(value)) + b''.join(map(_of_text, value))


def _of_array(dtype: np.dtype[Any]) -> Callable[[Any], bytes]:
    little = dtype.newbyteorder('<')

    def encoded(value: Any) -> bytes:
        array = np.ascontiguousarray(value, little)
        return b''.join((bytes((array.ndim,)), *map(_LENGTH, array.shape), array.tobytes()))

    return encoded


_FORMS: dict[Any, Callable[[Any], bytes]] = {
    str: _of_text,
    bytes: _of_bytes,
    bool: lambda value: b'\1' if value else b'\0',
    int: _of_number,
    float: _FLOAT,
    tuple[str, ...]: _of_texts,
}


@cache
def _forms(kind: type) -> tuple[tuple[str, Callable[[Any], bytes]], ...]:
    """How each field of a kind of record is written for its digest."""
    hints = get_type_hints(kind)
    forms = []
    for field in fields(kind):
        if field.name in _LEFT_OUT_OF.get(kind, _LEFT_OUT):
            continue
        hint = hints[field.name]
        form = _FORMS.get(hint) or _of_array(np.dtype(get_args(get_args(hint)[1])[0]))
        forms.append((field.name, form))
    return tuple(forms)


def raw_digest(record: Record) -> bytes:
    """The digest of one record, 32 bytes."""
    kind: type = type(record)
    pieces = [kind.__name__.encode(), b'\0']
    pieces += [form(getattr(record, name)) for name, form in _forms(kind)]
    return hashlib.sha256(b''.join(pieces)).digest()


def digest(record: Record) -> str:
    """The digest of one record, in hexadecimal: `Commit.previous`, `StepRewards.commit`,
    `Commit.policy_digest`.
    """
    return raw_digest(record).hex()


def joined(raw_digests: Iterable[bytes]) -> str:
    """The digest of several records in order, in hexadecimal, from their own."""
    return hashlib.sha256(b''.join(raw_digests)).hexdigest()


def digest_of_all(records: Iterable[Record]) -> str:
    """The digest of several records in order, in hexadecimal: `Commit.transition_digests`,
    `Commit.score_digests`, `Commit.labels_digest`.
    """
    return joined(map(raw_digest, records))
