"""When control steps are due, and how late they were."""

import math

import numpy as np

from codetr_ros.records import I64

_PER_DECADE = 100  # boxes of the histogram for each factor of ten: each is 2.3 % wide
_SMALLEST = 1e-6  # [s]
_BOXES = 8 * _PER_DECADE  # up to 100 s


class Lateness:
    """A histogram of delays [s], from a microsecond to 100 s, in boxes of 2.3 %.

    It counts every delay and takes 6 KB, however long the robot runs.
    """

    def __init__(self) -> None:
        self.counts: I64 = np.zeros(_BOXES, np.int64)
        self.largest = 0.0

    def add(self, seconds: float) -> None:
        """Count a delay."""
        self.largest = max(self.largest, seconds)
        place = math.log10(max(seconds, _SMALLEST) / _SMALLEST) * _PER_DECADE
        self.counts[min(int(place), _BOXES - 1)] += 1

    def percentile(self, share: float) -> float:
        """The delay [s] below which this share of all delays lies, at the upper edge of its box;
        0 where there are none.
        """
        total = int(self.counts.sum())
        if not total:
            return 0.0
        place = int(np.searchsorted(np.cumsum(self.counts), share * total))
        return min(self.largest, _SMALLEST * 10 ** ((place + 1) / _PER_DECADE))


class Deadlines:
    """The times at which control steps are due: every period, from the first on.

    Args:
        period: seconds.
    """

    def __init__(self, period: float) -> None:
        self.period = period
        self._first: float | None = None
        self._next = 0  # number of the next
        self.steps = 0
        self.missed = 0
        """Deadlines that passed without a command: the one before came a whole period late."""
        self.lateness = Lateness()

    def start(self, now: float) -> None:
        """Let the first step be due now."""
        self._first, self._next = now, 0

    def stop(self) -> None:
        """Let no step be due."""
        self._first = None

    @property
    def due(self) -> float:
        """When the next step is due; infinite where none is."""
        return math.inf if self._first is None else self._first + self._next * self.period

    def reached(self, now: float) -> bool:
        """Whether a step is due. It is counted as taken now, and its lateness noted; deadlines
        that have passed meanwhile are missed, and no steps make up for them.
        """
        if now < self.due:
            return False
        late = now - self.due
        skipped = int(late / self.period)
        self.lateness.add(late)
        self.steps += 1
        self.missed += skipped
        self._next += 1 + skipped
        return True

    def metrics(self) -> dict[str, float]:
        """What was measured, by name."""
        late = self.lateness
        return {
            'control_steps': self.steps,
            'deadlines_missed': self.missed,
            'late_ms_p50': 1e3 * late.percentile(0.5),
            'late_ms_p99': 1e3 * late.percentile(0.99),
            'late_ms_p99.9': 1e3 * late.percentile(0.999),
            'late_ms_max': 1e3 * late.largest,
        }
