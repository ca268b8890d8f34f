"""The last phases of a run, as the recorder keeps them for a node that lacks some of them."""

from codetr_ros.records import (
    Commit,
    CompositeReward,
    Preference,
    Record,
    TaskSpec,
    Transitions,
)
from codetr_ros.records.chain import named, publisher


class LastPhases:
    """The received bytes of the last committed phases, and of records that no commit names yet."""

    def __init__(self, phases: int) -> None:
        self._open: dict[tuple[type, str, int], tuple[type, bytes]] = {}
        self._committed: dict[int, list[tuple[type, bytes]]] = {}
        self._phases = phases

    @property
    def newest(self) -> int | None:
        """The last committed phase; None before the first."""
        return max(self._committed, default=None)

    def hold(self, record: Record, raw: bytes) -> None:
        """Keep the bytes of a record that the core has taken, until a commit names it.

        The first of a number stays: steps that arrive before their source is announced are checked
        later, so that a second one of the same number may be one that the core then refuses.
        """
        if isinstance(record, (Transitions, CompositeReward, Preference)):
            key = (*publisher(record), record.sequence)
            self._open.setdefault(key, (type(record), raw))
        elif isinstance(record, TaskSpec):
            # no commit names it: it belongs to the phase that is committed next
            self._open.setdefault((TaskSpec, record.source, -1), (TaskSpec, raw))

    def commit(self, commit: Commit, raw: bytes) -> None:
        """File the records that a commit names under its phase; forget the oldest phase."""
        last = named(commit)
        keys = [key for key in self._open if key[2] <= last.get(key[:2], -1)]
        self._committed[commit.phase] = [self._open.pop(key) for key in keys] + [(Commit, raw)]
        while len(self._committed) > self._phases:
            del self._committed[min(self._committed)]

    def open(self) -> list[tuple[type, bytes]]:
        """Kind and bytes of each record that no commit names yet, in order of arrival."""
        return list(self._open.values())

    def get(self, phase: int) -> list[tuple[type, bytes]]:
        """Kind and bytes of each message of a committed phase.

        Raises:
            KeyError: the phase is not held; the message names those that are.
        """
        if phase not in self._committed:
            held = ', '.join(map(str, sorted(self._committed))) or 'none yet'
            raise KeyError(f'phase {phase} is not in memory; these are: {held}')
        return self._committed[phase]
