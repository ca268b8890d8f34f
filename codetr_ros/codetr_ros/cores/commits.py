"""The commits that a consumer has received: a chain, each link checked before it is believed."""

import logging
from collections import Counter
from collections.abc import Callable

from codetr_ros.config import Settings
from codetr_ros.cores.announced import Tasks
from codetr_ros.cores.left_out import Absent
from codetr_ros.records import TOPICS, Commit, RecordError, describe
from codetr_ros.records.digests import digest
from codetr_ros.records.shown import worth_a_line

_log = logging.getLogger(__name__)

MOST_HELD = 4
"""Commits of one phase that are held at a time; whoever sends more of them floods."""


class Commits:
    """Holds the commits that may be right until the records decide.

    A commit is refused if it is of a phase that cannot have been permitted, does not follow on one
    that is held or was taken, or names other sources than those permitted. What is left is nearly
    always one. Should somebody have sent another, the digests tell which one is of the records.

    Args:
        settings: of the run.
        tasks: its sources.
        absent: those of them that are permitted nothing, by the commits that were taken.
        permitted: returns the newest phase that can have been permitted.
        refused: counts refusals that come later than `receive`, by topic.

    Attributes:
        missed: phases of commits that came before their turn, and went.
    """

    def __init__(
        self,
        settings: Settings,
        tasks: Tasks,
        absent: Absent,
        permitted: Callable[[], int],
        refused: 'Counter[str]',
    ) -> None:
        self._settings = settings
        self._tasks = tasks
        self._absent = absent
        self._permitted = permitted
        self._refused = refused
        self._held: dict[int, dict[str, Commit]] = {}  # by phase and digest
        self._digests: list[str] = []  # of the commits that were taken, by phase
        self.missed: set[int] = set()

    @property
    def next(self) -> int:
        """The phase to be taken in next."""
        return len(self._digests)

    @property
    def lacking(self) -> int | None:
        """The phase whose commit is lacking though a later one has come; None if none is."""
        newest = self._permitted()
        missed = any(self.next <= phase <= newest for phase in self.missed)
        return self.next if missed and not self.of(self.next) else None

    def digest(self, phase: int) -> str:
        """The digest of the commit of a phase that was taken; empty if it was not."""
        return self._digests[phase] if 0 <= phase < len(self._digests) else ''

    def candidates(self, phase: int) -> list[str]:
        """The digests of the commits of a phase that may be right."""
        return list(self._held.get(phase, {}))

    def of(self, phase: int) -> list[Commit]:
        """The commits of a phase that may be right, in the order of their arrival."""
        return list(self._held.get(phase, {}).values())

    def receive(self, commit: Commit) -> bool:
        """Hold a commit; returns whether it is new.

        Raises:
            RecordError: it cannot be right; nothing has changed then.
        """
        own = digest(commit)
        if own == self.digest(commit.phase) or own in self._held.get(commit.phase, {}):
            return False
        if text := self.contradiction(commit):
            raise RecordError(f'{describe(commit)} {text}')
        held = self.of(commit.phase)
        if len(held) == MOST_HELD:  # of a flood, the newest stay: what is fetched is the newest
            self.refuse(held[0], 'is one of too many that contradict each other')
            self.missed.add(commit.phase)
        self._held.setdefault(commit.phase, {})[own] = commit
        return True

    def contradiction(self, commit: Commit) -> str:
        """Why a commit cannot be right, in words; empty if it can be."""
        return (
            self._of_its_phase(commit) or self._of_its_names(commit) or self._of_its_chain(commit)
        )

    def _of_its_phase(self, commit: Commit) -> str:
        newest = min(self._permitted(), self._settings.phases - 1)
        if commit.phase > newest:
            if commit.phase < self._settings.phases:
                self.missed.add(commit.phase)
            return (
                f'is of phase {commit.phase}, and phase {newest} is the newest that can have been '
                'permitted: stop what publishes it'
            )
        if commit.phase < self.next:
            return (
                f'is another commit of phase {commit.phase} than the one that was learnt from: '
                'stop the second recorder'
            )
        return ''

    def _of_its_chain(self, commit: Commit) -> str:
        if commit.phase == self.next:
            before = {self.digest(commit.phase - 1)}
        else:
            before = set(self._held.get(commit.phase - 1, {}))
        if commit.previous in before:
            return ''
        if not before:
            self.missed.add(commit.phase)
            return f'comes before that of phase {commit.phase - 1}, which is asked for'
        return (
            f'follows on the commit {commit.previous!r}, that of phase {commit.phase - 1} is '
            f'{" or ".join(sorted(before))!r}: stop the second recorder'
        )

    def _of_its_names(self, commit: Commit) -> str:
        if len(commit.transition_digests) != len(commit.sources) or len(
            commit.score_digests
        ) != len(commit.scorers):
            return 'states no digests: install the same version of codetr_ros everywhere'
        if not commit.sources:
            return 'names no sources, and every phase has steps: stop what publishes it'
        absent = self._absent.of(commit.phase)
        if not self._tasks.known or absent is None:
            return ''  # asked again before it is taken
        shares = self._settings.shares_of(commit.phase)
        due = {name for name, n in zip(self._tasks.sources, shares, strict=True) if n}
        named, dropped = set(commit.sources), set(commit.dropped)
        if (
            named != due - absent
            or not named - dropped
            or not dropped <= named | absent
            or len(named) != len(commit.sources)
        ):
            return (
                f'names sources={list(commit.sources)} and dropped={list(commit.dropped)}, '
                f'permitted were {sorted(due - absent)}: stop what publishes it'
            )
        return ''

    def refuse(self, commit: Commit, text: str) -> None:
        """Drop a commit that was held; logged and counted."""
        held = self._held.get(commit.phase, {})
        if held.pop(digest(commit), None) is not None:
            self._refused[TOPICS[Commit]] += 1
            number = self._refused[TOPICS[Commit]]
            if worth_a_line(number):
                _log.error('refused later (number %s): %s %s', number, describe(commit), text)

    def take(self, commit: Commit) -> None:
        """Go on behind a commit whose records have its digests; the others of its phase go."""
        own = digest(commit)
        for other in self.of(commit.phase):
            if digest(other) != own:
                self.refuse(other, 'is not the one whose digests the records have')
        self._held.pop(commit.phase, None)
        self.missed.discard(commit.phase)
        self._digests.append(own)
