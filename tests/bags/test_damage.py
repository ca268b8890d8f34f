"""Damaged bags: never a crash without a named cause, never a silently wrong value, never memory
beyond the bound.

    CODETR_DAMAGE_CASES=2000 CODETR_DAMAGE_TABLE=benchmarks/results/bag_damage.md \\
        .venv/bin/python -m pytest -q tests/bags/test_damage.py

tries more, and writes what came of it.
"""

import contextlib
import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from codetr_ros.bags.definitions import decode, encode
from codetr_ros.records import TOPICS, RecordError
from helpers.damage import CHECKED, KINDS, MEMORY, ORDERLY, RUN, Tally, run_cases, table

CASES = int(os.environ.get('CODETR_DAMAGE_CASES', '5'))
TALLIES: dict[tuple[str, str], Tally] = {}


@pytest.fixture(scope='module', autouse=True)
def _written():
    yield
    if path := os.environ.get('CODETR_DAMAGE_TABLE'):
        Path(path).write_text(table(TALLIES))


@pytest.mark.timeout(3600)
@pytest.mark.parametrize(
    ('kind', 'made_by'), [(kind, name) for kind, (_, names) in KINDS.items() for name in names]
)
def test_damage_is_named_or_changes_nothing(kind, made_by, tmp_path):
    if kind == 'no permission' and os.geteuid() == 0:
        pytest.skip('the superuser may read everything')
    tally = TALLIES[kind, made_by] = run_cases(kind, made_by, CASES, tmp_path)
    assert tally.cases == CASES
    assert tally.peak < MEMORY
    if made_by in CHECKED or kind in ('a wrong definition', 'an empty file', 'no permission'):
        assert not tally.missed
    if made_by in CHECKED and kind in ORDERLY:
        assert not tally.late


@given(st.data())
@settings(max_examples=200, deadline=None)
def test_bytes_that_are_no_message_are_refused_as_such(data):
    record = data.draw(st.sampled_from(RUN))
    raw = bytearray(encode(record))
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(raw) - 1))
        raw[at] = data.draw(st.integers(0, 255))
    end = data.draw(st.integers(0, len(raw)))
    with contextlib.suppress(RecordError):
        assert type(decode(type(record), bytes(raw[:end]))) is type(record)


@given(st.binary(max_size=400), st.sampled_from(list(TOPICS)))
@settings(max_examples=200, deadline=None)
def test_any_bytes_are_refused_or_are_a_message(raw, kind):
    with contextlib.suppress(RecordError):
        decode(kind, b'\0\1\0\0' + raw)
