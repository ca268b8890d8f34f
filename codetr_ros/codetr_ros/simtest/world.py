"""Virtual time, and the one queue of everything that will happen."""

import heapq
import random
from collections import deque
from collections.abc import Callable

KEPT = 400
"""The newest events that a trace holds."""


class World:
    """Runs events in order of their virtual time. All chance comes from one seeded generator, so a
    seed gives the same events at every run.

    Attributes:
        now: virtual time [s].
        rng: the source of all chance.
        events: how many events have happened.

    Args:
        seed: of all chance.
        kept: how many of the newest events the trace holds.
    """

    def __init__(self, seed: int, kept: int = KEPT) -> None:
        self.now = 0.0
        self.rng = random.Random(seed)
        self.events = 0
        self._queue: list[tuple[float, int, Callable[[], None]]] = []
        self._number = 0
        self._trace: deque[tuple[float, str, str]] = deque(maxlen=kept)

    def at(self, time: float, action: Callable[[], None]) -> None:
        """Let something happen at a time; of equal times, the first asked for is the first."""
        self._number += 1
        heapq.heappush(self._queue, (max(time, self.now), self._number, action))

    def number(self) -> int:
        """A number that nobody else has."""
        self._number += 1
        return self._number

    def note(self, who: str, what: str) -> None:
        """Add a line to the trace."""
        self._trace.append((self.now, who, what))

    def run(self, until: float, over: Callable[[], bool]) -> bool:
        """Let everything happen until it is over; false if it is not, by a time [s]."""
        while not over():
            if not self._queue or self._queue[0][0] > until:
                return False
            self.now, _, action = heapq.heappop(self._queue)
            self.events += 1
            action()
        return True

    def trace(self) -> list[str]:
        """The newest events, one a line: virtual time [s], who, what."""
        return [f'{time:10.3f}  {who:<10}  {what}' for time, who, what in self._trace]
