"""How long it takes to get a bag to the disk, for reports."""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager

from codetr_ros.runs.reports import FlushTimes

NEWEST = 1000
"""Number of the newest flushes, whose median is given."""


class Flushes:
    """The flushes of a bag.

    Attributes:
        seconds: that all of them took together.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self._longest = 0.0
        self._newest: deque[float] = deque(maxlen=NEWEST)  # seconds

    @contextmanager
    def timed(self) -> Iterator[None]:
        """Count the flush that is done meanwhile, unless it fails."""
        began = time.perf_counter()
        yield
        seconds = time.perf_counter() - began
        self._newest.append(seconds)
        self.seconds += seconds
        self._longest = max(self._longest, seconds)

    def times(self) -> FlushTimes:
        """The median of the newest, and the longest of all [ms]; 0 where there is none."""
        newest = sorted(self._newest)
        median = newest[len(newest) // 2] if newest else 0.0
        return FlushTimes(median=1e3 * median, max=1e3 * self._longest)
