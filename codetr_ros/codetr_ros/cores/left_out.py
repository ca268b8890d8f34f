"""Sources that are left out of phases, because nothing comes from them.

A commit names them in `dropped`. For those that were permitted steps it also voids numbers: those
that it names as the last of such a source are beyond all that the source can have published by
then. So whatever it published and nobody has seen yet is known by its number, wherever and
whenever it arrives, and is dropped. The source begins again behind them, with the episode as it
was after its last phase that was not dropped.

A commit also names those that were left out before and have not announced themselves again. Who is
permitted steps follows from that alone (`Absent`), so that it is the same for everybody who reads
the commits, also later and from a bag.
"""

from collections.abc import Iterable

from codetr_ros.config import Settings
from codetr_ros.records import Commit, Policy


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
    """The sources that are permitted nothing in a phase, by the commits.

    Those that the commit of the phase names with which the permission was learnt: `lag` phases
    before. In the first phases, which are permitted before there is a commit, those that may join.

    Args:
        settings: of the run.

    Attributes:
        now: the sources that the newest commit names as left out.
    """

    def __init__(self, settings: Settings) -> None:
        self._settings = settings
        self.now = settings.joining_sources
        self._dropped: dict[int, frozenset[str]] = {}

    def follow(self, commit: Commit) -> None:
        """Take note of who was left out of a phase, in the order of phases."""
        self.now = self._dropped[commit.phase] = frozenset(commit.dropped)
        self._dropped.pop(commit.phase - self._settings.lag, None)

    def of(self, phase: int) -> frozenset[str] | None:
        """Who is permitted nothing in a phase; None if that cannot be known yet."""
        decided = phase - self._settings.lag
        return self._settings.joining_sources if decided < 0 else self._dropped.get(decided)
