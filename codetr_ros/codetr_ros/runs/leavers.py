"""Who was left out of a run, as its commits state it."""

from codetr_ros.records import Commit


class Leavers:
    """The sources that are left out now, and for how many phases each was so far.

    Attributes:
        since: the first phase that each was left out of, of those that are left out now.
    """

    def __init__(self) -> None:
        self.since: dict[str, int] = {}
        self._phases: dict[str, set[int]] = {}
        self._next = 0

    def receive(self, commit: Commit) -> list[str]:
        """Take note of a commit, of which some may come again or late; returns what is new, in
        words.
        """
        for name in commit.dropped:
            self._phases.setdefault(name, set()).add(commit.phase)
        if commit.phase < self._next:
            return []
        self._next = commit.phase + 1
        news = [
            f'{name} is left out from phase {commit.phase} on: it is not there'
            for name in commit.dropped
            if name not in self.since
        ]
        news += [f'{name} is there again' for name in self.since if name not in commit.dropped]
        self.since = {name: self.since.get(name, commit.phase) for name in commit.dropped}
        return news

    @property
    def phases(self) -> dict[str, int]:
        """How many phases each was left out of."""
        return {name: len(phases) for name, phases in sorted(self._phases.items())}

    def now(self) -> str:
        """Who is left out, in words; empty if nobody is."""
        return ', '.join(f'{name} (since phase {n})' for name, n in sorted(self.since.items()))
