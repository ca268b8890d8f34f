"""The chain of commits: the digests of what each names, and of the commit before.

Who decides what a phase is (the recorder) completes its commits by it. Who has the records of a
run in order (a bag, a player) compares them with what its commits state.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field, replace

from codetr_ros.records.digests import digest, joined, raw_digest
from codetr_ros.records.kinds import (
    Commit,
    CompositeReward,
    Policy,
    Preference,
    Record,
    StepRewards,
    Transitions,
)
from codetr_ros.records.numbering import Judgement

Publisher = tuple[type, str]
"""The kind of numbered records, and the name of the source or scorer that numbers them."""


def publisher(record: Transitions | Judgement) -> Publisher:
    """Who numbers such a record. Preferences have their numbers among those of their scorer's
    scores.
    """
    if isinstance(record, Transitions):
        return Transitions, record.source
    return CompositeReward, record.scorer


def named(commit: Commit) -> dict[Publisher, int]:
    """The last sequence number of each publisher that a commit names."""
    return {
        (kind, name): number
        for kind, names, last in (
            (Transitions, commit.sources, commit.transitions),
            (CompositeReward, commit.scorers, commit.scores),
        )
        for name, number in zip(names, last.tolist(), strict=True)
    }


def void(commit: Commit) -> set[Publisher]:
    """The publishers that a commit names whose numbers it voids: they were left out of the phase,
    and none of their records is to come. Of scorers, these are simulators.
    """
    return {(kind, name) for kind, name in named(commit) if name in commit.dropped}


def stated(commit: Commit) -> dict[Publisher, str]:
    """The digest that a commit states for each publisher that it names; empty where it states
    none.
    """
    digests = commit.transition_digests or ('',) * len(commit.sources)
    scored = commit.score_digests or ('',) * len(commit.scorers)
    return {
        (kind, name): text
        for kind, names, texts in (
            (Transitions, commit.sources, digests),
            (CompositeReward, commit.scorers, scored),
        )
        for name, text in zip(names, texts, strict=True)
    }


@dataclass
class _Labels:
    """The digests of a phase's labels, by part."""

    parts: int
    full: dict[int, bytes] = field(default_factory=dict)
    kept: dict[int, bytes] = field(default_factory=dict)

    def of(self, digests: dict[int, bytes]) -> str:
        if len(digests) < self.parts:
            return ''
        return joined(raw for _, raw in sorted(digests.items()))


class Chain:
    """The digests of the records that were noted, until a commit names them.

    Args:
        lag: phases from the one learnt from to the first that acts by it (`Settings.lag`): a
            commit names the labels of as many phases before. None: commits name no labels.
    """

    def __init__(self, lag: int | None) -> None:
        self.lag = lag
        self.next: Counter[Publisher] = Counter()  # sequence number due, of each publisher
        self.last = ''  # digest of the commit before
        self._numbered: dict[Publisher, dict[int, bytes]] = {}
        self._policies: dict[int, str] = {}
        self._labels: dict[int, _Labels] = {}

    def note(self, record: Record, kept: StepRewards | None = None) -> None:
        """Note a record that commits may name; others are left alone.

        The first of several with one number counts.

        Args:
            record: the record.
            kept: of labels, what the bag keeps of them; None: everything.
        """
        if isinstance(record, (Transitions, CompositeReward, Preference)):
            of = self._numbered.setdefault(publisher(record), {})
            if record.sequence >= self.next[publisher(record)]:
                of.setdefault(record.sequence, raw_digest(record))
        elif isinstance(record, Policy):
            self._policies.setdefault(record.phase, digest(record))
        elif isinstance(record, StepRewards) and self.lag is not None:
            labels = self._labels.setdefault(record.phase, _Labels(record.parts))
            full = labels.full.setdefault(record.part, raw_digest(record))
            labels.kept.setdefault(record.part, full if kept is None else raw_digest(kept))

    def contradicts(self, record: Transitions | Judgement) -> bool:
        """Whether another record of this number was noted, which no commit has named yet."""
        known = self._numbered.get(publisher(record), {}).get(record.sequence)
        return known is not None and known != raw_digest(record)

    def policy(self, phase: int) -> str:
        """The digest of a phase's policy; empty if none was noted."""
        return self._policies.get(phase, '')

    def labels(self, phase: int) -> tuple[str, str]:
        """The digests of a phase's labels, and of what the bag keeps of them; empty unless all
        parts were noted.
        """
        labels = self._labels.get(phase)
        return (labels.of(labels.full), labels.of(labels.kept)) if labels else ('', '')

    def completed(self, commit: Commit) -> Commit:
        """The commit with the digests of what was noted, and of the commit before. A digest is
        empty if something that it is of was not noted.
        """
        full, kept = self.labels(self._labels_of(commit))
        digests = {key: self._digest(key, last) for key, last in named(commit).items()}
        return replace(
            commit,
            transition_digests=tuple(digests[Transitions, name] for name in commit.sources),
            score_digests=tuple(digests[CompositeReward, name] for name in commit.scorers),
            policy_digest=self.policy(commit.phase),
            labels_digest=full,
            kept_labels_digest=kept,
            previous=self.last,
        )

    def _labels_of(self, commit: Commit) -> int:
        """The phase whose labels a commit names; -1 for none."""
        return -1 if self.lag is None else commit.phase - self.lag

    def _digest(self, key: Publisher, last: int) -> str:
        noted = self._numbered.get(key, {})
        numbers = range(self.next[key], last + 1)
        if any(number not in noted for number in numbers):
            return ''
        return joined(noted[number] for number in numbers)

    def follow(self, commit: Commit) -> None:
        """Go on behind a commit: what it names is named, and the next one follows on it."""
        for key, last in named(commit).items():
            self.next[key] = max(self.next[key], last + 1)
            noted = self._numbered.get(key, {})
            for number in [number for number in noted if number <= last]:
                del noted[number]
        for phase in [phase for phase in self._policies if phase <= commit.phase]:
            del self._policies[phase]
        for phase in [phase for phase in self._labels if phase <= self._labels_of(commit)]:
            del self._labels[phase]
        self.last = digest(commit)

    def differences(self, commit: Commit) -> Iterator[str]:
        """What a commit states otherwise than what was noted, in words. What it does not state, or
        what was not noted as a whole, is not compared.
        """
        ours = self.completed(commit)
        for (kind, name), text in stated(commit).items():
            noted = stated(ours)[kind, name]
            if text and noted and text != noted:
                what = 'transitions' if kind is Transitions else 'composite rewards'
                first, last = self.next[kind, name], named(commit)[kind, name]
                numbers = f'{first} to {last}' if last >= first else 'none'
                yield f'the {what} of {name!r} (numbers: {numbers})'
        if commit.policy_digest and ours.policy_digest not in ('', commit.policy_digest):
            yield f'the policy of phase {commit.phase}'
        states = {commit.labels_digest, commit.kept_labels_digest} - {''}
        if states and ours.labels_digest and ours.labels_digest not in states:
            yield f'the labels of phase {self._labels_of(commit)}'
        if states_digests(commit) and commit.previous != self.last:
            yield f'the commit of phase {commit.phase - 1}'


def states_digests(commit: Commit) -> bool:
    """Whether a commit states digests: those of protocol 1 do not."""
    return bool(commit.transition_digests or commit.score_digests)
