"""Sources that are left out of phases, because nothing comes from them.

A commit names them in `dropped`. It then also voids numbers: those that it names as the last of
such a source are beyond all that the source can have published by then. So whatever it published
and nobody has seen yet is known by its number, wherever and whenever it arrives, and is dropped.
The source begins again behind them, with the episode as it was after its last committed phase.
"""

from collections.abc import Iterable, Iterator

from codetr_ros.config import Settings
from codetr_ros.records import Commit, Policy, Record


class LeftOutError(RuntimeError):
    """A simulator that was left out of phases while it went on: it must start again."""


def voided(settings: Settings, due: int) -> int:
    """The last number that is voided of a source, or of its scores.

    Args:
        settings: of the run.
        due: the next number that the recorder expects.
    """
    # the phases under way hold no more records than that, of any kind that is numbered
    return due + settings.ahead * settings.phase_steps


def is_left_out(settings: Settings, policy: Policy, sources: Iterable[str]) -> bool:
    """Whether a policy gives no step to these sources, though each would have a share."""
    given = dict(zip(policy.sources, policy.steps.tolist(), strict=True))
    have_shares = settings.steps_of(policy.phase) >= settings.source_count
    return have_shares and not any(given[each] for each in sources)


def undropped(records: Iterable[Record]) -> Iterator[Record]:
    """The records of committed phases, with their commits, in the order of a bag; without those of
    sources in phases that they were left out of.
    """
    held: list[Record] = []
    for record in records:
        held.append(record)
        if isinstance(record, Commit):
            yield from (
                each for each in held if getattr(each, 'source', None) not in record.dropped
            )
            held = []


class LeftOut:
    """Which sources are left out of which phases.

    A policy is learnt `lag` phases before the phase that it permits. So who is left out of a phase
    is left out of the next `lag - 1` too, which were permitted before anybody knew of it. From
    then on the policies decide: they give no step to a source until it has announced itself again.

    Args:
        settings: of the run.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self._until: dict[str, int] = {}  # the first phase that it may be part of again

    def leave_out(self, sources: Iterable[str], phase: int) -> None:
        """Leave sources out of a phase."""
        for source in sources:
            self._until[source] = max(self._until.get(source, 0), phase + self._settings.lag)

    def is_out(self, source: str, phase: int) -> bool:
        """Whether a source is left out of a phase that is not committed yet."""
        return phase < self._until.get(source, 0)


class Absent:
    """The sources that the learner permits nothing, until they have announced themselves again."""

    def __init__(self) -> None:
        self._sources: set[str] = set()
        self._unnamed: set[str] = set()  # since a commit that dropped them

    def follow(self, commit: Commit) -> None:
        """Take note of who was left out of a phase, and of who was part of it."""
        self._sources -= set(commit.sources)
        self._sources |= set(commit.dropped)
        self._unnamed = self._unnamed - set(commit.sources) | set(commit.dropped)

    def announced(self, source: str) -> None:
        """Take note that a source is there."""
        self._sources.discard(source)

    def may_lack(self, source: str) -> bool:
        """Whether the next commit need not name a source: it may have announced itself again only
        after the phase was permitted.
        """
        return source in self._unnamed

    def __contains__(self, source: object) -> bool:
        return source in self._sources
