"""How often a node of a run that died is started again."""

import signal
from collections import Counter, defaultdict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from time import monotonic

MOST = 5
"""How often a node is started again within `WITHIN`, unless the user says otherwise."""
WITHIN = 600.0
"""Seconds in which a node is started again so often and no oftener."""
LARGEST = 1_000_000
"""The largest number that is accepted for `most`."""


def may_be_started_again(code: int | None) -> bool:
    """Whether a process was killed, and nobody asked it to end."""
    return code is not None and code < 0 and -code not in (signal.SIGINT, signal.SIGTERM)


@dataclass
class Restarts:
    """Permits to start a node again that was killed.

    A node that is ended by a signal may have been killed by anybody: by the kernel for want of
    memory, by a fault of a library. One that ends with an exit code has given its reason, and
    would give it again.

    Attributes:
        most: how often a node is started again within `within`; 0: never.
        within: seconds.
        clock: seconds, never going back.
        counts: how often each node was started again, by name.
    """

    most: int = MOST
    within: float = WITHIN
    clock: Callable[[], float] = monotonic
    counts: Counter[str] = field(default_factory=Counter)
    _times: dict[str, deque[float]] = field(default_factory=lambda: defaultdict(deque))

    def permit(self, name: str, code: int | None) -> bool:
        """Whether to start a node again now; if so, that is counted.

        Args:
            name: its name.
            code: how its process ended: exit code, or the negative number of a signal.
        """
        if not may_be_started_again(code):
            return False
        now, times = self.clock(), self._times[name]
        while times and times[0] <= now - self.within:
            times.popleft()
        if len(times) >= self.most:
            return False
        times.append(now)
        self.counts[name] += 1
        return True

    def exhausted(self, name: str, code: int | None) -> str:
        """Why a node is not started again, for people; empty if not for the number."""
        if not self.counts[name] or not may_be_started_again(code):
            return ''
        return f' (started again {self.most} times within {self.within:g} s before)'


def wrong(most: int, within: float) -> str | None:
    """Why the values of `--restarts` and `--restarts-within` cannot be used; None if they can."""
    if not 0 <= most <= LARGEST:
        return f'--restarts {most} must be from 0 to {LARGEST}; 0: no node is started again'
    if not 0 < within <= LARGEST:
        return f'--restarts-within {within:g} must be more than 0 and at most {LARGEST} seconds'
    return None
