"""The processor time that a run had taken at each of its evaluations."""

import time
from collections.abc import Callable

from codetr_ros.records import EpisodeResult, Record
from codetr_ros.runs.run_summary import Spent


class ProcessorTime:
    """Notes what a run has taken of the processor, whenever an episode of an evaluation ends.

    That is one number only where all parts are in one process, and nothing else is.

    Args:
        clock: processor time of this process [s], all threads together; it begins to count now.
    """

    def __init__(self, clock: Callable[[], float] = time.process_time) -> None:
        self._clock = clock
        self._began = clock()
        self._at: dict[int, float] = {}
        self._known = True

    def receive(self, record: Record) -> None:
        """Note the time, if the record is of an episode of an evaluation."""
        if self._known and isinstance(record, EpisodeResult) and record.purpose == 'evaluation':
            self._at[record.step] = self._clock() - self._began

    def go_on(self) -> None:
        """Forget everything, for good: other processes have run what came before."""
        self._known = False
        self._at.clear()

    def rows(self) -> list[Spent]:
        """The time at the last episode of each evaluation, in the order of training steps."""
        return [Spent(step=step, cpu_s=round(s, 3)) for step, s in sorted(self._at.items())]
