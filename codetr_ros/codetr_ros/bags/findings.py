"""The findings of `codetr bag verify`: named one by one, counted in full."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Any, NamedTuple

NAMED = 1000
"""Findings of each kind that are named; more are only counted, so that memory stays bounded."""


class Finding(NamedTuple):
    """Something that is wrong with a bag."""

    kind: str  # file, index, metadata, gap, duplicate, value, segment, commit, digest, run, record
    place: str
    text: str


@dataclass
class Findings:
    """Everything that is wrong with a bag, and remarks on what is not."""

    named: list[Finding] = field(default_factory=list)
    counts: Counter[str] = field(default_factory=Counter)
    remarks: list[str] = field(default_factory=list)

    def add(self, kind: str, place: Any, text: str) -> None:
        """Note that something is wrong."""
        self.counts[kind] += 1
        if self.counts[kind] <= NAMED:
            self.named.append(Finding(kind, str(place), text))
